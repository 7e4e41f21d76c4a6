"""CSV drives: the Genesis recordings, and files that are nearly right."""

from pathlib import Path

import numpy as np
import pytest
from st_recordings.runs.csv import has_drive_columns, read_csv, read_motion
from st_recordings.runs.errors import RunError
from support import EXAMPLES, KEPT

HEADER = "t,x,y,yaw,vx,vy,yaw_rate,ax,ay,delta"


def rows(n: int) -> list[str]:
    return [f"{0.02 * k:.3f},{0.2 * k:.3f},0,0.1,10,0,0.01,0,0,0.002" for k in range(n)]


def write(folder: Path, lines: list[str], end: str = "\n", name: str = "drive.csv") -> Path:
    file = folder / name
    file.write_text("\n".join(lines) + end)
    return file


def test_a_real_drive() -> None:
    drive = read_csv(EXAMPLES / "rfs_turn_a.csv")
    log, warnings = drive.log, drive.warnings
    assert (len(log.ins_time_ns), log.duration) == (2026, pytest.approx(40.51, abs=1e-6))
    assert not warnings
    assert log.steering_wheel_angle is None
    assert log.velocity_x.max() == pytest.approx(12.5, abs=0.05)
    assert np.abs(log.velocity_x * log.yaw_rate).max() == pytest.approx(2.9, abs=0.05)
    assert np.abs(log.road_wheel_angle).max() == pytest.approx(0.21, abs=0.005)


def test_an_ins_log_for_alignment() -> None:
    file = KEPT / "can/synthetic_rt_own_log.csv"
    motion, _ = read_motion(file)
    assert not motion.absolute
    turning = np.gradient(np.unwrap(motion.yaw), motion.time_ns * 1e-9)
    assert motion.yaw_rate.max() == pytest.approx(turning.max(), rel=0.01)
    assert not has_drive_columns(file)


def test_rows_that_cannot_be_used_are_left_out_and_counted(tmp_path: Path) -> None:
    lines = rows(100)
    lines[50] = lines[49]  # twice
    lines[60] = lines[60].replace("10,0,0.01", ",0,0.01")  # a hole
    drive = read_csv(write(tmp_path, [HEADER, *lines, "2.0"], end=""))
    log, warnings = drive.log, drive.warnings
    assert len(log.ins_time_ns) == 98
    assert [w.split(": ", 1)[1] for w in warnings] == [
        "the last row is cut; it was left out",
        "1 of 100 rows (1 %) are not newer than all before; they were left out",
        "velocity_x (column vx): 1 of 100 rows (1 %) have no number; these samples of the INS were left out",
    ]


def test_semicolons_and_other_column_orders(tmp_path: Path) -> None:
    names = HEADER.split(",")
    order = [3, 0, 9, 1, 2, 4, 5, 6, 7, 8]
    lines = [";".join(np.array(line.split(","))[order]) for line in [HEADER, *rows(20)]]
    log = read_csv(write(tmp_path, lines)).log
    assert names[3] == "yaw"
    assert (log.yaw == 0.1).all()
    assert (log.road_wheel_angle == 0.002).all()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([""], "no column of the header is known as t, x"),
        (["t,x,y,yaw", "0,0,0,0"],
         "no column of the header is known as velocity_x, .*; it has t, x, y, yaw; .*columns: {velocity_x: NAME"),
        ([HEADER], "fewer than two usable rows"),
        ([HEADER, *rows(3), *["1,2,3"] * 7, *rows(3)], "a row cannot be read"),
        ([HEADER, *rows(1), *["a,b,c,d,e,f,g,h,i,j"] * 3], "fewer than two usable rows"),
    ],
)
def test_files_that_cannot_be_used(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(RunError, match=rf"drive\.csv: {message}"):
        read_csv(write(tmp_path, lines))


def test_a_binary_file_called_csv(tmp_path: Path) -> None:
    file = tmp_path / "drive.csv"
    file.write_bytes(b"\xe7\xff\x80" * 100)
    with pytest.raises(RunError, match="this is not a text file"):
        read_csv(file)
