"""Columns of CSV files: every known name and unit, declared ones, missing values, only the steering wheel angle."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from canedge_bridge.units import UNITS, normalise
from drive_kinds import CAR
from drives import read_csv
from st_core.log import INS_SIGNALS, DriveLog
from st_recordings.runs import LoadedRun, RunError, columns, find_runs, read
from st_recordings.runs.columns import COLUMNS, Layout, find_columns
from st_recordings.runs.csv import find_missing_in_header
from support import ROOT

N = 60
PLAIN = {"t": "t", "x": "x", "y": "y", "yaw": "yaw", "velocity_x": "vx", "velocity_y": "vy", "yaw_rate": "yaw_rate",
         "acceleration_x": "ax", "acceleration_y": "ay", "road_wheel_angle": "delta"}


def values() -> dict[str, np.ndarray]:
    """Channels in SI units, no two of them equal."""
    t = 0.02 * np.arange(N)
    wheel = 0.5 * np.sin(3 * t)
    return {"t": t, "x": 7 * t, "y": np.sin(t), "yaw": 3.0 + t, "compass_heading": np.pi / 2 - 3.0 - t,
            "velocity_x": 7 + t, "velocity_y": 0.2 * np.cos(t), "yaw_rate": 0.3 * np.cos(t),
            "acceleration_x": 0.1 + t, "acceleration_y": 2 * np.cos(t), "steering_wheel_angle": wheel,
            "road_wheel_angle": CAR.road_wheel_angle(wheel),
            "wheel_speed_front_left": 6.5 + t, "wheel_speed_front_right": 7.1 + t, "wheel_speed_rear_left": 6.8 + t,
            "wheel_speed_rear_right": 7.2 + t, "vehicle_speed": 7.05 + t}


def write(file: Path, names: Mapping[str, str], units: Mapping[str, str] | None = None, delimiter: str = ",",
          data: Mapping[str, np.ndarray] | None = None) -> Path:
    """Writes columns (channel -> name) of data, by default values(), in the given units, otherwise in SI units."""
    given = data or values()
    cells = [given[c] / UNITS[COLUMNS[c].kind][unit][0] if (unit := (units or {}).get(c)) else given[c] for c in names]
    lines = [delimiter.join(names.values()), *(delimiter.join(f"{v:.12g}" for v in row)
                                               for row in zip(*cells, strict=True))]
    file.write_text("\n".join(lines) + "\n")
    return file


def replace_cells(file: Path, cells: Mapping[tuple[int, int], str]) -> Path:
    """Changes the text of cells of a file: (row, column) -> text."""
    rows = [line.split(",") for line in file.read_text().splitlines()]
    for (row, column), text in cells.items():
        rows[row + 1][column] = text
    file.write_text("\n".join(",".join(row) for row in rows) + "\n")
    return file


def assert_values(log: DriveLog, excluding: Sequence[str] = ()) -> None:
    expected = values()
    for name in (*INS_SIGNALS, "acceleration_x", "acceleration_y", "road_wheel_angle"):
        if name not in excluding:
            np.testing.assert_allclose(getattr(log, name), expected[name], atol=2e-9, err_msg=name)
    np.testing.assert_allclose((log.ins_time_ns - log.ins_time_ns[0]) * 1e-9, expected["t"], atol=1e-6)


def test_every_name_denotes_one_channel() -> None:
    names = [normalise(name) for channel in COLUMNS.values() for name in channel.names.split()]
    assert len(names) == len(set(names)) and not columns.AMBIGUOUS_STEERING & set(names)


@pytest.mark.parametrize(("name", "factor", "offset", "is_degrees"), [
    ("yaw", 1.0, 1.0, False), ("yaw [rad]", 1.0, 3.0, False), ("yaw", 180 / np.pi, 0.0, True),
    ("yaw [rad]", 180 / np.pi, 0.0, False)])
def test_yaw_is_read_in_degrees_only_if_no_unit_is_stated_and_it_does_not_drift(
        tmp_path: Path, name: str, factor: float, offset: float, is_degrees: bool) -> None:
    t = 0.1 * np.arange(400)
    yaw = 0.1 * np.sin(t / 5) + 0.02
    position = np.cumsum(np.exp(1j * yaw))
    recorded = factor * yaw + offset * (1.0 + (t > 20.0))
    data = {c: np.ones(400) for c in PLAIN} | {"t": t, "x": position.real, "y": position.imag, "yaw": recorded}
    run = read_csv(write(tmp_path / "d.csv", {**PLAIN, "yaw": name}, data=data), CAR)
    np.testing.assert_allclose(run.log.yaw, yaw if is_degrees else recorded, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_constant_heading_in_degrees_on_a_straight(tmp_path: Path, seed: int) -> None:
    noise = np.random.default_rng(seed).normal(size=(2, N))
    data = values() | {"t": 0.1 * np.arange(N), "x": np.arange(N) + 0.02 * noise[0], "y": 0.02 * noise[1],
                       "compass_heading": np.full(N, 73.0)}
    names = {"compass_heading" if c == "yaw" else c: "heading" if c == "yaw" else n for c, n in PLAIN.items()}
    run = read_csv(write(tmp_path / "d.csv", names, data=data), CAR)
    np.testing.assert_allclose(run.log.yaw, np.radians(90.0 - 73.0))


@pytest.mark.parametrize("blank", ["", "nan", "0"])
@pytest.mark.parametrize(("channel", "other", "note"), [
    ("velocity_y", "", "velocity_y has no column with numbers; it is set to 0"),
    ("yaw_rate", "", "yaw_rate has no column with numbers; the derivative of yaw is used"),
    ("yaw", "compass_heading", ""), ("road_wheel_angle", "steering_wheel_angle", "")])
def test_column_with_only_blanks_is_read_as_absent(tmp_path: Path, channel: str, other: str, note: str,
                                                   blank: str) -> None:
    names = {**PLAIN, **({other: other} if other else {})}
    file = write(tmp_path / "a.csv", names)
    replace_cells(file, {(row, list(names).index(channel)): blank for row in range(N)})
    run = read_csv(file, CAR)
    absent = read_csv(write(tmp_path / "b.csv", {c: name for c, name in names.items() if c != channel}), CAR)
    texts, absent_texts = ([text.partition(": ")[2] for text in each.warnings] for each in (run, absent))
    if blank == "0" and channel in ("yaw_rate", "yaw"):
        assert texts.pop(0) == f"column {names[channel]} is 0 in all rows; it was read as blank"
    elif blank == "0":  # zeros are not blanks in these channels
        return
    assert texts == absent_texts
    assert not note or note in " ".join(run.warnings)
    for name in (*INS_SIGNALS, "road_wheel_angle"):
        np.testing.assert_array_equal(getattr(run.log, name), getattr(absent.log, name))


def test_blank_column_that_is_required_is_named(tmp_path: Path) -> None:
    file = replace_cells(write(tmp_path / "a.csv", PLAIN), {(row, 3): "" for row in range(N)})
    with pytest.raises(RunError, match="yaw has no number in 60 of 60 rows"):
        read_csv(file, CAR)


DERIVED = {"latitude", "longitude", "course", "velocity_east", "velocity_north",
           *(f"orientation_{axis}" for axis in "xyzw")}


REPLACED = (("yaw", "compass_heading"), ("road_wheel_angle", "steering_wheel_angle"))


def spell_with_unit(name: str, unit: str, style: int) -> str:
    """The name of a column with its unit in one of three spellings; style: any number."""
    _, others = next(units[unit] for units in UNITS.values() if unit in units)
    return (f"{name}_{unit}", f"{name.upper()} [{others[0] if others else unit}]", f" {name} ({unit}) ")[style % 3]


@pytest.mark.parametrize("channel", [c for c in COLUMNS if c not in DERIVED])
def test_every_name_and_unit_of_a_channel(tmp_path: Path, channel: str) -> None:
    names = {**PLAIN, **{c: c for c in (*opposite_wheel(channel), channel)}}
    names = {c: n for c, n in names.items() if c == channel or (c, channel) not in REPLACED}
    units = UNITS[COLUMNS[channel].kind]
    at = list(names).index(channel)
    for k, name in enumerate(COLUMNS[channel].names.split()):
        assert_channel(read_csv(write(tmp_path / "d.csv", {**names, channel: name}), CAR), channel)
        for style, unit in enumerate(units, start=k):
            header = [*names.values()]
            header[at] = spell_with_unit(name, unit, style).strip()
            source = find_columns(tmp_path / "d.csv", header, Layout())[channel]
            assert (source.column, source.unit) == (at, unit), header[at]
    for style, unit in enumerate(units):
        text = spell_with_unit(COLUMNS[channel].names.split()[0], unit, style)
        assert_channel(read_csv(write(tmp_path / "d.csv", {**names, channel: text}, {channel: unit}), CAR), channel)
        file = write(tmp_path / "d.csv", {**names, channel: "nameless"}, {channel: unit})
        assert_channel(read_csv(file, CAR, Layout({channel: "nameless"}, {channel: unit})), channel)


def opposite_wheel(channel: str) -> tuple[str, ...]:
    """The wheel on the other side of the axle: the speed of one wheel alone is not used."""
    side = {"left": "right", "right": "left"}.get(channel.rpartition("_")[2])
    return (f"{channel.rpartition('_')[0]}_{side}",) if channel.startswith("wheel_speed") else ()


def assert_channel(drive: LoadedRun, channel: str) -> None:
    assert_values(drive.log)
    assert drive.warnings == ()
    if "speed" in channel:
        speeds = [values()[c] for c in (channel, *opposite_wheel(channel))]
        np.testing.assert_allclose(drive.auxiliary.wheel_speed.values, np.mean(speeds, axis=0), atol=1e-9)
    else:
        assert channel in drive.provenance["columns"]


@pytest.mark.parametrize(("names", "units"), [
    ({"t": "Time (s)", "velocity_x": "Speed km/h", "yaw_rate": "YawRate_deg/s"},
     {"velocity_x": "km/h", "yaw_rate": "deg/s"}),
    ({"t": "%time", "yaw": "yaw_deg", "velocity_x": "speed_kph", "yaw_rate": "yaw_rate_dps"},
     {"yaw": "deg", "velocity_x": "km/h", "yaw_rate": "deg/s"}),
    ({"t": "timestamp_ms", "velocity_x": "velocityX_mps", "acceleration_y": "ay_m_s2", "acceleration_x": "ax_g"},
     {"t": "ms", "acceleration_x": "g"}),
    ({"x": "Easting [ft]", "y": "northing_km", "yaw_rate": '"yaw rate, deg/s"'},
     {"x": "ft", "y": "km", "yaw_rate": "deg/s"}),
])
def test_units_stated_in_usual_headers(tmp_path: Path, names: dict, units: dict) -> None:
    drive = read_csv(write(tmp_path / "d.csv", {**PLAIN, **names}, units))
    assert_values(drive.log)
    assert not find_missing_in_header(tmp_path / "d.csv")
    for channel, unit in units.items():
        assert drive.provenance["columns"][channel].endswith(f"[{unit}]")
    assert drive.provenance["columns"]["velocity_y"] == "vy [m/s, assumed]"


def gnss_drive(course_is_yaw: bool) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Names and values of a table with course and speed over ground, without velocity_y and yaw rate."""
    data = values()
    slip = np.zeros(N) if course_is_yaw else np.arctan2(data["velocity_y"], data["velocity_x"])
    data |= {"course": np.pi / 2 - data["yaw"] - slip, "velocity_x": data["velocity_x"] / np.cos(slip)}
    names = {c: n for c, n in PLAIN.items() if c not in ("velocity_y", "yaw_rate", *(["yaw"] if course_is_yaw else []))}
    return {**names, "course": "course_over_ground"}, data


