"""Recovery of truncated and damaged bags: every complete chunk is recovered, nothing gets worse, and repeating it
changes nothing."""

import os
import shutil
from pathlib import Path

import pytest
import yaml
from bags import DEFINITION, TYPE, add_numbered_topic, numbered, read_numbers, read_numbers_with_mcap
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from st_recordings.mcap import BagWriter
from st_recordings.mcap_contents import read_records
from st_recordings.recovery import RecoveryError, recover

START_NS = 1_790_000_000_000_000_000
CHUNK = 10  # messages of /a
MESSAGES = 12 * CHUNK


@pytest.fixture(scope="module")
def complete(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A closed bag of twelve chunks; the second topic begins in the seventh."""
    directory = tmp_path_factory.mktemp("complete") / "bag"
    bag = BagWriter(directory, {"configuration": {"hash": "0123"}})
    a = add_numbered_topic(bag)
    for k in range(MESSAGES):
        if k == MESSAGES // 2:
            b = add_numbered_topic(bag, "/b")
        bag.write(a, numbered(k), START_NS + k * 1_000_000)
        if k >= MESSAGES // 2:
            bag.write(b, numbered(-k), START_NS + k * 1_000_000)
        if k % CHUNK == CHUNK - 1:
            bag.flush()
    bag.close()
    return directory


def list_records(file: Path) -> list:
    with file.open("rb") as stream:
        return list(read_records(stream, file.stat().st_size))


def list_chunks(file: Path) -> list:
    return [r for r in list_records(file) if r.opcode == Opcode.CHUNK]


def size_of(bag: Path) -> int:
    return (bag / "bag_0.mcap").stat().st_size


def truncate(bag: Path, target: Path, length: int) -> Path:
    """Copies a bag without its metadata.yaml, its file truncated to `length` bytes."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    (target / "bag_0.mcap").write_bytes((bag / "bag_0.mcap").read_bytes()[:length])
    return target


def count_recoverable(bag: Path, length: int) -> int:
    """Messages of /a in the chunks that lie completely within the first `length` bytes."""
    return CHUNK * sum(r.offset + len(r.raw) <= length for r in list_chunks(bag / "bag_0.mcap"))


def check_numbers(directory: Path, expected: int, with_metadata: bool = True) -> None:
    """Both readers find the expected messages. with_metadata: reads also the metadata.yaml, which is slow."""
    numbers = read_numbers(directory if with_metadata else directory / "bag_0.mcap")
    assert numbers.get("/a", []) == list(range(expected))
    assert numbers.get("/b", []) == [-k for k in range(MESSAGES // 2, expected)]
    assert read_numbers_with_mcap(directory / "bag_0.mcap") == numbers


@pytest.mark.slow
def test_truncation_at_and_near_every_record(complete: Path, tmp_path: Path) -> None:
    """Header, metadata, chunks, their indexes, summary: the readers agree on what remains."""
    records = list_records(complete / "bag_0.mcap")
    header_end = records[0].offset + len(records[0].raw)
    boundaries = [r.offset for r in records[1:]] + [size_of(complete)]
    near = {b + shift for b in boundaries for shift in (-1, 0, 1, 9)}
    lengths = sorted(near & set(range(header_end, boundaries[-1])))
    assert len(lengths) > 100  # not vacuous
    for length in lengths:
        directory = truncate(complete, tmp_path / "bag", length)
        recover(directory)
        check_numbers(directory, count_recoverable(complete, length), with_metadata=False)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0, exclude_max=True))
def test_truncation_anywhere(complete: Path, tmp_path: Path, share: float) -> None:
    length = int(share * size_of(complete))
    directory = truncate(complete, tmp_path / "bag", length)
    before = (directory / "bag_0.mcap").read_bytes()
    try:
        recover(directory)
    except RecoveryError as error:
        assert length < 100
        assert "truncated" in str(error)
        assert (directory / "bag_0.mcap").read_bytes() == before
        return
    check_numbers(directory, count_recoverable(complete, length))


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
def test_one_wrong_byte_affects_only_what_follows_it(complete: Path, tmp_path: Path, share: float, flip: int) -> None:
    """Chunks and summary have checksums; the few bytes between them have none."""
    directory = truncate(complete, tmp_path / "bag", 10**9)
    file = directory / "bag_0.mcap"
    content = bytearray(file.read_bytes())
    records = list_records(file)
    end_of_data = next(r.offset for r in records if r.opcode == Opcode.DATA_END)
    places = [k for r in records if r.opcode == Opcode.CHUNK for k in range(r.offset, r.offset + len(r.raw))]
    places += range(end_of_data, len(content))
    place = places[int(share * len(places))]
    content[place] ^= flip
    file.write_bytes(content)
    recover(directory)
    numbers = read_numbers(directory).get("/a", [])
    assert numbers == sorted(set(numbers))
    assert set(range(count_recoverable(complete, place))) <= set(numbers)


@pytest.mark.parametrize("number", [0, 2, 11])
def test_only_the_damaged_chunk_is_left_out(complete: Path, tmp_path: Path, number: int) -> None:
    directory = truncate(complete, tmp_path / "bag", 10**9)
    chunk = list_chunks(directory / "bag_0.mcap")[number]
    content = bytearray((directory / "bag_0.mcap").read_bytes())
    content[chunk.offset + len(chunk.raw) // 2] ^= 0xFF
    (directory / "bag_0.mcap").write_bytes(content)
    report = recover(directory)
    assert report.files[0].damaged_records == 1
    assert "1 damaged" in str(report)
    assert read_numbers(directory)["/a"] == [k for k in range(MESSAGES) if k // CHUNK != number]


def test_zeros_after_a_power_failure_are_discarded(complete: Path, tmp_path: Path) -> None:
    length = list_records(complete / "bag_0.mcap")[12].offset
    directory = truncate(complete, tmp_path / "bag", length)
    with (directory / "bag_0.mcap").open("ab") as stream:
        stream.write(bytes(5000))
    report = recover(directory)
    check_numbers(directory, count_recoverable(complete, length))
    assert report.files[0].lost_bytes == 5000


def test_recording_of_many_chunks_is_indexed_completely(tmp_path: Path) -> None:
    """Index, counts and times of all 400 chunks, of the complete file and after its last chunk was truncated."""
    bag = BagWriter(tmp_path / "bag")
    a = add_numbered_topic(bag)
    for k in range(1200):
        bag.write(a, numbered(k), START_NS + k)
        if k % 3 == 2:
            bag.flush()
    bag.close()
    assert read_numbers(tmp_path / "bag")["/a"] == list(range(1200))
    assert read_numbers_with_mcap(bag.path)["/a"] == list(range(1200))
    assert all(part.is_intact for part in recover(tmp_path / "bag").files)
    last = list_chunks(bag.path)[-1]
    directory = truncate(tmp_path / "bag", tmp_path / "truncated", last.offset + 5)
    report = recover(directory)
    assert (report.files[0].start_ns, report.files[0].end_ns) == (START_NS, START_NS + 1196)
    assert read_numbers(directory)["/a"] == list(range(1197))
    assert read_numbers_with_mcap(directory / "bag_0.mcap")["/a"] == list(range(1197))


def test_metadata_is_rebuilt_from_the_file_alone(complete: Path, tmp_path: Path) -> None:
    directory = truncate(complete, tmp_path / "bag", size_of(complete) - 30)
    assert recover(directory).has_rebuilt_metadata
    rebuilt, original = (yaml.safe_load((d / "metadata.yaml").read_text()) for d in (directory, complete))
    assert rebuilt == original


def test_complete_bag_is_not_changed(complete: Path, tmp_path: Path) -> None:
    directory = shutil.copytree(complete, tmp_path / "bag")
    before = {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in directory.iterdir()}
    report = recover(directory)
    assert all(part.is_intact for part in report.files) and not report.has_rebuilt_metadata
    assert {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in directory.iterdir()} == before


def test_second_recovery_changes_nothing_and_the_original_is_kept(complete: Path, tmp_path: Path) -> None:
    directory = truncate(complete, tmp_path / "bag", size_of(complete) // 2)
    original = (directory / "bag_0.mcap").read_bytes()
    first = recover(directory)
    after = {p.name: p.read_bytes() for p in directory.iterdir()}
    second = recover(directory)
    assert not all(part.is_intact for part in first.files)
    assert all(part.is_intact for part in second.files) and not second.has_rebuilt_metadata
    assert second.files[0].count == first.files[0].count
    assert {p.name: p.read_bytes() for p in directory.iterdir()} == after
    assert (directory / "bag_0.mcap.cut").read_bytes() == original
    assert set(after) == {"bag_0.mcap", "bag_0.mcap.cut", "metadata.yaml"}


def test_output_folder_leaves_the_original_untouched(complete: Path, tmp_path: Path) -> None:
    length = size_of(complete) // 2
    directory = truncate(complete, tmp_path / "bag", length)
    before = {p.name: p.read_bytes() for p in directory.iterdir()}
    recover(directory, tmp_path / "repaired")
    assert {p.name: p.read_bytes() for p in directory.iterdir()} == before
    check_numbers(tmp_path / "repaired", count_recoverable(complete, length))


def test_single_file_is_recovered_without_metadata(complete: Path, tmp_path: Path) -> None:
    length = size_of(complete) // 2
    directory = truncate(complete, tmp_path / "bag", length)
    recover(directory / "bag_0.mcap")
    assert read_numbers(directory / "bag_0.mcap")["/a"] == list(range(count_recoverable(complete, length)))
    assert not (directory / "metadata.yaml").exists()


def test_truncated_file_without_chunks_is_recovered(tmp_path: Path) -> None:
    """rosbag2 writes such files with its preset fastwrite."""
    from mcap.writer import IndexType, Writer

    with (tmp_path / "fast.mcap").open("wb") as stream:
        writer = Writer(stream, use_chunking=False, index_types=IndexType.NONE)
        writer.start(profile="ros2")
        schema = writer.register_schema(TYPE, "ros2msg", DEFINITION.encode())
        channel = writer.register_channel("/a", "cdr", schema)
        for k in range(100):
            writer.add_message(channel, START_NS + k, numbered(k), START_NS + k)
        stream.write(b"\x05\x40\0\0\0\0\0\0\0half a message")
    report = recover(tmp_path / "fast.mcap")
    assert report.files[0].count == 100
    assert read_numbers(tmp_path / "fast.mcap") == {"/a": list(range(100))}
    assert read_numbers_with_mcap(tmp_path / "fast.mcap") == {"/a": list(range(100))}


@pytest.mark.parametrize("content", [b"", b"\x89MCAP", b"PK\3\4 this is a zip file", b"\x89MCAP0\r\n\x01\x20\0\0"])
def test_file_that_is_not_a_bag_is_rejected_and_not_changed(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "x.mcap"
    file.write_bytes(content)
    with pytest.raises(RecoveryError, match=r"x\.mcap"):
        recover(file)
    assert file.read_bytes() == content
    assert list(tmp_path.iterdir()) == [file]


def test_missing_input_and_existing_output_are_rejected(complete: Path, tmp_path: Path) -> None:
    with pytest.raises(RecoveryError, match="does not exist"):
        recover(tmp_path / "nothing")
    with pytest.raises(RecoveryError, match=r"no \.mcap file"):
        recover(tmp_path)
    with pytest.raises(RecoveryError, match="already exists"):
        recover(complete, tmp_path)


def test_all_bags_of_a_run_are_repaired(complete: Path, tmp_path: Path) -> None:
    for name in ("bag", "errors"):
        shutil.copytree(complete, tmp_path / "run" / name)
        os.truncate(tmp_path / "run" / name / "bag_0.mcap", size_of(complete) - 40)
    (tmp_path / "run" / "truth").mkdir()
    report = recover(tmp_path / "run", tmp_path / "repaired")
    assert [file.is_intact for file in report.files] == [False, False]
    for name in ("bag", "errors"):
        check_numbers(tmp_path / "repaired" / name, MESSAGES)
    assert {path.name for path in (tmp_path / "repaired").iterdir()} == {"bag", "errors"}
