"""Tables in files of MATLAB and Apache Arrow are read as the CSV file with the same columns."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat
from st_core.log import DriveLog
from st_recordings.runs import find_runs, read
from st_recordings.runs.errors import RunError

Columns = dict[str, np.ndarray]
STEERING = ("road_wheel_angle",)


@pytest.fixture(scope="module")
def columns() -> Columns:
    time = np.arange(400) * 0.02
    yaw = 0.1 * time**2
    speed = 5.0 + 0.1 * time
    return {"t": time, "x": np.cumsum(speed * np.cos(yaw)) * 0.02, "y": np.cumsum(speed * np.sin(yaw)) * 0.02,
            "yaw": yaw, "velocity_x": speed, "velocity_y": 0.0 * time, "yaw_rate": 0.2 * time,
            "road_wheel_angle": 0.01 * time}


def make_struct_array(names: list[str], entries: list[tuple]) -> np.ndarray:
    array = np.zeros(len(entries), dtype=[(name, "O") for name in names])
    for number, entry in enumerate(entries):
        array[number] = entry
    return array


def save_flat(file: Path, columns: Columns) -> None:
    savemat(file, columns)


def save_nested(file: Path, columns: Columns) -> None:
    savemat(file, {"log": {"ego": columns, "driver": "A"}, "gains": np.arange(7.0)}, oned_as="column")


def save_milliseconds(file: Path, columns: Columns) -> None:
    savemat(file, {"time_ms": 1e3 * columns["t"], **{name: columns[name] for name in columns if name != "t"}})


def save_seconds_and_milliseconds(file: Path, columns: Columns) -> None:
    """The whole time twice, in two units."""
    savemat(file, {"time_s": columns["t"], "time_ms": 1e3 * columns["t"],
                   **{name: columns[name] for name in columns if name != "t"}})


def save_simulink(file: Path, columns: Columns) -> None:
    """Structure with time of the block To Workspace."""
    signals = make_struct_array(["values", "dimensions", "label"], [
        (values[:, None], 1.0, name) for name, values in columns.items() if name != "t"])
    savemat(file, {"out": {"time": columns["t"][:, None], "signals": signals}})


def save_control_desk(file: Path, columns: Columns) -> None:
    """dSPACE ControlDesk: the times are in X, the signals in Y."""
    signals = make_struct_array(["Name", "Data", "Unit"], [
        (name, values, "") for name, values in columns.items() if name != "t"])
    savemat(file, {"rec1_001": {"X": {"Name": "", "Data": columns["t"]}, "Y": signals}})


def save_control_desk_rasters(file: Path, columns: Columns) -> None:
    """dSPACE ControlDesk with two rasters: XIndex of a signal is the number of its time vector."""
    fast, slow = (make_struct_array(["Name", "Data", "Unit", "XIndex"], [
        (name, columns[name][::step], "", number) for name in names]) for number, (step, names) in enumerate(
            ((1, [name for name in columns if name not in ("t", *STEERING)]), (2, STEERING)), 1))
    times = make_struct_array(["Name", "Data"], [("", columns["t"]), ("", columns["t"][::2])])
    savemat(file, {"rec1_001": {"X": times, "Y": np.concatenate([fast, slow])}})


def save_time_series_structs(file: Path, columns: Columns) -> None:
    """A struct for each timeseries, with its times and Units."""
    savemat(file, {"log": {name: {"Time": columns["t"], "Data": np.degrees(values) if name == "yaw_rate" else values,
                                  "Units": "deg/s" if name == "yaw_rate" else ""}
                           for name, values in columns.items() if name != "t"}})


def test_channels_on_different_clocks_are_refused(columns: Columns, tmp_path: Path) -> None:
    gyro = {"t": columns["t"] + 100.0, "yaw_rate": columns["yaw_rate"]}
    savemat(tmp_path / "a.mat", {"gyro": gyro, "ins": {name: columns[name] for name in columns if name != "yaw_rate"}})
    with pytest.raises(RunError, match="its channels have numbers at different times; export them with times of one"):
        load(tmp_path / "a.mat")


def save_signal_structs(file: Path, columns: Columns) -> None:
    """Each signal is a struct with its samples and unit, as IPG CarMaker exports them."""
    degrees = {"yaw_rate", "road_wheel_angle"}
    savemat(file, {"data": {name: {"data": np.degrees(values) if name in degrees else values,
                                   "unit": {"yaw_rate": "deg/s", "road_wheel_angle": "deg"}.get(name, "")}
                            for name, values in columns.items()}})


def save_two_rates(file: Path, columns: Columns) -> None:
    """The steering has a time vector of its own, in another unit, with every second sample."""
    savemat(file, {"ins": {name: values for name, values in columns.items() if name not in STEERING},
                   "can": {"t_ms": 1e3 * columns["t"][::2], **{name: columns[name][::2] for name in STEERING}}})


def save_ros_stamps(file: Path, columns: Columns) -> None:
    stamp = {"sec": columns["t"] // 1.0, "nanosec": 1e9 * (columns["t"] % 1.0)}
    stamp_of_steering = {name: values[::2] for name, values in stamp.items()}
    savemat(file, {"odometry": {**stamp, **{name: columns[name] for name in columns if name not in ("t", *STEERING)}},
                   "steering": {**stamp_of_steering, **{name: columns[name][::2] for name in STEERING}},
                   "classes": make_struct_array(["label"], [(np.arange(3.0),), (np.arange(3.0),)])})


def save_parquet_with_index(file: Path, columns: Columns) -> None:
    pd.DataFrame(columns).set_index("t").to_parquet(file)


def save_parquet_with_date_index(file: Path, columns: Columns) -> None:
    index = pd.to_datetime(np.round(columns["t"] * 1e9).astype(np.int64))
    pd.DataFrame({name: columns[name] for name in columns if name != "t"}).set_index(index).to_parquet(file)


def load(file: Path) -> DriveLog:
    (source,) = find_runs([file])
    if source.problem:
        raise source.problem
    return read(source).log


@pytest.mark.parametrize(("save", "extension"), [
    (save_flat, ".mat"), (save_nested, ".mat"), (save_milliseconds, ".mat"),
    (save_seconds_and_milliseconds, ".mat"), (save_simulink, ".mat"),
    (save_control_desk, ".mat"), (save_signal_structs, ".mat"), (save_two_rates, ".mat"),
    (save_ros_stamps, ".mat"), (save_control_desk_rasters, ".mat"), (save_time_series_structs, ".mat"),
    (save_parquet_with_date_index, ".parquet"),
    (lambda file, columns: pd.DataFrame(columns).to_parquet(file), ".parquet"), (save_parquet_with_index, ".parquet"),
    (lambda file, columns: pd.DataFrame(columns).to_feather(file), ".feather")])
def test_drive_equals_the_one_of_the_csv_file(columns: Columns, tmp_path: Path,
                                              save: Callable[[Path, Columns], None], extension: str):
    pd.DataFrame(columns).to_csv(tmp_path / "drive.csv", index=False)
    save(tmp_path / f"drive{extension}", columns)
    expected, log = load(tmp_path / "drive.csv"), load(tmp_path / f"drive{extension}")
    np.testing.assert_array_equal(log.ins_time_ns, expected.ins_time_ns)
    for name in ("x", "y", "yaw", "velocity_x", "yaw_rate"):
        np.testing.assert_allclose(getattr(log, name), getattr(expected, name), atol=1e-9)
    angle = np.interp(log.steering_time_ns, expected.steering_time_ns, expected.road_wheel_angle)
    np.testing.assert_allclose(log.road_wheel_angle, angle, atol=1e-9)
    assert len(log.steering_time_ns) in (200, 400)


def test_folder_with_the_same_drive_as_csv_and_mat_is_one_run(columns: Columns, tmp_path: Path):
    pd.DataFrame(columns).to_csv(tmp_path / "drive.csv", index=False)
    save_flat(tmp_path / "drive.mat", columns)
    save_flat(tmp_path / "other.mat", columns)
    assert [source.files[0].name for source in find_runs([tmp_path])] == ["drive.csv", "other.mat"]


@pytest.mark.parametrize("axis", [0, 1])
def test_columns_or_rows_of_a_matrix_can_be_named_in_a_run_file(columns: Columns, tmp_path: Path, axis: int):
    savemat(tmp_path / "drive.mat", {"log": np.stack(list(columns.values()), axis=axis)})
    names = ", ".join(f"{name}: log_{number}" for number, name in enumerate(columns, 1))
    (tmp_path / "drive.run.yaml").write_text(f"csv: drive.mat\ncolumns: {{{names}}}\n")
    np.testing.assert_allclose(load(tmp_path / "drive.run.yaml").velocity_x, columns["velocity_x"])


def write_version_7_3(file: Path) -> None:
    """Header of a file of MATLAB version 7.3, which is an HDF5 file."""
    file.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(384) + b"\x89HDF\r\n\x1a\n")


@pytest.mark.parametrize(("write", "name", "message"), [
    (write_version_7_3, "a.mat", r"MATLAB 7\.3 file; save it with save\(\.\.\., '-v7'\)"),
    (lambda file: file.write_text("t,x,y\n1,2,3\n"), "a.mat", "scipy cannot read the file"),
    (lambda file: savemat(file, {"gain": 3.0, "car": "Leaf"}), "a.mat", "it contains no vectors; save the samples"),
    (lambda file: savemat(file, {"speed": np.ones(9)}), "a.mat",
     "no column was recognised as t, x .or longitude., y .or latitude., yaw"),
    (lambda file: file.write_bytes(b"PAR1 broken"), "a.parquet", "pyarrow cannot read the file")])
def test_refusal_names_the_reason_and_the_remedy(tmp_path: Path, write: Callable[[Path], None], name: str,
                                                 message: str):
    write(tmp_path / name)
    for path in (tmp_path / name, tmp_path):  # a folder that contains only this file reports it, too
        with pytest.raises(RunError, match=message):
            load(path)