@pytest.mark.parametrize("name", ["yaw rate [rps]", "yaw_rate_rps"])
def test_rps_is_no_unit_of_the_yaw_rate(tmp_path: Path, name: str) -> None:
    """rps means revolutions per second in most tables, rad/s in others."""
    drive = read_csv(write(tmp_path / "d.csv", {**PLAIN, "yaw_rate": name}))
    np.testing.assert_allclose(drive.log.yaw_rate, 1.0, atol=1e-6)  # of yaw, not of its own column
    texts = [text.partition(": ")[2] for text in drive.warnings]
    ignored = ["column yaw rate [rps] is not used: 'rps' is not a unit of angular rate (known units are rad/s, deg/s, "
               "mrad/s)"] if "[" in name else []
    assert texts == [*ignored, "yaw_rate has no column with numbers; the derivative of yaw is used; columns not used: "
                     f"{name}; if it is one of them, name it in a run.yaml"]


@pytest.mark.parametrize("course_is_yaw", [True, False])
def test_course_and_speed_over_ground_give_the_body_velocities(tmp_path: Path, course_is_yaw: bool) -> None:
    names, data = gnss_drive(course_is_yaw)
    drive = read_csv(write(tmp_path / "d.csv", names, data=data))
    assert not find_missing_in_header(tmp_path / "d.csv")
    assert_values(drive.log, excluding=("velocity_y", "yaw_rate"))
    expected = np.zeros(N) if course_is_yaw else values()["velocity_y"]
    np.testing.assert_allclose(drive.log.velocity_y, expected, atol=1e-9)
    np.testing.assert_allclose(drive.log.yaw_rate, 1.0, atol=1e-6)  # of yaw, not of its own column
    texts = [text.partition(": ")[2] for text in drive.warnings]
    lacking = ["velocity_y has no column with numbers; it is set to 0 (unknown sideslip)"] * course_is_yaw
    assert texts == [*lacking, "yaw_rate has no column with numbers; the derivative of yaw is used"]


