"""Repairs a bag or an MCAP file that was truncated by a crash, a killed process or a full disk.

Every undamaged chunk is kept byte for byte. Missing indexes, summary, footer and metadata.yaml are rebuilt.
A repair in place keeps the original as NAME.mcap.cut (.cut2, ...). A bag that needs no repair is not changed.
"""

import fcntl
import os
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import BinaryIO

import yaml
from mcap.opcode import Opcode
from mcap.records import DataEnd, Footer, Statistics
from mcap.stream_reader import StreamReader

from .bag_metadata import FILE_NAME, BagFile, BagInformation, BagTopic, collect_custom_data, read_information
from .mcap_contents import MAGIC, Contents, read_records
from .paths import natural_sort_key

DATA_END_LENGTH = 13  # bytes of the record that ends the data section


class RecoveryError(ValueError):
    """A file cannot be recovered and is unchanged; earlier files of its bag may be repaired. The text is one line."""


@dataclass
class FileReport(BagFile):
    """Outcome for one file; count, start_ns and end_ns refer to the messages kept."""

    is_intact: bool = False  # closed and undamaged: unchanged, or copied to the output with a new summary
    lost_bytes: int = 0  # in truncated or damaged records
    damaged_records: int = 0
    original: Path | None = None  # new path of the damaged file, if it was repaired in place


@dataclass
class RecoveryReport:
    files: list[FileReport] = field(default_factory=list)
    has_rebuilt_metadata: bool = False

    def __str__(self) -> str:
        """One line per file, for a terminal."""
        lines = []
        for file in self.files:
            state = "intact, unchanged" if file.is_intact else f"repaired, {file.lost_bytes} bytes lost"
            if file.damaged_records:
                state += f", {file.damaged_records} damaged record{'s' * (file.damaged_records > 1)} left out"
            if file.original:
                state += f", the original is {file.original.name}"
            seconds = (file.end_ns - file.start_ns) / 1e9
            lines.append(f"{file.name}: {file.count} messages over {seconds:.1f} s, {state}")
        if self.has_rebuilt_metadata:
            lines.append(f"{FILE_NAME}: rebuilt")
        return "\n".join(lines)


def recover(path: Path | str, output: Path | str | None = None) -> RecoveryReport:
    """Makes a damaged bag directory, all bags of a run folder, or an .mcap file readable.

    path: directory, or one .mcap file (then metadata.yaml is not changed). output: new directory or file for the
    repaired bag; it must not exist. By default the bag is repaired in place. Raises RecoveryError if there is no valid
    MCAP file, one is still being recorded, the output exists, or the disk is full.
    """
    path = Path(path)
    target = Path(output) if output is not None else path
    try:
        if output is not None and target.exists():
            raise RecoveryError(f"{target} already exists; choose another output")
        if path.is_dir():
            return _recover_directory(path, target)
        if not path.is_file():
            raise RecoveryError(f"{path} does not exist")
        return RecoveryReport([_recover_file(path, target)[0]])
    except OSError as error:
        raise RecoveryError(f"{error.filename or target}: {error.strerror or error}; nothing was deleted") from error


def _recover_directory(source: Path, target: Path) -> RecoveryReport:
    files = sorted(source.glob("*.mcap"), key=natural_sort_key)
    if not files:
        bags = sorted(file.parent for file in source.glob(f"*/{FILE_NAME}"))  # of a run: bag, errors, bag_2, ...
        if not bags:
            raise RecoveryError(f"{source} has no .mcap file")
        reports = [_recover_directory(bag, target / bag.name) for bag in bags]
        return RecoveryReport([file for report in reports for file in report.files],
                              any(report.has_rebuilt_metadata for report in reports))
    if target != source:
        target.mkdir(parents=True)
    results = [_recover_file(file, target / file.name) for file in files]
    report = RecoveryReport([file for file, _ in results])
    information = _build_information(report.files, [contents for _, contents in results], source)
    if not _metadata_matches(target, information):
        information.save(target)
        report.has_rebuilt_metadata = True
    return report


