"""A registered reader of another INS: its recordings are found, paired with CAN logs, named in a run.yaml and read."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from drive_kinds import CAR
from st_core.log import DriveLog
from st_recordings.runs import ReadSettings, RunError, RunSource, find_runs, read
from st_recordings.runs.ncom import read_ncom
from st_recordings.runs.readers import READERS, Reader, find_reader, register
from st_recordings.runs.write import import_run


@pytest.fixture
def another_ins() -> Iterator[Reader]:
    def read_ins(source, settings):
        return read_ncom(source.path)

    reader = Reader("another", "ins", (".other",), None, read_ins)
    register(reader)
    yield reader
    del READERS["another"]


def test_recording_of_another_ins_is_read(tmp_path: Path, drive_folder: Path, drive_log: DriveLog,
                                          another_ins: Reader) -> None:
    shutil.copy(drive_folder / "run.ncom", tmp_path / "run.other")
    shutil.copy(drive_folder / "run.log", tmp_path)
    (found,) = find_runs([tmp_path])
    assert (found.kind, found.can) == ("another", (tmp_path / "run.log",))
    run = read(found, CAR)
    assert run.provenance["reader"] == "another and CAN log"
    assert np.array_equal(run.log.x, drive_log.x) and np.array_equal(run.log.yaw_rate, drive_log.yaw_rate)
    (tmp_path / "run.yaml").write_text("ins: run.other\ncan: run.log\n")
    (named,) = find_runs([tmp_path / "run.yaml"])
    assert named.kind == "another" and named.problem is None


def test_import_of_another_ins_is_rejected(tmp_path: Path, another_ins: Reader) -> None:
    source = RunSource("drive", "another", (tmp_path / "run.other",))
    with pytest.raises(RunError, match=r"import converts NCOM packets.*this run is another.*read it directly"):
        import_run(source, CAR, tmp_path / "bag", ReadSettings(), lambda drive: ())


def test_two_readers_of_one_name_are_rejected(another_ins: Reader) -> None:
    with pytest.raises(ValueError, match="another: two readers"):
        register(another_ins)


def test_reader_of_a_key_is_the_one_that_accepts_the_file_or_the_first_one() -> None:
    assert find_reader(Path("run.unknown")) is None and find_reader(Path("run.unknown"), "unknown") is None
    (first, *_) = (reader for reader in READERS.values() if reader.key == "csv")
    assert find_reader(Path("run.unknown"), "csv") is first
    assert find_reader(Path("run.ncom"), "ins").accepts(Path("run.ncom"))