@pytest.mark.parametrize("missing", ["velocity_y", "yaw_rate"])
def test_columns_not_used_are_named_if_a_channel_is_missing(tmp_path: Path, missing: str) -> None:
    names = {**PLAIN, missing: "sensor 7 [km/h]", "acceleration_y": "Quer2"}
    (warning,) = [w for w in read_csv(write(tmp_path / "d.csv", names)).warnings if missing in w]
    assert warning.endswith("columns not used: sensor 7 [km/h], Quer2; if it is one of them, name it in a run.yaml")


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_gnss_table_with_too_few_rows_is_rejected(tmp_path: Path, rows: int) -> None:
    names, data = gnss_drive(True)
    file = write(tmp_path / "d.csv", names, data={channel: column[:rows] for channel, column in data.items()})
    with pytest.raises(RunError):
        read_csv(file)


def test_velocity_x_is_preferred_to_speed(tmp_path: Path) -> None:
    file = write(tmp_path / "d.csv", {"vehicle_speed": "speed", **PLAIN})
    assert_values(read_csv(file).log)


def test_row_of_units_below_the_header(tmp_path: Path) -> None:
    units = {"yaw": "deg", "velocity_x": "km/h", "t": "ms"}
    lines = write(tmp_path / "d.csv", PLAIN, units).read_text().splitlines()
    (tmp_path / "d.csv").write_text("\n".join([lines[0], "ms,m,m,[deg],km/h,m/s,rad/s,m/s^2,m/s^2,rad", *lines[1:]]))
    drive = read_csv(tmp_path / "d.csv")
    assert_values(drive.log)
    assert drive.provenance["columns"]["velocity_x"] == "vx [km/h]" and not drive.warnings


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_decimal_commas(tmp_path: Path, delimiter: str) -> None:
    file = write(tmp_path / "d.csv", PLAIN, delimiter=delimiter)
    file.write_text(file.read_text().replace(".", ","))
    assert_values(read_csv(file).log)


