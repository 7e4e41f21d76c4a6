"""Another INS is one reader: its recordings are found, paired with CAN logs, named in a run.yaml and read like NCOM."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from raw_drives import LEAF, write_drives
from st_core.vehicle import VehicleParameters
from st_recordings.runs import ReadSettings, RunError, RunSource, find_runs, read
from st_recordings.runs.ncom import read_ncom
from st_recordings.runs.raw import read_raw_run
from st_recordings.runs.readers import READERS, Reader, register
from st_recordings.runs.write import import_run


@pytest.fixture
def another_ins() -> Iterator[Reader]:
    def read_ins(source, settings):
        return read_ncom(source.where)

    yield register(Reader("another", "ins", (".other",), read_raw_run, read_ins, lacks_steering=None))
    del READERS["another"]


def test_a_drive_of_another_ins(tmp_path: Path, another_ins: Reader) -> None:
    folder = write_drives(tmp_path, {}, 0, (("sweep", 26.0),)) / "sweep"
    leaf = VehicleParameters.from_yaml(LEAF.read_text(), "leaf")
    (known,) = find_runs([folder])
    (folder / "run.ncom").rename(folder / "run.other")
    (found,) = find_runs([folder])
    assert (known.kind, found.kind) == ("ncom", "another") and found.can == known.can
    (folder / "run.other").rename(folder / "run.ncom")
    expected = read(known, leaf)
    (folder / "run.ncom").rename(folder / "run.other")
    got = read(found, leaf)
    assert got.provenance["reader"] == "another and CAN log"
    assert np.array_equal(got.log.x, expected.log.x) and np.array_equal(got.log.yaw_rate, expected.log.yaw_rate)
    (folder / "run.yaml").write_text("ins: run.other\ncan: run.log\n")
    (named,) = find_runs([folder / "run.yaml"])
    assert named.kind == "another" and named.problem is None


def test_import_says_what_it_is_for(tmp_path: Path, another_ins: Reader) -> None:
    leaf = VehicleParameters.from_yaml(LEAF.read_text(), "leaf")
    source = RunSource("drive", "another", (tmp_path / "run.other",))
    with pytest.raises(RunError, match=r"import converts NCOM packets.*this run is another.*read it directly"):
        import_run(source, leaf, tmp_path / "bag", ReadSettings(), lambda drive: ())


def test_two_readers_of_one_name_are_refused(another_ins: Reader) -> None:
    with pytest.raises(ValueError, match="another: two readers"):
        register(another_ins)
