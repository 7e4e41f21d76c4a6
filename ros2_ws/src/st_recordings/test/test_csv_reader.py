"""Drives in CSV files: a real recording, faulty rows, times and units in unusual forms."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from drives import read_csv
from scipy.spatial.transform import Rotation
from st_recordings.runs import find_runs, read
from st_recordings.runs.columns import Layout
from st_recordings.runs.csv import (
    MOTION_SIGNALS,
    _count_missing_samples,
    _is_rounded,
    build_ins_log,
    find_missing_in_header,
)
from st_recordings.runs.csv_table import read_table, read_text
from st_recordings.runs.errors import RunError
from st_recordings.runs.ins_log import select_usable_rows, yaw_from_quaternion
from st_recordings.runs.table_times import month_number
from support import EXAMPLES, GOLDEN_DATA

HEADER = "t,x,y,yaw,vx,vy,yaw_rate,ax,ay,delta"


def rows(n: int) -> list[str]:
    return [f"{0.02 * k:.3f},{0.2 * k:.3f},0,0.1,10,0,0.01,0,0,0.002" for k in range(n)]


def write(folder: Path, lines: list[str], end: str = "\n", name: str = "drive.csv") -> Path:
    file = folder / name
    file.write_text("\n".join(lines) + end)
    return file


def test_real_drive() -> None:
    drive = read_csv(EXAMPLES / "rfs_turn_a.csv")
    log, warnings = drive.log, drive.warnings
    assert (len(log.ins_time_ns), log.duration) == (2026, pytest.approx(40.51, abs=1e-6))
    assert not warnings
    assert log.steering_wheel_angle is None
    assert log.velocity_x.max() == pytest.approx(12.5, abs=0.05)
    assert np.abs(log.velocity_x * log.yaw_rate).max() == pytest.approx(2.9, abs=0.05)
    assert np.abs(log.road_wheel_angle).max() == pytest.approx(0.21, abs=0.005)


@pytest.mark.parametrize(("text", "encoding"), [
    ("时间 (s)", "gbk"), ("Größe [°/s²]", "cp1252"), ("Zeit äöü", "utf-8"), ("Temp µ°C", "cp1252"), ("时间", "utf-16")])
def test_encoding_of_a_text_is_found(tmp_path: Path, text: str, encoding: str) -> None:
    (tmp_path / "a.csv").write_bytes(f"t,{text}\n".encode(encoding))
    assert read_text(tmp_path / "a.csv") == f"t,{text}\n"


@pytest.mark.parametrize("length", [0.0, 0.5, 1.0, 3.0])
def test_yaw_of_quaternions_does_not_depend_on_their_length(length: float) -> None:
    rotations = Rotation.from_euler("ZYX", [[0.8, 0.1, -0.2], [-3.0, -0.3, 0.1]])
    yaw = yaw_from_quaternion(*(length * rotations.as_quat().T))
    np.testing.assert_allclose(yaw, [0.8, -3.0] if length else [np.nan, np.nan])


def test_table_without_positions_gives_an_ins_log_for_alignment() -> None:
    file = GOLDEN_DATA / "can/synthetic_rt_own_log.csv"
    ins = build_ins_log(read_table(file, Layout()), MOTION_SIGNALS)
    assert not ins.is_utc
    yaw_rate = np.gradient(np.unwrap(ins.values["yaw"]), ins.time_ns * 1e-9)
    assert ins.values["yaw_rate"].max() == pytest.approx(yaw_rate.max(), rel=0.01)
    assert find_missing_in_header(file)


def test_unusable_rows_are_left_out_and_counted(tmp_path: Path) -> None:
    lines = rows(100)
    lines[50] = lines[49]  # repeated
    lines[60] = lines[60].replace("10,0,0.01", ",0,0.01")  # a missing value
    drive = read_csv(write(tmp_path, [HEADER, *lines, "2.0"], end=""))
    log, warnings = drive.log, drive.warnings
    assert len(log.ins_time_ns) == 98
    assert [w.split(": ", 1)[1] for w in warnings] == [
        "the last row is truncated and was left out",
        "1 of 100 rows (1 %) are not later than those before them; they were left out",
        "velocity_x (column vx): 1 of 100 rows (1 %) have no number; these INS samples were left out",
    ]


def test_quoted_texts_between_bars_are_kept(tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text('"t"|"place"|"x"\n"0.5"|"north"|1.5|2.5\n')
    assert read_text(tmp_path / "d.csv").endswith('"0.5"|"north"|1.5|2.5\n')


@pytest.mark.parametrize(("row", "time", "reason"), [
    (3, 505, "out of order in time"), (99, 975, "not later than those before them")])
def test_reason_why_a_row_is_left_out(row: int, time: int, reason: str) -> None:
    times = 10 * np.arange(100)
    times[row] = time
    selected, warnings = select_usable_rows(times, "rows")
    assert selected.tolist() == [k for k in range(100) if k != row]
    assert warnings == [f"1 of 100 rows (1 %) are {reason}; they were left out"]


def test_semicolons_and_other_column_orders(tmp_path: Path) -> None:
    order = [3, 0, 9, 1, 2, 4, 5, 6, 7, 8]
    lines = [";".join(np.array(line.split(","))[order]) for line in [HEADER, *rows(20)]]
    log = read_csv(write(tmp_path, lines)).log
    assert (log.yaw == 0.1).all()
    assert (log.road_wheel_angle == 0.002).all()


@pytest.mark.parametrize(("lines", "message"), [
    ([""], "it contains nothing but blanks or zero bytes; copy it again"),
    (["t,vx,vy,yaw_rate,delta", *["0,1,0,0,0"] * 3], "no .*; if no position was recorded, add columns x, y and yaw"),
    (["t,x,y,yaw", "0,0,0,0"],
     "no column was recognised as velocity_x, .*; its columns are t, x, y, yaw; .*columns: {velocity_x: NAME"),
    ([HEADER], "it contains fewer than two usable rows"),
    ([HEADER, *rows(3), *["1,2,3"] * 7, *rows(3)],
     r"7 of 13 rows \(54 %\) do not have as many cells as the header; export it with a cell for every column"),
    ([HEADER, *rows(1), *["a,b,c,d,e,f,g,h,i,j"] * 3], "it contains fewer than two usable rows"),
])
def test_unusable_file_is_rejected(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(RunError, match=rf"drive\.csv: {message}"):
        read_csv(write(tmp_path, lines))


@pytest.mark.parametrize(("first", "delimiter"), [(6, ","), (0, "\t"), (6, "\t")])
def test_delimiter_at_the_end_of_rows_is_ignored(tmp_path: Path, first: int, delimiter: str) -> None:
    lines = [HEADER, *(row + "," * (number >= first) for number, row in enumerate(rows(20)))]
    drive = read_csv(write(tmp_path, [line.replace(",", delimiter) for line in lines]))
    assert len(drive.log.ins_time_ns) == 20 and not drive.warnings


@pytest.mark.parametrize(("cells", "ending", "n_names"), [
    ([",first", *[","] * 9], "\n", 4), ([",12"] * 10, "\n", 4), ([",12"] * 10, "", 4), ([",12"] * 9 + [""], "", 4),
    ([""] * 10, "\n", 3), ([",first", *[""] * 9], "\n", 3), ([], "", 3)])
def test_last_column_is_left_out_if_its_cells_are_missing(tmp_path: Path, cells: list[str], ending: str,
                                                          n_names: int) -> None:
    lines = ["t,x,y,Comment", *(f"{k / 10},{k}.5,2.5{cell}" for k, cell in enumerate(cells))]
    (tmp_path / "a.csv").write_text("\n".join(lines) + ending)
    table = read_table(tmp_path / "a.csv", Layout())
    assert len(table.names) == n_names and len(table.time_ns) >= len(cells) - 1


@pytest.mark.filterwarnings("error")
def test_blank_fractions_of_seconds_cause_no_message_of_numpy(tmp_path: Path) -> None:
    lines = [f"{1_700_000_000 + k},,{row.partition(',')[2]}" for k, row in enumerate(rows(50))]
    table = read_table(write(tmp_path, [HEADER.replace("t,", "secs,nsecs,", 1), *lines]), Layout())
    assert np.ptp(table.time_ns) == 49 * 10**9


def test_times_in_days_of_a_spreadsheet(tmp_path: Path) -> None:
    days = [f"{46146.43 + 0.02 * k / 86400:.9f},{line.partition(',')[2]}" for k, line in enumerate(rows(100))]
    file = write(tmp_path, ["DateTime," + HEADER.partition(",")[2], *days])
    drive = read_csv(file)
    first = datetime(1899, 12, 30, tzinfo=UTC) + timedelta(days=46146.43)
    assert drive.log.ins_time_ns[0] * 1e-9 == pytest.approx(first.timestamp(), abs=1e-4)
    assert np.diff(drive.log.ins_time_ns) == pytest.approx(0.02e9, abs=1e5)
    assert "spreadsheet date numbers" in drive.warnings[0]


def test_ins_log_for_alignment_keeps_rows_without_a_position(tmp_path: Path) -> None:
    lines = [",".join([*(row := line.split(","))[:1], *(row[1:3] if k % 20 == 0 else ("", "")), *row[3:]])
             for k, line in enumerate(rows(400))]
    ins = build_ins_log(read_table(write(tmp_path, [HEADER, *lines]), Layout()), MOTION_SIGNALS)
    assert len(ins.time_ns) == 400 and "x 20 of 400 rows (5 %), y 20 of 400 rows (5 %)" in "".join(ins.warnings)


def test_east_and_north_velocities_require_the_yaw(tmp_path: Path) -> None:
    lines = [f"{0.02 * k:.2f},10,1,0.01" for k in range(100)]
    table = read_table(write(tmp_path, ["t,velocity_east,velocity_north,yaw_rate", *lines]), Layout())
    with pytest.raises(RunError, match="velocity_x"):
        build_ins_log(table, MOTION_SIGNALS)


def test_seconds_in_steps_of_tenths_are_not_days_of_a_spreadsheet(tmp_path: Path) -> None:
    lines = [f"{40000.0 + k // 10 * 0.1:.1f},{0.1 * k:.3f},0,0.1,10,0,0.01,0,0,0.002" for k in range(600)]
    log = read_csv(write(tmp_path, [HEADER, *lines])).log
    assert log.duration == pytest.approx(5.9, abs=0.01)


def test_times_without_seconds_are_rejected(tmp_path: Path) -> None:
    lines = [f"04.05.2026 10:{k // 60:02d}," + line.split(",", 1)[1] for k, line in enumerate(rows(180))]
    with pytest.raises(RunError, match=r"no time in column t can be read; the first is '04\.05\.2026 10:00'; export"):
        read_csv(write(tmp_path, [HEADER, *lines]))


def test_first_new_position_after_lost_rows_is_not_interpolated_to(tmp_path: Path) -> None:
    lines = [f"{0.01 * k:.3f},{0.2 * (k // 10 * 10):.3f},0,0,20,0,0,0,0,0" for k in range(400)]
    del lines[118:128], lines[239:244]
    log = read_csv(write(tmp_path, [HEADER, *lines])).log
    np.testing.assert_allclose(log.x, 20.0 * log.ins_time_ns * 1e-9, atol=1e-6)


@pytest.mark.parametrize("steps", [1, 10])
@pytest.mark.parametrize("rest", [0, 300])
def test_outage_of_the_positions_is_not_interpolated(tmp_path: Path, steps: int, rest: int) -> None:
    known = [k // steps * steps if k < 200 or k >= 600 else 190 for k in range(600 + rest)]
    drive = read_csv(write(tmp_path, [HEADER, *(f"{0.01 * k:.2f},{0.2 * row:.3f},0,0,20,0,0,0,0,0"
                                                for k, row in enumerate(known))]))
    moved = 0.2 * np.arange(600 + rest)
    assert drive.log.x[:190] == pytest.approx(moved[:190], abs=1e-6)
    assert drive.log.x[200:600] == pytest.approx(38.0)
    assert drive.log.x[600:] == pytest.approx(moved[600:], abs=1e-6)
    assert "repeat a position for a long time" in "".join(drive.warnings)


def test_missing_rows_are_no_outage_of_the_positions(tmp_path: Path) -> None:
    lines = [f"{0.01 * k:.2f},{0.2 * (k // 10 * 10):.3f},0,0,20,0,0,0,0,0" for k in range(1200)]
    del lines[405:615]
    drive = read_csv(write(tmp_path, [HEADER, *lines]))
    assert drive.log.x == pytest.approx(20.0e-9 * drive.log.ins_time_ns, abs=1e-6)
    assert "repeat a position" not in "".join(drive.warnings)


@pytest.mark.parametrize("speed", [10.0, 20.0])
def test_positions_held_for_a_second_at_constant_speed_are_interpolated(tmp_path: Path, speed: float) -> None:
    """Each step is 10 or 20 m and nothing else, as if a position were rounded to tens of metres."""
    drive = read_csv(write(tmp_path, [HEADER, *(f"{0.01 * k:.2f},{speed * (k // 100)},0,0,{speed},0,0,0,0,0"
                                                for k in range(2000))]))
    assert drive.log.x == pytest.approx(speed * 0.01 * np.arange(2000), abs=1e-6)
    assert any("about 1 Hz; the positions of the other rows were interpolated" in w for w in drive.warnings)


@pytest.mark.parametrize(("start", "wrong", "text"), [
    (3590.0, 995, False), (604790.0, 5, False), (86390.0, 5, False), (45296.0, 5, True), (101112.0, 5, False)],
    ids=["last second of an hour", "end of a week", "end of a day", "text", "HHMMSS"])
def test_time_of_zero_is_no_rollover(tmp_path: Path, start: float, wrong: int, text: bool) -> None:
    times = [start + 0.01 * k if k != wrong else 0.0 for k in range(900 if start != 3590.0 else 1000)]
    stamps = [f"{int(t // 3600):02d}:{int(t // 60 % 60):02d}:{t % 60:06.3f}" if text else f"{t:.2f}" for t in times]
    drive = read_csv(write(tmp_path, [HEADER, *(f"{stamp},{0.2 * k:.3f},0,0,20,0,0,0,0,0"
                                                for k, stamp in enumerate(stamps))]))
    assert len(drive.log.x) == len(times) - 1
    assert np.ptp(drive.log.ins_time_ns) == round((times[-1] - times[0]) * 100) * 10**7


@pytest.mark.parametrize("text", [True, False])
def test_pause_of_half_a_day_after_midnight_is_no_step_back_in_time(tmp_path: Path, text: bool) -> None:
    times = [86390.0 + 0.01 * k for k in range(1500)] + [86400.0 + 46800.0 + 0.01 * k for k in range(1500)]
    clock = [(int(t % 86400 // 3600), int(t // 60 % 60), t % 60) for t in times]
    stamps = [f"{h:02d}:{m:02d}:{s:06.3f}" if text else f"{h:02d}{m:02d}{s:05.2f}" for h, m, s in clock]
    drive = read_csv(write(tmp_path, [HEADER, *(f"{stamp},{0.2 * k:.3f},0,0,20,0,0,0,0,0"
                                                for k, stamp in enumerate(stamps))]))
    assert np.ptp(drive.log.ins_time_ns) == pytest.approx((times[-1] - times[0]) * 1e9, abs=1e6)
    assert not any("set back" in warning for warning in drive.warnings)


def test_two_drives_of_a_minute_in_one_file_are_not_joined(tmp_path: Path) -> None:
    seconds = np.arange(6000) * 0.01
    file = write(tmp_path, [HEADER, *(f"{t:.2f},{t:.2f},0,0.1,1,0,0,0,0,0.1" for t in (*seconds, *seconds))])
    table = read_table(file, Layout())
    assert table.is_usable.sum() == 6000 and "the clock was set back by 59.990 s" in table.warnings[0]


@pytest.mark.parametrize("per_second", [10**9, 10**6, 10**3])
def test_fractions_of_seconds_without_leading_zeros(tmp_path: Path, per_second: int) -> None:
    stamps = [f"{12 + k // 50}.{k % 50 * per_second // 50}" for k in range(300)]
    file = write(tmp_path, [HEADER, *(f"{stamp},{k},0,0.1,1,0,0,0,0,0.1" for k, stamp in enumerate(stamps))])
    table = read_table(file, Layout())
    np.testing.assert_allclose(table.time_ns[table.is_usable], 12e9 + np.arange(300) * 20e6)
    assert "zeros were added after the decimal point of its times, as in 12.02" in table.warnings[0]
    lines = file.read_text().splitlines()
    write(tmp_path, [*lines[:99], lines[98], lines[99][:12], *lines[100:]])  # a duplicate row and a truncated one
    again = read_table(file, Layout())
    assert np.array_equal(again.time_ns[again.is_usable], np.delete(table.time_ns[table.is_usable], 98))


@pytest.mark.parametrize(("unit", "step"), [("min", 1 / 6000), ("h", 1 / 360000), ("ms", 1.0)])
def test_steps_of_times_in_another_unit_cause_a_warning(tmp_path: Path, unit: str, step: float) -> None:
    file = write(tmp_path, [HEADER, *(f"{k * step:.8f},{k},0,0.1,1,0,0,0,0,0.1" for k in range(300))])
    assert read_table(file, Layout()).warnings[0].endswith(f"units: {{t: {unit}}}")


@pytest.mark.parametrize("cells", [[f"{150 - k // 2}" for k in range(103)],
                                   [f"{-1.0 + 0.01 * k:.2f}" for k in range(101)]])
def test_short_last_cell_is_complete(tmp_path: Path, cells: list[str]) -> None:
    file = write(tmp_path, [HEADER + ",extra", *(f"{0.01 * k:.2f},{0.2 * k:.3f},0,0,20,0,0,0,0,0,{cell}"
                                                 for k, cell in enumerate(cells))])
    file.write_text(file.read_text().rstrip("\n"))
    assert len(read_csv(file).log.x) == len(cells)


@pytest.mark.parametrize("origin", [0.0, 3.456])
def test_rounded_positions_are_recognised(origin: float) -> None:
    rounded = np.round(np.cumsum(np.full(3000, 0.02)) + 0.3 * np.sin(np.arange(3000) / 200.0), 1) - origin
    rounded[1500] += 0.037  # a wrong row
    assert _is_rounded(rounded)
    assert not _is_rounded(np.cumsum(np.random.default_rng(0).normal(1.0, 0.05, 3000)))


def test_number_cut_at_the_end_of_a_file_is_left_out(tmp_path: Path) -> None:
    file = write(tmp_path, [HEADER, *(f"{0.01 * k:.2f},{0.2 * k:.3f},0,0,20,0,0,0,0,0.123" for k in range(100))])
    complete = file.read_text().rstrip("\n")
    for text, count in ((complete, 100), (complete[:-1], 99)):
        file.write_text(text)
        drive = read_csv(file)
        assert len(drive.log.x) == count
        assert any("the last row ends within a number" in w for w in drive.warnings) == (count == 99)


@pytest.mark.parametrize(("factor", "origin", "meaning"), [
    (86400.0, 2440587.5, "Julian dates"), (86400.0, 719529.0, "MATLAB date numbers"), (1e-3, 0.0, "")])
def test_day_numbers_and_32_bit_milliseconds(tmp_path: Path, factor: float, origin: float, meaning: str) -> None:
    start = 1_756_918_800.0 if meaning else 2**32 * 1e-3 - 4.0
    times = (start + 0.05 * np.arange(200)) / factor + origin
    header = HEADER if meaning else HEADER.replace("t,", "t [ms],", 1)
    drive = read_csv(write(tmp_path, [header, *(f"{t if meaning else t % 2**32:.12f},{k:.3f},0,0,20,0,0,0,0,0"
                                                for k, t in enumerate(times))]))
    assert len(drive.log.x) == 200
    assert np.diff(drive.log.ins_time_ns) * 1e-9 == pytest.approx(0.05, abs=1e-4)
    assert any(f"{meaning} (UTC)" in w for w in drive.warnings) == bool(meaning)


@pytest.mark.parametrize(("name", "number"), [
    ("Jan", 1), ("ene.", 1), ("styczeń", 1), ("März", 3), ("maart", 3), ("mrt", 3), ("mei", 5), ("juin", 6),
    ("juni", 6), ("juillet", 7), ("lip", 7), ("août", 8), ("września", 9), ("paź", 10), ("des", 12),
    ("grudnia", 12), ("xyz", None), ("kvě", 5), ("toukokuuta", 5), ("marras", 11), ("май", 5), ("Ara", 12), ("5月", 5)])
def test_month_names_of_several_languages(name: str, number: int | None) -> None:
    assert month_number(name) == number


@pytest.mark.parametrize(("stamp", "hour"), [
    ("Mon May 04 12:00:{} GMT+02:00 2026", 10), ("Mon May 4 12:00:{} CEST 2026", 10), ("May 04 12:00:{} 2026", 12),
    ("Mon May  4 12:00:{} 2026", 12)])
def test_date_with_the_year_at_the_end(tmp_path: Path, stamp: str, hour: int) -> None:
    lines = [f"{stamp.format(f'{0.02 * k:06.3f}')},{line.split(',', 1)[1]}" for k, line in enumerate(rows(200))]
    log = read_csv(write(tmp_path, [HEADER, *lines])).log
    assert log.ins_time_ns[0] * 1e-9 == pytest.approx(datetime(2026, 5, 4, hour, tzinfo=UTC).timestamp())


@pytest.mark.parametrize("month", ["ene", "jan", "sty"])
def test_date_with_a_month_name(tmp_path: Path, month: str) -> None:
    lines = [f"04-{month}-2026 10:11:{12 + 0.02 * k:06.3f},{line.split(',', 1)[1]}" for k, line in enumerate(rows(200))]
    log = read_csv(write(tmp_path, [HEADER, *lines])).log
    assert log.ins_time_ns[0] * 1e-9 == pytest.approx(datetime(2026, 1, 4, 10, 11, 12, tzinfo=UTC).timestamp())


def test_zeros_in_the_middle_of_a_file_cost_one_row(tmp_path: Path) -> None:
    lines = rows(200)
    lines[100] = lines[100][:9] + "\0" * 300_000 + lines[100][9:]
    assert len(read_csv(write(tmp_path, [HEADER, *lines])).log.x) == 199


@pytest.mark.parametrize("cell", ['"lost', 'lost"', '"a""b"', '"a,b"', '"a" b'])
def test_quotes_in_a_cell_cost_no_row(tmp_path: Path, cell: str) -> None:
    lines = [f"{row},{cell if k == 50 else 'good'}" for k, row in enumerate(rows(200))]
    assert len(read_csv(write(tmp_path, [f"{HEADER},note", *lines])).log.x) == 200


def test_rows_with_repeated_times_are_left_out(tmp_path: Path) -> None:
    lines = [line for line in rows(40) for _ in range(3)]
    drive = read_csv(write(tmp_path, [HEADER, *lines]))
    assert len(drive.log.ins_time_ns) == 40
    assert "80 of 120 rows (67 %) are not later" in drive.warnings[0]


@pytest.mark.parametrize("row", [f"[],{','.join(['[m]'] * 2)},[rad],,,,,,[deg]", "-,m,m,rad,,,,,,deg"])
def test_row_of_units_without_a_unit_of_time(tmp_path: Path, row: str) -> None:
    log = read_csv(write(tmp_path, [HEADER, row, *rows(20)])).log
    assert len(log.x) == 20 and log.road_wheel_angle[0] == pytest.approx(np.deg2rad(0.002))


@pytest.mark.parametrize("named", ["EPS_Pos", "EPS_Pos [deg]", "eps pos"])
@pytest.mark.parametrize("column", ["EPS_Pos [deg]", "EPS_Pos"])
def test_layout_names_a_column_with_or_without_its_unit(tmp_path: Path, named: str, column: str) -> None:
    file = write(tmp_path, [HEADER.replace("delta", column), *rows(20)])
    log = read_csv(file, layout=Layout({"road_wheel_angle": named})).log
    degrees = "deg" in named or "deg" in column
    assert log.road_wheel_angle[0] == pytest.approx(0.002 * (np.pi / 180 if degrees else 1.0))


def test_table_without_steering_is_rejected_with_the_option_that_names_it(tmp_path: Path) -> None:
    file = write(tmp_path, [HEADER.replace("delta", "EPS_Pos"), *rows(20)])
    with pytest.raises(RunError, match=r"recognised as road_wheel_angle \(or steering_wheel_angle\).*--steering-field"):
        read_csv(file)


def test_binary_file_with_the_extension_csv_is_rejected(tmp_path: Path) -> None:
    file = tmp_path / "drive.csv"
    file.write_bytes(b"\xe7\xff\x80" * 100)
    with pytest.raises(RunError, match="this is not a text file"):
        read_csv(file)


def test_lost_samples_of_a_slower_channel_are_counted_by_rows():
    """Steering in every second row, of which one sample in seven is lost: the blanks in between are no losses."""
    time_ns, column = np.arange(1000) * 10_000_000, np.full(1000, np.nan)
    column[::2] = 1.0
    column[0:-2:14] = np.nan
    column[[0, 998]] = 1.0
    lost = 500 - int(np.isfinite(column).sum())
    assert lost > 60 and _count_missing_samples(time_ns, column) == lost


def test_lost_samples_of_a_channel_with_its_own_times_are_counted_and_not_estimated():
    """The times of the channel jitter, or become less frequent; other channels have 3000 rows between them."""
    generator, n = np.random.default_rng(1), 3000
    for jitter, steps in ((0.3, np.full(n, 0.01)), (0.0, np.where(np.arange(n) < 1800, 0.01, 0.0149))):
        own = np.cumsum(steps) + 0.01 * jitter * generator.uniform(-0.5, 0.5, n)
        times = np.concatenate([own, np.linspace(own[0] + 1e-4, own[-1] - 1e-4, n)])
        order = np.argsort(times)
        time_ns, column = (times[order] * 1e9).astype(np.int64), np.where(order < n, 1.0, np.nan)
        rows = np.flatnonzero(order < n)
        for lost in (0, 150):
            column[rows[20 : 20 + 7 * lost : 7]] = np.nan
            assert _count_missing_samples(time_ns, column) == lost


@pytest.mark.parametrize("n_wrong", [1, 20])
def test_parked_car_with_wrong_positions_is_read(tmp_path: Path, n_wrong: int) -> None:
    rows = [f"{0.01 * k:.2f},0,{300 if 1500 <= k < 1500 + n_wrong else 0},0,0,0,0,0,0,0" for k in range(3000)]
    write(tmp_path, [HEADER, *rows])
    assert not read(find_runs([tmp_path])[0]).log.velocity_x.any()


def test_moving_car_without_velocity_is_refused(tmp_path: Path) -> None:
    write(tmp_path, [HEADER, *(f"{0.01 * k:.2f},{0.05 * k:.2f},0,0,0,0,0,0,0,0" for k in range(1000))])
    with pytest.raises(RunError, match=r"its velocity is 0 in all samples, although its positions extend over 49 m"):
        read(find_runs([tmp_path])[0])
