"""One simulated drive of the Leaf, shared by the tests of file formats."""

from pathlib import Path

import pytest
from st_core.log import DriveLog


@pytest.fixture(scope="session")
def drive_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with run.ncom and run.log of a sweep of 26 s. Not to be changed."""
    from raw_drives import write_drives

    return write_drives(tmp_path_factory.mktemp("drive"), {}, 0, (("sweep", 26.0),)) / "sweep"


@pytest.fixture(scope="session")
def drive_log(drive_folder: Path) -> DriveLog:
    """The drive as read from run.ncom and run.log."""
    from drive_kinds import CAR
    from st_recordings.runs import find_runs, read

    return read(find_runs([drive_folder])[0], CAR).log