def test_text_in_an_unused_column_has_no_effect(tmp_path: Path) -> None:
    lines = write(tmp_path / "d.csv", PLAIN).read_text().splitlines()
    lines = [f"{line},{'comment' if k == 0 else 'dry'}" for k, line in enumerate(lines)]
    (tmp_path / "d.csv").write_text("\n".join(lines))
    drive = read_csv(tmp_path / "d.csv")
    assert_values(drive.log)
    assert not drive.warnings


def test_steering_wheel_angle_requires_a_vehicle(tmp_path: Path) -> None:
    names = {c: n for c, n in PLAIN.items() if c != "road_wheel_angle"} | {"steering_wheel_angle": "swa_deg"}
    file = write(tmp_path / "d.csv", names, {"steering_wheel_angle": "deg"})
    assert not find_missing_in_header(file)
    (run,) = find_runs([tmp_path])
    loaded = read(run, CAR)
    assert_values(loaded.log)
    np.testing.assert_allclose(loaded.log.steering_wheel_angle, values()["steering_wheel_angle"], atol=1e-9)
    with pytest.raises(RunError, match=r"d\.csv: it has only the steering wheel angle \(column swa_deg\).* specify "):
        read(run)


@pytest.mark.parametrize("name", ["steering_angle_rad", "Delta_Wheel_rad"])
def test_steering_angle_of_an_unspecified_wheel_is_rejected(tmp_path: Path, name: str) -> None:
    file = write(tmp_path / "d.csv", {**PLAIN, "road_wheel_angle": name})
    assert not find_missing_in_header(file)
    with pytest.raises(RunError, match=rf"column {name} may be the angle of the steering wheel or of the road wheels; "
                       rf".* in a run\.yaml, as columns: \{{steering_wheel_angle: {name}\}} or"):
        read_csv(file, CAR)
    assert_values(read_csv(file, layout=Layout({"road_wheel_angle": name})).log)


