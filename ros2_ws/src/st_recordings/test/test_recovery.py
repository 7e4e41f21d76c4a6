"""Recovery of cut and damaged bags: every whole chunk comes back, nothing gets worse, twice is once."""

import shutil
from pathlib import Path

import pytest
import yaml
from bags import DEFINITION, TYPE, TYPE_HASH, numbered, read_numbers, read_numbers_with_mcap
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from st_recordings.mcap import BagWriter, RecoveryError, recover
from st_recordings.mcap_contents import read_records

START_NS = 1_790_000_000_000_000_000
MESSAGES = 600


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A closed bag of twelve chunks; the second topic begins in the seventh."""
    directory = tmp_path_factory.mktemp("whole") / "bag"
    bag = BagWriter(directory, {"configuration": {"hash": "0123"}})
    a = bag.add_topic("/a", TYPE, definition=DEFINITION, type_hash=TYPE_HASH)
    for k in range(MESSAGES):
        if k == MESSAGES // 2:
            b = bag.add_topic("/b", TYPE, definition=DEFINITION, type_hash=TYPE_HASH)
        bag.write(a, numbered(k), START_NS + k * 1_000_000)
        if k >= MESSAGES // 2:
            bag.write(b, numbered(-k), START_NS + k * 1_000_000)
        if k % 50 == 49:
            bag.flush()
    bag.close()
    return directory


def records_of(file: Path) -> list:
    with file.open("rb") as stream:
        return list(read_records(stream, file.stat().st_size))


def cut(whole: Path, target: Path, length: int) -> Path:
    """A copy of the bag whose file ends after `length` bytes, with the metadata.yaml of the start of a recording."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    (target / "bag_0.mcap").write_bytes((whole / "bag_0.mcap").read_bytes()[:length])
    return target


def whole_messages(whole: Path, length: int) -> int:
    """Messages of /a in the chunks that lie completely within the first `length` bytes."""
    chunks = [r for r in records_of(whole / "bag_0.mcap") if r.opcode == Opcode.CHUNK]
    return 50 * sum(r.offset + len(r.raw) <= length for r in chunks)


def check(directory: Path, expected: int) -> None:
    numbers = read_numbers(directory)
    assert numbers.get("/a", []) == list(range(expected))
    assert numbers.get("/b", []) == [-k for k in range(MESSAGES // 2, expected)]
    assert read_numbers_with_mcap(directory / "bag_0.mcap") == numbers


def test_cut_at_and_beside_every_record(whole: Path, tmp_path: Path) -> None:
    """Header, metadata, chunks, their indexes, summary: the readers agree on what is left after each cut."""
    records = records_of(whole / "bag_0.mcap")
    header_end = records[0].offset + len(records[0].raw)
    boundaries = [r.offset for r in records[1:]] + [(whole / "bag_0.mcap").stat().st_size]
    near = {b + shift for b in boundaries for shift in (-1, 0, 1, 9)}
    lengths = sorted(near & set(range(header_end, boundaries[-1])))
    assert len(lengths) > 100
    for length in lengths:
        directory = cut(whole, tmp_path / "cut", length)
        recover(directory)
        check(directory, whole_messages(whole, length))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0, exclude_max=True))
def test_cut_anywhere(whole: Path, tmp_path: Path, share: float) -> None:
    length = int(share * (whole / "bag_0.mcap").stat().st_size)
    directory = cut(whole, tmp_path / "cut", length)
    before = (directory / "bag_0.mcap").read_bytes()
    try:
        recover(directory)
    except RecoveryError as error:
        assert length < 100
        assert "cut" in str(error)
        assert (directory / "bag_0.mcap").read_bytes() == before
        return
    check(directory, whole_messages(whole, length))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
def test_one_wrong_byte_costs_at_most_what_follows_it(whole: Path, tmp_path: Path, share: float, flip: int) -> None:
    """In a chunk or in the summary, which a checksum covers; the few bytes between them it does not."""
    directory = cut(whole, tmp_path / "cut", 10**9)
    file = directory / "bag_0.mcap"
    content = bytearray(file.read_bytes())
    records = records_of(file)
    end_of_data = next(r.offset for r in records if r.opcode == Opcode.DATA_END)
    places = [k for r in records if r.opcode == Opcode.CHUNK for k in range(r.offset, r.offset + len(r.raw))]
    places += range(end_of_data, len(content))
    place = places[int(share * len(places))]
    content[place] ^= flip
    file.write_bytes(content)
    recover(directory)
    numbers = read_numbers(directory).get("/a", [])
    assert numbers == sorted(set(numbers))
    assert set(range(whole_messages(whole, place))) <= set(numbers)


