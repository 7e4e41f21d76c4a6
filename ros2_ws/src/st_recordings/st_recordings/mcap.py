"""Writes a bag as `ros2 bag record` of ROS 2 Jazzy does: a directory NAME/ with NAME_0.mcap and metadata.yaml.

This module does not import ROS; message definitions come from the installed interface packages (bag_metadata.py) or
from the caller. `recover` (recovery.py) repairs a bag after its writer was killed.
"""

import contextlib
import errno
import fcntl
import os
import struct
import threading
import time
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, MessageIndex, Metadata, Schema

from . import bag_metadata
from .bag_metadata import BagFile, BagInformation, BagTopic, Qos, collect_custom_data, format_qos, make_qos
from .mcap_contents import MAGIC, Contents

CHUNK_SIZE = 1024 * 1024
"""Size [bytes] at which a chunk is compressed and written, even before FLUSH_PERIOD has passed."""
FLUSH_PERIOD = 0.5
"""Period [s] of writes. A killed process loses up to 1 s of data: this period and that between flush_when_due calls."""
DISK_FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""If writing the index fails with one of these errors, the newest chunks are dropped until the index fits."""
MIN_SYNC_PERIOD = 0.25
"""Minimum time [s] between the starts of two synchronisations, so that frequent writes do not occupy the disk."""
_MESSAGE_RECORD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_MESSAGE_HEAD_LENGTH = 22  # bytes of the head after opcode and length


class BagWriter:
    """Writes one bag.

    message_count: number of messages, including those not yet written to the file. syncer: synchronises file and disk;
    None if not requested. A full or failing disk does not raise an error: the bag is closed after its last complete
    chunk, `error` gives the reason, and `lost_count` is the number of messages not in the file. If the file is
    moved or deleted, it is closed with its index, `error` reports this, and `was_moved` is set.
    """

    def __init__(self, directory: Path | str, records: Mapping[str, Mapping[str, str]] | None = None,
                 synced: bool = False):
        """Creates the directory, the file and a first metadata.yaml.

        directory: must be empty or not exist. records: MCAP metadata records, name -> {key: text}; short one-line texts
        are also written to metadata.yaml. synced: a separate thread synchronises each chunk with the disk, so that a
        power failure loses little more than a second; for live recordings. Raises OSError if the directory cannot be
        created or written, FileExistsError if it is not empty.
        """
        self.directory = Path(directory).absolute()
        self.error = ""
        self.message_count = self.lost_count = 0
        self.is_closed = self.was_moved = False
        self.syncer: Syncer | None = None
        self._custom = collect_custom_data(records or {})
        self._topics: list[BagTopic] = []
        self._schemas: dict[str, int] = {}
        if self.directory.is_dir() and any(self.directory.iterdir()):
            raise FileExistsError(f"{self.directory} contains files and is not overwritten; choose another directory")
        self.directory.mkdir(parents=True, exist_ok=True)
        self.path = self.directory / f"{self.directory.name}_0.mcap"
        self._contents = Contents()
        self._compressor = zstandard.ZstdCompressor()
        self._start_chunk()
        # Create the file first: of two writers that start together only one succeeds, and the other changes nothing.
        self._file = _LockedFile(self.path)
        self._build_information().save(self.directory)
        self._file.write(MAGIC)
        self._contents.append(self._file, Header(profile="ros2", library="st_predictor"), *(
            Metadata(name, dict(entries)) for name, entries in (records or {}).items()))
        self._next_flush = self._next_path_check = time.monotonic() + FLUSH_PERIOD
        if synced:
            self.syncer = Syncer(self._file.descriptor, (self.directory, self.directory.parent))
            self.syncer.wake()

    def add_topic(self, name: str, type_name: str, qos: Sequence[Qos] = (make_qos(),), definition: str = "",
                  type_hash: str = "") -> int:
        """Adds a topic of type "pkg/msg/Type" and returns its id for `write`.

        definition, type_hash: if empty, from the installed package; UnknownTypeError if that is not installed.
        """
        definition = definition or bag_metadata.read_definition(type_name)
        type_hash = type_hash or bag_metadata.read_type_hash(type_name)
        new_records: list[Schema | Channel] = []
        if type_name not in self._schemas:
            number = self._schemas[type_name] = len(self._schemas) + 1
            new_records.append(Schema(id=number, name=type_name, encoding="ros2msg", data=definition.encode()))
        self._topics.append(BagTopic(name, type_name, type_hash, list(qos)))
        metadata = {"offered_qos_profiles": format_qos(list(qos)), "topic_type_hash": type_hash}
        new_records.append(Channel(len(self._topics), name, "cdr", metadata, self._schemas[type_name]))
        if not (self.is_closed or self.error):
            try:
                # Definitions are outside chunks, so that a damaged chunk loses only its own messages.
                self._contents.append(self._file, *new_records)
            except OSError as error:
                self._stop(error)
        return len(self._topics)

    def write(self, topic: int, data: bytes, log_time_ns: int, publish_time_ns: int | None = None) -> None:
        """Adds a serialised (CDR) message. log_time_ns: time of reception. publish_time_ns: by default log_time_ns."""
        if self.is_closed or self.error:
            self.lost_count += 1
            return
        self._messages.setdefault(topic, MessageIndex(topic, [])).records.append((log_time_ns, self._chunk.count))
        publish_time_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        length = _MESSAGE_HEAD_LENGTH + len(data)
        self._chunk.write(_MESSAGE_RECORD.pack(Opcode.MESSAGE, length, topic, 0, log_time_ns, publish_time_ns))
        self._chunk.write(data)
        self.message_count += 1
        if self._chunk.count > CHUNK_SIZE or time.monotonic() >= self._next_flush:
            self.flush()

    def flush_when_due(self) -> None:
        """Writes pending messages every FLUSH_PERIOD, so that they are not lost if this process is killed, and
        checks that the file still exists under its name. Call it at least twice a second.
        """
        now = time.monotonic()
        if now >= self._next_flush:
            self.flush()
        if now >= self._next_path_check and not (self.is_closed or self.error):
            self._next_path_check = now + FLUSH_PERIOD
            if not self._file.is_at(self.path):
                self._close_moved_file()

    def flush(self) -> None:
        """Ends the chunk and writes it to the file."""
        self._next_flush = time.monotonic() + FLUSH_PERIOD
        if self._messages and not (self.is_closed or self.error):
            try:
                self._write_chunk()
            except OSError as error:
                self._stop(error)

    def close(self) -> None:
        """Writes pending messages, index and metadata.yaml; does nothing after an error or a previous call."""
        self.flush()
        if not (self.is_closed or self.error):
            try:
                description = {"serialized_metadata": self._build_information().to_yaml()}
                self._contents.append(self._file, Metadata("rosbag2", description))
                self._finish(self.directory)
                self._close_file(self.message_count)
            except OSError as error:
                self._stop(error)
        self.is_closed = True

    def _start_chunk(self) -> None:
        self._chunk = RecordBuilder()
        self._messages: dict[int, MessageIndex] = {}

    def _write_chunk(self) -> None:
        data, messages = self._chunk.end(), self._messages
        self._start_chunk()
        times = [record[0] for index in messages.values() for record in index.records]
        chunk = Chunk(compression="zstd", data=self._compressor.compress(data), message_start_time=min(times),
                      message_end_time=max(times), uncompressed_crc=zlib.crc32(data), uncompressed_size=len(data))
        self._contents.append(self._file, chunk, *messages.values())
        if self.syncer:
            self.syncer.wake()

    def _build_information(self) -> BagInformation:
        counts = self._contents.counts()
        for channel_id, topic in enumerate(self._topics, start=1):
            topic.count = counts[channel_id]
        bag_file = BagFile(self.path.name, counts.total(), *self._contents.times())
        return BagInformation([bag_file], self._topics, self._custom)

    def _finish(self, folder: Path | None) -> None:
        self._contents.finish(self._file)
        os.fsync(self._file.descriptor)
        if folder is not None:
            self._build_information().save(folder)

    def _close_file(self, count: int) -> None:
        """Closes the file. count: number of messages in it; all others count as lost."""
        self.lost_count, self.message_count = self.lost_count + self.message_count - count, count
        if self.syncer:
            self.syncer.stop()
        os.close(self._file.descriptor)

    def _close_moved_file(self) -> None:
        self.was_moved = True
        current_path = Path(os.readlink(f"/proc/self/fd/{self._file.descriptor}"))
        folder = current_path.parent if self._file.is_at(current_path) else None
        state = "deleted" if folder is None else f"moved to {current_path}"
        self.error = f"recording stopped: {self.path} was {state}"
        with contextlib.suppress(OSError):  # `recover` writes a missing index
            if self._messages:
                self._write_chunk()
            self._finish(folder)
        self._close_file(0 if folder is None else self._contents.counts().total())

    def _stop(self, error: OSError) -> None:
        """Closes the bag after its last complete chunk, and drops chunks until index and metadata.yaml fit."""
        self.error = f"recording stopped: {error.strerror or error} ({self.path})"
        length = self._file.tell()
        while True:
            try:
                self._file.truncate(length)
                self._finish(self.directory)
                break
            except OSError as write_error:
                chunk_start = self._contents.drop_last_chunk() if write_error.errno in DISK_FULL_ERRORS else None
                if chunk_start is None:
                    self.error += (f"; its index could not be written either ({write_error.strerror}): repair the bag "
                                   "with `st recover`")
                    with contextlib.suppress(OSError):
                        self._file.truncate(length)
                    break
                length = chunk_start
        self._close_file(self._contents.counts().total())


class _LockedFile:
    """The locked storage file; unbuffered, so that an error is raised by the call that caused it."""

    def __init__(self, path: Path):
        self.descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
        # The lock lasts until the file is closed or the process ends; `recover` refuses a locked bag.
        # Some network and USB file systems do not support locks; recording then continues without a lock.
        with contextlib.suppress(OSError):
            fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._length = 0

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        while view:
            view = view[os.write(self.descriptor, view):]
        self._length += len(data)
        return len(data)

    def tell(self) -> int:
        """Position after the last complete write [byte]."""
        return self._length

    def truncate(self, length: int) -> None:
        os.ftruncate(self.descriptor, length)
        os.lseek(self.descriptor, length, os.SEEK_SET)
        self._length = length

    def is_at(self, path: Path) -> bool:
        """Whether the path refers to this file."""
        try:
            return os.path.samestat(os.stat(path), os.fstat(self.descriptor))
        except OSError:
            return False


class Syncer:
    """Calls fdatasync on a growing file in a separate thread after `wake`, at most once per MIN_SYNC_PERIOD. A
    power failure then loses only the newest data of the file.

    error: text of the last error, or "". It is never cleared, because data of a failed call may be missing even if
    later calls succeed. call_count: including failed calls. longest_call: duration of the longest call [s].
    """

    def __init__(self, descriptor: int, folders: Sequence[Path]):
        """folders: directories to synchronise once, because a file without a directory entry is lost."""
        # Duplicated, because the writer may close its descriptor, and the number may then be reused for another file.
        self._descriptor = os.dup(descriptor)
        self._folders = tuple(folders)
        self._condition = threading.Condition()
        # Write times [s, monotonic] of the oldest data awaiting synchronisation, and of the oldest being synchronised.
        self._waiting_start: float | None = None
        self._syncing_start: float | None = None
        self._must_stop = False
        self.error = ""
        self.call_count, self.longest_call = 0, 0.0
        self._thread = threading.Thread(target=self._work, name="sync", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Requests a synchronisation after a write. Returns at once."""
        with self._condition:
            if self._waiting_start is None:
                self._waiting_start = time.monotonic()
            self._condition.notify()

    @property
    def delay(self) -> float:
        """Age of the oldest data not yet synchronised [s]; 0 if there are none."""
        with self._condition:
            starts = [t for t in (self._waiting_start, self._syncing_start) if t is not None]
        return time.monotonic() - min(starts) if starts else 0.0

    def stop(self) -> None:
        """Ends the thread and waits for it; remaining data is not synchronised."""
        with self._condition:
            self._must_stop = True
            self._condition.notify()
        self._thread.join()

    def _work(self) -> None:
        start = float("-inf")
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._must_stop or self._waiting_start is not None)
                pause = start + MIN_SYNC_PERIOD - time.monotonic()
                if pause > 0.0:
                    self._condition.wait_for(lambda: self._must_stop, pause)
                if self._must_stop:
                    break
                self._syncing_start, self._waiting_start = self._waiting_start, None
            start = time.monotonic()
            try:
                os.fdatasync(self._descriptor)
                while self._folders:
                    with contextlib.suppress(FileNotFoundError):  # renamed or deleted, which the writer reports
                        descriptor = os.open(self._folders[0], os.O_RDONLY | os.O_DIRECTORY)
                        try:
                            os.fsync(descriptor)
                        finally:
                            os.close(descriptor)
                    self._folders = self._folders[1:]
            except OSError as error:
                self.error = error.strerror or str(error)
            with self._condition:
                self._syncing_start = None
                self.longest_call = max(self.longest_call, time.monotonic() - start)
                self.call_count += 1
        os.close(self._descriptor)