@pytest.mark.parametrize(("x", "y"), [("x", "y"), ("east", "Northing [km]")])
def test_layout_interchanges_the_axes_for_any_column_names(tmp_path: Path, x: str, y: str) -> None:
    file = write(tmp_path / "d.csv", {**PLAIN, "x": y, "y": x}, {"x": "km"} if "km" in y else None)
    assert_values(read_csv(file, layout=Layout({"x": "y", "y": "x"})).log)


def test_unit_of_a_missing_channel_is_rejected(tmp_path: Path) -> None:
    file = write(tmp_path / "d.csv", {c: n for c, n in PLAIN.items() if c != "yaw"} | {"compass_heading": "heading"})
    with pytest.raises(RunError, match=r"d\.csv has no column for this channel; it has columns for .*compass_heading"):
        read_csv(file, layout=Layout(units={"yaw": "deg"}))


INVALID = ("", "nan", "n/a", "inf", "-inf", "1e999", "--")


@pytest.mark.parametrize("channel", [c for c in PLAIN if c not in ("t", "acceleration_x", "acceleration_y",
                                                                   "road_wheel_angle")])
def test_missing_ins_values_remove_only_ins_samples(tmp_path: Path, channel: str) -> None:
    at = list(PLAIN).index(channel)
    cells = {(5 + 2 * k, at): text for k, text in enumerate(INVALID)}
    drive = read_csv(replace_cells(write(tmp_path / "d.csv", PLAIN), cells))
    kept = np.delete(np.arange(N), 5 + 2 * np.arange(len(INVALID)))
    np.testing.assert_allclose(drive.log.yaw, values()["yaw"][kept])
    np.testing.assert_allclose(drive.log.road_wheel_angle, values()["road_wheel_angle"], atol=1e-9)
    assert drive.auxiliary.missing == {channel: len(INVALID)}
    assert len(drive.auxiliary.stamps["INS"]) == N
    (warning,) = drive.warnings
    assert warning.endswith(f"d.csv: {channel} (column {PLAIN[channel]}): {len(INVALID)} of {N} rows (12 %) have no "
                            "number; these INS samples were left out")


@pytest.mark.parametrize("wheel", [False, True])
def test_missing_steering_values_remove_only_steering_samples(tmp_path: Path, wheel: bool) -> None:
    names = {**PLAIN, "steering_wheel_angle": "swa"} if wheel else PLAIN
    drive = read_csv(replace_cells(write(tmp_path / "d.csv", names), {(7, len(names) - 1): "n/a"}), CAR)
    assert (len(drive.log.x), len(drive.log.road_wheel_angle)) == (N, N - 1)
    assert drive.auxiliary.missing == {"steering_wheel_angle" if wheel else "road_wheel_angle": 1}