def _recover_file(source: Path, target: Path) -> tuple[FileReport, Contents]:
    with source.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        try:
            fcntl.flock(stream.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RecoveryError(f"{source} is still being recorded; stop the recorder first") from None
        except OSError:
            pass  # a file system without locks
        if stream.read(len(MAGIC)) != MAGIC:
            raise RecoveryError(f"{source} is not an MCAP file, or was truncated within its first 8 bytes")
        first = next(read_records(stream, size), None)
        if first is None or first.opcode != Opcode.HEADER:
            raise RecoveryError(f"{source} was truncated before its first record")
        contents, report = Contents(), FileReport(target.name)
        end_of_data = len(MAGIC) + sum(map(len, _read_undamaged_records(stream, size, contents, report)))
        report.is_intact = not report.damaged_records and _is_closed(stream, contents, end_of_data)
        if not (report.is_intact and target == source):
            contents = _write_repaired(stream, size, source, target, report)
    report.count = contents.counts().total()
    report.start_ns, report.end_ns = contents.times()
    return report, contents


def _is_closed(stream: BinaryIO, contents: Contents, end_of_data: int) -> bool:
    """Whether a valid summary that counts the same messages follows the data, as in a closed file.

    end_of_data: position of the byte after the data section.
    """
    stream.seek(end_of_data)
    tail = BytesIO(stream.read())
    try:
        data_end, *summary, footer = StreamReader(tail, skip_magic=True).records
    except Exception:  # of many types, because the library does not validate its input
        return False
    crc = zlib.crc32(tail.getvalue()[DATA_END_LENGTH : -len(MAGIC) - 4])
    return (isinstance(data_end, DataEnd) and isinstance(footer, Footer) and not tail.read()
            and footer.summary_start == end_of_data + DATA_END_LENGTH and footer.summary_crc in (0, crc)
            and all(record.message_count == contents.counts().total() for record in summary
                    if isinstance(record, Statistics)))


def _read_undamaged_records(stream: BinaryIO, size: int, contents: Contents, report: FileReport) -> Iterator[bytes]:
    """Yields the undamaged records of the data section and adds them to `contents` at their new offsets."""
    position = end = len(MAGIC)
    report.damaged_records = 0
    chunk_is_damaged = False
    for record in read_records(stream, size):
        if record.opcode == Opcode.DATA_END:
            size = record.offset
            break
        raw = record.raw
        end = record.offset + len(raw)
        if chunk_is_damaged and record.opcode == Opcode.MESSAGE_INDEX:
            continue
        if not contents.add(record, position):
            report.damaged_records += 1
            chunk_is_damaged = record.opcode == Opcode.CHUNK
            continue
        chunk_is_damaged = False
        position += len(raw)
        yield raw
    report.lost_bytes = max(size, end) - position


def _write_repaired(stream: BinaryIO, size: int, source: Path, target: Path, report: FileReport) -> Contents:
    contents = Contents()
    temporary = target.with_name(target.name + ".recovering")
    try:
        with temporary.open("wb") as out:
            out.write(MAGIC)
            out.writelines(_read_undamaged_records(stream, size, contents, report))
            contents.finish(out)
            out.flush()
            os.fsync(out.fileno())
        if target == source:
            names = (source.with_name(f"{source.name}.cut{number if number > 1 else ''}") for number in count(1))
            report.original = next(name for name in names if not name.exists())
            try:
                os.link(source, report.original)  # so that NAME.mcap exists at all times
            except OSError:
                source.rename(report.original)  # no hard links on this file system
        temporary.replace(target)
    except OSError:
        temporary.unlink(missing_ok=True)
        if report.original is not None and not source.exists():
            report.original.rename(source)
        raise
    return contents


def _build_information(files: Sequence[BagFile], contents: list[Contents], source: Path) -> BagInformation:
    topics: dict[tuple[str, str], BagTopic] = {}
    previous_custom = read_information(source).get("custom_data")
    custom = {str(key): str(text) for key, text in previous_custom.items()} if isinstance(previous_custom, dict) else {}
    for file_contents in contents:
        counts = file_contents.counts()
        custom.update(collect_custom_data(file_contents.metadata))
        for channel in file_contents.channels.values():
            schema = file_contents.schemas.get(channel.schema_id)
            type_name = schema.name if schema else ""
            try:
                qos = yaml.safe_load(channel.metadata.get("offered_qos_profiles", ""))
            except yaml.YAMLError:
                qos = None
            topic = topics.setdefault((channel.topic, type_name), BagTopic(
                channel.topic, type_name, channel.metadata.get("topic_type_hash", ""),
                qos if isinstance(qos, list) else []))
            topic.count += counts[channel.id]
    return BagInformation(files, list(topics.values()), custom)


def _metadata_matches(folder: Path, information: BagInformation) -> bool:
    """Whether metadata.yaml has the same files, duration and counts by topic; other entries vary between recorders."""
    documents = information.to_document()["rosbag2_bagfile_information"], read_information(folder)
    counts: tuple[Counter[str], ...] = Counter(), Counter()  # a topic with two types may have one entry or two
    try:
        for document, count_by_topic in zip(documents, counts, strict=True):
            for topic in document["topics_with_message_count"]:
                count_by_topic[topic["topic_metadata"]["name"]] += topic["message_count"]
    except (KeyError, TypeError):
        return False
    rebuilt_document, on_disk = documents
    return counts[0] == counts[1] and all(
        on_disk.get(key) == rebuilt_document[key] for key in ("message_count", "relative_file_paths", "duration"))