@pytest.mark.parametrize("number", [0, 2, 11])
def test_damaged_chunk_is_left_out_and_the_others_kept(whole: Path, tmp_path: Path, number: int) -> None:
    directory = cut(whole, tmp_path / "cut", 10**9)
    chunk = [r for r in records_of(directory / "bag_0.mcap") if r.opcode == Opcode.CHUNK][number]
    content = bytearray((directory / "bag_0.mcap").read_bytes())
    content[chunk.offset + len(chunk.raw) // 2] ^= 0xFF
    (directory / "bag_0.mcap").write_bytes(content)
    report = recover(directory)
    assert report.files[0].damaged_records == 1
    assert "1 damaged" in str(report)
    assert read_numbers(directory)["/a"] == [k for k in range(MESSAGES) if k // 50 != number]


def test_zeros_after_a_loss_of_power_are_no_records(whole: Path, tmp_path: Path) -> None:
    length = records_of(whole / "bag_0.mcap")[12].offset
    directory = cut(whole, tmp_path / "cut", length)
    with (directory / "bag_0.mcap").open("ab") as stream:
        stream.write(bytes(5000))
    report = recover(directory)
    check(directory, whole_messages(whole, length))
    assert report.files[0].lost_bytes == 5000


def test_long_recording_of_many_chunks(tmp_path: Path) -> None:
    """Whole, and again after its last chunk was cut: index, counts and times of all 400 chunks."""
    bag = BagWriter(tmp_path / "bag")
    a = bag.add_topic("/a", TYPE, definition=DEFINITION, type_hash=TYPE_HASH)
    for k in range(1200):
        bag.write(a, numbered(k), START_NS + k)
        if k % 3 == 2:
            bag.flush()
    bag.close()
    assert read_numbers(tmp_path / "bag")["/a"] == list(range(1200))
    assert read_numbers_with_mcap(bag.path)["/a"] == list(range(1200))
    assert not recover(tmp_path / "bag").changed
    last = [r for r in records_of(bag.path) if r.opcode == Opcode.CHUNK][-1]
    directory = cut(tmp_path / "bag", tmp_path / "cut", last.offset + 5)
    report = recover(directory)
    assert (report.files[0].start_ns, report.files[0].end_ns) == (START_NS, START_NS + 1196)
    assert read_numbers(directory)["/a"] == list(range(1197))
    assert read_numbers_with_mcap(directory / "bag_0.mcap")["/a"] == list(range(1197))


def test_metadata_comes_back_from_the_file_alone(whole: Path, tmp_path: Path) -> None:
    directory = cut(whole, tmp_path / "cut", (whole / "bag_0.mcap").stat().st_size - 30)
    assert recover(directory).metadata_rebuilt
    again, first = (yaml.safe_load((d / "metadata.yaml").read_text()) for d in (directory, whole))
    assert again == first


def test_whole_bag_is_left_alone(whole: Path, tmp_path: Path) -> None:
    directory = shutil.copytree(whole, tmp_path / "bag")
    before = {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in directory.iterdir()}
    report = recover(directory)
    assert not report.changed
    assert {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in directory.iterdir()} == before


def test_twice_is_once_and_the_original_stays(whole: Path, tmp_path: Path) -> None:
    directory = cut(whole, tmp_path / "cut", 20_000)
    original = (directory / "bag_0.mcap").read_bytes()
    first = recover(directory)
    after = {p.name: p.read_bytes() for p in directory.iterdir()}
    second = recover(directory)
    assert first.changed
    assert not second.changed
    assert (second.messages, second.topics) == (first.messages, first.topics)
    assert {p.name: p.read_bytes() for p in directory.iterdir()} == after
    assert (directory / "bag_0.mcap.cut").read_bytes() == original
    assert set(after) == {"bag_0.mcap", "bag_0.mcap.cut", "metadata.yaml"}


def test_output_leaves_the_original_untouched(whole: Path, tmp_path: Path) -> None:
    directory = cut(whole, tmp_path / "cut", 15_000)
    before = {p.name: p.read_bytes() for p in directory.iterdir()}
    report = recover(directory, tmp_path / "repaired")
    assert report.path == tmp_path / "repaired"
    assert {p.name: p.read_bytes() for p in directory.iterdir()} == before
    check(tmp_path / "repaired", whole_messages(whole, 15_000))


def test_single_file(whole: Path, tmp_path: Path) -> None:
    directory = cut(whole, tmp_path / "cut", 15_000)
    recover(directory / "bag_0.mcap")
    expected = whole_messages(whole, 15_000)
    assert read_numbers(directory / "bag_0.mcap")["/a"] == list(range(expected))
    assert not (directory / "metadata.yaml").exists()


def test_file_cut_by_another_writer_without_chunks(tmp_path: Path) -> None:
    """rosbag2's preset fastwrite writes messages without chunks and index."""
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
    assert report.messages == 100
    assert read_numbers(tmp_path / "fast.mcap") == {"/a": list(range(100))}
    assert read_numbers_with_mcap(tmp_path / "fast.mcap") == {"/a": list(range(100))}


@pytest.mark.parametrize("content", [b"", b"\x89MCAP", b"PK\3\4 this is a zip file", b"\x89MCAP0\r\n\x01\x20\0\0"])
def test_what_is_no_bag_is_refused_and_left_alone(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "x.mcap"
    file.write_bytes(content)
    with pytest.raises(RecoveryError, match=r"x\.mcap"):
        recover(file)
    assert file.read_bytes() == content
    assert list(tmp_path.iterdir()) == [file]


def test_missing_and_existing_places_are_refused(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(RecoveryError, match="does not exist"):
        recover(tmp_path / "nothing")
    with pytest.raises(RecoveryError, match=r"no \.mcap file"):
        recover(tmp_path)
    with pytest.raises(RecoveryError, match="never overwrites"):
        recover(whole, tmp_path)