def test_blank_cells_of_a_lower_rate_are_not_missing_values(tmp_path: Path) -> None:
    names = {**PLAIN, "steering_wheel_angle": "swa"}
    sparse = {(k, len(names) - 1): "" for k in range(N) if k % 2}
    drive = read_csv(replace_cells(write(tmp_path / "d.csv", names), {**sparse, (6, len(names) - 1): ""}), CAR)
    assert (len(drive.log.x), len(drive.log.steering_wheel_angle)) == (N, N // 2 - 1)
    assert drive.auxiliary.missing == {"steering_wheel_angle": 1}
    assert "1 of 60 rows (1.7 %) have no number" in drive.warnings[0]


def test_accelerations_are_read_if_only_the_steering_has_a_higher_rate(tmp_path: Path) -> None:
    lines = write(tmp_path / "d.csv", PLAIN).read_text().splitlines()
    steering_rows = [f"{0.02 * k + 0.005 * step:.3f},,,,,,,,,0.1" for k in range(N) for step in (1, 2, 3)]
    (tmp_path / "d.csv").write_text("\n".join([lines[0], *sorted([*lines[1:], *steering_rows],
                                                                key=lambda line: float(line.split(",")[0]))]))
    assert_values(read_csv(tmp_path / "d.csv").log, excluding=["road_wheel_angle"])


def test_missing_accelerations_become_nan_and_remove_no_samples(tmp_path: Path) -> None:
    drive = read_csv(replace_cells(write(tmp_path / "d.csv", PLAIN), {(k, 8): "" for k in range(10)}))
    assert np.isnan(drive.log.acceleration_y).sum() == 10
    assert_values(drive.log, excluding=("acceleration_y",))
    assert drive.auxiliary.missing == {"acceleration_y": 10}
    assert "10 of 60 rows (17 %) have no number; it is unknown there" in drive.warnings[0]


def test_channel_with_mostly_missing_values_causes_a_warning(tmp_path: Path) -> None:
    names = {**PLAIN, "steering_wheel_angle": "swa"}
    file = replace_cells(write(tmp_path / "d.csv", names),
                         {(k, column): "n/a" for k in range(40) for column in (2, 7, 10)})
    drive = read_csv(file, CAR)
    warnings = "\n".join(drive.warnings)
    assert "y (column y): 40 of 60 rows (67 %) have no number, more than half; these INS samples were" in warnings
    assert "acceleration_x (column ax): 40 of 60 rows (67 %) have no number, more than half; it is not used" in warnings
    assert "steering_wheel_angle (column swa) has no number in more than half of the rows; the road wheel" in warnings
    assert drive.log.acceleration_x is None and drive.log.steering_wheel_angle is None
    assert (len(drive.log.x), len(drive.log.road_wheel_angle)) == (20, N)
    with pytest.raises(RunError, match="it contains fewer than two usable rows: y has no number in 59 of 60 rows"):
        read_csv(replace_cells(file, {(k, 2): "n/a" for k in range(59)}))


def test_rows_without_a_valid_time_or_out_of_order_are_counted(tmp_path: Path) -> None:
    times = {10: "n/a", 20: "0.38", 30: "0.1", 31: "1e12"}
    drive = read_csv(replace_cells(write(tmp_path / "d.csv", PLAIN), {(row, 0): text for row, text in times.items()}))
    assert len(drive.log.x) == len(drive.log.road_wheel_angle) == N - 4
    assert drive.auxiliary.missing == {"time": 2}
    stamps = drive.auxiliary.stamps["INS"]
    assert len(stamps) == N - 2 and (np.diff(stamps) == 0).sum() == 1 and (np.diff(stamps) < 0).sum() == 1
    assert any("2 of 58 rows (3.4 %) are not later than those before them" in w for w in drive.warnings)
    assert any("time (column t): 2 of 60 rows (3.3 %) have no number; these rows" in w for w in drive.warnings)


@pytest.mark.parametrize(("factor", "unit", "declared"), [
    (10**9, "ns", False), (10**6, "us", False), (10**3, "ms", False), (1, "s", False), (10**9, "ns", True)])
def test_unit_of_times_since_1970_is_inferred_or_declared(tmp_path: Path, factor: int, unit: str,
                                                          declared: bool) -> None:
    file = write(tmp_path / "d.csv", PLAIN)
    head, *lines = file.read_text().splitlines()
    rows = [f"{(1_700_000_000_000 + 20 * k) * factor / 1000:.{2 if factor == 1 else 0}f},{line.partition(',')[2]}"
            for k, line in enumerate(lines)]
    file.write_text("\n".join([head, *rows]))
    drive = read_csv(file, layout=Layout(units={"t": unit} if declared else {}))
    assert_values(drive.log)
    assert drive.log.ins_time_ns[0] == 1_700_000_000_000_000_000
    assert any(f"read as {unit} since 1970" in w for w in drive.warnings) == (factor > 1 and not declared)


@pytest.mark.parametrize(("stamp", "start"), [
    ("2026-05-04T23:59:59.{:03d}Z", 1_777_939_199), ("2026-05-04 23:59:59.{:03d}", 1_777_939_199),
    ("04.05.2026 23:59:59.{:03d}", 1_777_939_199), ("2026-05-05T01:59:59.{:03d}+02:00", 1_777_939_199),
    ("2026-05-05 01:59:59.{:03d}+02", 1_777_939_199), ("2026-05-04 23:59:59.{:03d} GMT", 1_777_939_199),
    ("23:59:59.{:03d}", 86_399), ("2026_05_04_23_59_59_{:03d}", 1_777_939_199),
])
def test_times_as_text_over_midnight(tmp_path: Path, stamp: str, start: int) -> None:
    file = write(tmp_path / "d.csv", PLAIN)
    head, *lines = file.read_text().splitlines()
    texts = [stamp.format(20 * k) if k < 50 else
             stamp.format(20 * k - 1000).replace("23:59:59", "00:00:00").replace("01:59:59", "02:00:00")
             .replace("-05-04", "-05-05").replace("04.05", "05.05").replace("04_23_59_59", "05_00_00_00")
             for k in range(len(lines))]
    file.write_text("\n".join([head, *(f"{t},{line.partition(',')[2]}" for t, line in zip(texts, lines, strict=True))]))
    drive = read_csv(file)
    assert_values(drive.log)
    assert drive.log.ins_time_ns[0] == start * 10**9 and drive.warnings == ()


def test_quaternion_and_east_north_velocities_give_yaw_and_body_velocities(tmp_path: Path) -> None:
    data = values()
    yaw, forward, left, zero = data["yaw"], data["velocity_x"], data["velocity_y"], np.zeros(N)
    data |= {"orientation_x": zero, "orientation_y": zero, "orientation_z": np.sin(yaw / 2),
             "orientation_w": np.cos(yaw / 2), "velocity_east": forward * np.cos(yaw) - left * np.sin(yaw),
             "velocity_north": forward * np.sin(yaw) + left * np.cos(yaw)}
    names = {c: n for c, n in PLAIN.items() if c not in ("yaw", "velocity_x", "velocity_y")}
    names |= {"orientation_z": "qz", "orientation_w": "qw", "orientation_x": "qx", "orientation_y": "qy",
              "velocity_east": "vel_east", "velocity_north": "vel_north"}
    assert_values(read_csv(write(tmp_path / "d.csv", names, data=data)).log)


def test_acceleration_named_by_direction_has_priority_over_an_axis_of_a_sensor() -> None:
    names = ["timestamp", "lateral_acc", "longitudinal_acc", "x_acc", "y_acc"]  # of RaceChrono
    sources = find_columns(Path("a.csv"), names, Layout())
    assert (sources["acceleration_x"].name, sources["acceleration_y"].name) == ("longitudinal_acc", "lateral_acc")


def test_iso_axes_have_priority_in_a_table_of_oxts() -> None:
    """Names of the CSV of the OxTS NCOM decoder; its other lateral values are positive to the right."""
    channels = {"velocity_y": "lateral velocity(m/s)", "acceleration_y": "lateral acceleration(m/s²)",
                "yaw_rate": "yaw velocity(deg/s)"}
    names = ["Velocity lateral(m/s)", "Acceleration lateral(m/s²)", "Angular rate Zv(deg/s)", *(
        f"ISO {axes} {name}" for axes in ("e.f.s.", "i.s.", "v.s.") for name in channels.values())]
    sources = find_columns(Path(), names, Layout())
    assert {channel: sources[channel].name for channel in channels} == {
        channel: f"ISO v.s. {name}" for channel, name in channels.items()}


def test_documentation_lists_every_channel_and_unit() -> None:
    text = (ROOT / "docs/csv_columns.md").read_text()
    for name, channel in COLUMNS.items():
        names = ", ".join(channel.names.split())
        row = f"| `{name}` | {next(iter(UNITS[channel.kind]))} | {channel.meaning} | {names} |"
        assert row in text, f"docs/csv_columns.md lacks or differs:\n{row}"
    for kind, units in UNITS.items():
        spelled = [f"{unit} ({', '.join(others)})" if others else unit for unit, (_, others) in units.items()]
        row = f"| {kind} | {', '.join(spelled)} |"
        assert row in text, f"docs/csv_columns.md lacks or differs:\n{row}"


@pytest.mark.parametrize("own_stamps", [False, True])
def test_channels_of_lower_rates_are_interpolated(tmp_path: Path, own_stamps: bool) -> None:
    """Their cells are blank in most rows; they share rows with other channels, or have their own as in a merged MF4."""
    data = [{channel: f"{column[k]:.9g}" for channel, column in values().items() if channel in PLAIN} for k in range(N)]
    slow = {"x": 5, "y": 5, "yaw": 3}  # channel -> rows per sample
    rows = []
    for k, row in enumerate(data):
        rows += [{c: text for c, text in row.items() if own_stamps and c in ("t", *slow) and k % slow.get(c, 1) == 0},
                 {c: text for c, text in row.items() if c not in slow or not (own_stamps or k % slow[c])}]
        if own_stamps:
            rows[-1]["t"] = f"{float(row['t']) + 0.004:.3f}"
    rows = [row for row in rows if len(row) > 1]
    file = tmp_path / "d.csv"
    file.write_text("\n".join([",".join(PLAIN.values()), *(",".join(row.get(c, "") for c in PLAIN) for row in rows)]))
    drive = read_csv(file)
    at = drive.log.ins_time_ns * 1e-9
    assert len(at) >= N - 5 and "lower rate or separate stamps: x 12 of" in drive.warnings[0]
    for channel in ("x", "y", "yaw", "velocity_x", "yaw_rate"):
        expected = np.interp(at - 0.004 * own_stamps * (channel not in slow), values()["t"], values()[channel])
        np.testing.assert_allclose(getattr(drive.log, channel), expected, atol=2e-3, err_msg=channel)


def test_driving_direction_is_not_read_as_course() -> None:
    assert not {"course", "velocity_y"} & find_columns(Path("d.csv"), ["t", "v", "yaw", "direction"], Layout()).keys()


@pytest.mark.parametrize(("names", "channel", "expected"), [
    (["Time (s)", "Velocity (m/s)", "Direction (°)"], "course", "Direction (°)"),  # of phyphox
    (["a/state/yaw", "a/state/yaw_deg"], "yaw", "a/state/yaw_deg"), (["a/yaw_deg", "a/yaw"], "yaw", "a/yaw_deg"),
    (["a/velocities.yaw"], "yaw", None), (["/integrated/high_rate/yaw"], "yaw", "/integrated/high_rate/yaw"),
    (["a/pose/yaw", "a/angular_rates/yaw"], "yaw", "a/pose/yaw"),
    (["a/yaw", "b/yaw_deg"], "yaw", None), (["INS_Lat_Abs", "GNSS_Lat_Abs"], "latitude", "INS_Lat_Abs")])
def test_name_after_a_path(names: list[str], channel: str, expected: str | None) -> None:
    source = find_columns(Path("d.csv"), names, Layout()).get(channel)
    assert (source.name if source else None) == expected


def test_course_over_ground_is_preferred_to_a_shorter_name() -> None:
    names = ["zeit", "kurs", "kurs_ueber_grund"]
    assert find_columns(Path("d.csv"), names, Layout())["course"].name == "kurs_ueber_grund"
