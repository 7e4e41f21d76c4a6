"""Tables in files of MATLAB, HDF5, Parquet, Feather and JSON are read as the CSV file with the same columns."""

import json
import pickle
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from asammdf import MDF, Signal
from scipy.io import savemat
from st_core.log import DriveLog
from st_recordings.runs import find_runs, read
from st_recordings.runs.binary_table import HEAD_SIZE, read_names
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


def save_version_7_3(file: Path, content: dict[str, Any], oned_as: str = "row") -> None:
    """What `save -v7.3` of MATLAB writes."""
    with h5py.File(file, "w", userblock_size=512) as target:
        for name, value in content.items():
            write_variable(target, name, value)
        if "#refs#" in target:
            target["#refs#"]["a"] = np.arange(3.0)
    with file.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def write_variable(parent: h5py.Group, name: str, value: Any) -> None:
    if isinstance(value, dict):
        node: Any = parent.create_group(name)
        for field, entry in value.items():
            write_variable(node, field, entry)
        kind = "struct"
    elif isinstance(value, str):
        codes = np.array([[ord(letter)] for letter in value], np.uint16)
        node = parent.create_dataset(name, data=codes if value else np.zeros(2, np.uint64))
        node.attrs["MATLAB_int_decode" if value else "MATLAB_empty"] = np.uint8(1)
        kind = "char"
    elif isinstance(value, np.ndarray) and value.dtype.names:
        node, kind = parent.create_group(name), "struct"
        for field in value.dtype.names:
            write_references(node, field, value[field])
    elif isinstance(value, list):
        node, kind = write_references(parent, name, value), "cell"
    else:
        node = parent.create_dataset(name, data=np.atleast_2d(np.asarray(value, float)).T)
        kind = "double"
    node.attrs["MATLAB_class"] = np.bytes_(kind)


def write_references(parent: h5py.Group, name: str, entries: Any) -> h5py.Dataset:
    targets = parent.file.require_group("#refs#")
    references = []
    for entry in entries:
        write_variable(targets, f"r{len(targets)}", entry)
        references.append(targets[f"r{len(targets) - 1}"].ref)
    return parent.create_dataset(name, data=np.array(references, h5py.ref_dtype)[:, None], dtype=h5py.ref_dtype)


def save_object(file: Path, content: dict[str, Any], **kinds: str) -> None:
    """kinds: classes of objects in the file, as timeseries."""
    save_version_7_3(file, content)
    with h5py.File(file, "r+") as target:
        for name, kind in kinds.items():
            target[name] = np.array([[0xDD000000, 2, 1, 1, 1, 1]], np.uint32)
            target[name].attrs.update({"MATLAB_class": np.bytes_(kind), "MATLAB_object_decode": np.int32(3)})


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


def save_milliseconds_twice(file: Path, columns: Columns) -> None:
    """The whole time in milliseconds, and again its milliseconds."""
    time = np.round(1e3 * columns["t"])
    savemat(file, {"time_ms": time, "millis": time % 1e3, **{name: columns[name] for name in columns if name != "t"}})


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


def test_channels_on_different_clocks_are_rejected(columns: Columns, tmp_path: Path) -> None:
    gyro = {"t": columns["t"] + 100.0, "yaw_rate": columns["yaw_rate"]}
    savemat(tmp_path / "a.mat", {"gyro": gyro, "ins": {name: columns[name] for name in columns if name != "yaw_rate"}})
    with pytest.raises(RunError, match="its channels have no times in common; export them on one clock"):
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


def save_arrow_stream(file: Path, columns: Columns) -> None:
    table = pa.table(columns)
    with pa.ipc.new_stream(file, table.schema) as stream:
        stream.write_table(table)


def save_parquet_with_date_index(file: Path, columns: Columns) -> None:
    index = pd.to_datetime(np.round(columns["t"] * 1e9).astype(np.int64))
    pd.DataFrame({name: columns[name] for name in columns if name != "t"}).set_index(index).to_parquet(file)


def nest(columns: Columns) -> list[dict[str, Any]]:
    """Records in which the position is an object."""
    return [{"pose": {"x": row.pop("x"), "y": row.pop("y")}, **row} for row in pd.DataFrame(columns).to_dict("records")]


def save_json_lines(file: Path, columns: Columns) -> None:
    file.write_text("\ufeff" + "\r\n".join(map(json.dumps, nest(columns))), encoding="utf-8")


def save_json_records(file: Path, columns: Columns) -> None:
    file.write_text(json.dumps({"car": "Leaf", "drive": {"samples": nest(columns)}}, indent=2))


def save_json_columns(file: Path, columns: Columns) -> None:
    file.write_text(json.dumps({"car": {"mass": 1500.0}, **pd.DataFrame(columns).to_dict("list")}))


def save_json_split(file: Path, columns: Columns) -> None:
    pd.DataFrame(columns).to_json(file, orient="split", double_precision=12)


def save_json_index(file: Path, columns: Columns) -> None:
    pd.DataFrame(columns).to_json(file, orient="index", double_precision=12)


def save_json_rows(file: Path, columns: Columns) -> None:
    """The names, then rows."""
    file.write_text(json.dumps([[*columns], *np.stack([*columns.values()], axis=1).tolist()]))


def save_json_groups(file: Path, columns: Columns) -> None:
    """Groups with time vectors of their own."""
    ins = {name: array.tolist() for name, array in columns.items() if name not in STEERING}
    can = {"t": columns["t"][::2].tolist(), STEERING[0]: columns[STEERING[0]][::2].tolist()}
    file.write_text(json.dumps({"car": "Leaf", "ins": ins, "can": can}))


def save_packed_datasets(file: Path, columns: Columns) -> None:
    """Integers with the factors and offsets of netCDF."""
    with h5py.File(file, "w") as root:
        for name, array in columns.items():
            packed = root.create_dataset(name, data=np.round((array - array[0]) * 1e12).astype(np.int64))
            packed.attrs.update(scale_factor=1e-12, add_offset=[array[0]])


def save_json_series(file: Path, columns: Columns) -> None:
    file.write_text(json.dumps({"series": [{"name": f"{name} [deg/s]" if name == "yaw_rate" else name, "data": (
        np.degrees(array) if name == "yaw_rate" else array).tolist()} for name, array in columns.items()]}))


def save_json_lines_with_name_and_data(file: Path, columns: Columns) -> None:
    """Records of one instant each, which are no series."""
    file.write_text("\n".join(json.dumps({"name": "car", "data": [1, 2], **record}) for record in nest(columns)))


def save_parquet_with_long_cells(file: Path, columns: Columns) -> None:
    """Texts of two lines, and lists that numpy prints in several lines."""
    n = len(columns["t"])
    pd.DataFrame({"note": ['a\n"b", c'] * n, "scan": [np.arange(90) / 7] * n, **columns}).to_parquet(file)


def save_parquet_with_structs(file: Path, columns: Columns) -> None:
    pd.DataFrame(nest(columns)).to_parquet(file)


def save_datasets(file: Path, columns: Columns) -> None:
    """A group for each sensor, a dataset for each signal, with its unit as attribute; an image; and lost links."""
    with h5py.File(file, "w") as target:
        for name, values in columns.items():
            if name == "t":
                continue
            group, step = ("steering", 2) if name in STEERING else ("ins", 1)
            unit = "deg/s" if name == "yaw_rate" else ""
            target[f"{group}/{name}"] = (np.degrees(values) if unit else values)[::step, None].astype(">f8")
            target[f"{group}/{name}"].attrs["units"] = unit
            if f"{group}/time" not in target:
                target[f"{group}/time"] = 1e3 * columns["t"][::step]
                target[f"{group}/time"].attrs["units"] = np.bytes_("ms since 1970-01-01")
        target["camera"] = np.zeros((60, 40, 3))
        target["lost"] = h5py.SoftLink("/nowhere")
        target["video"] = h5py.ExternalLink("missing.h5", "/frames")
        target["ins/up"] = target["/"]
        target["ins/self"] = h5py.SoftLink("/ins")


def save_compound(file: Path, columns: Columns) -> None:
    with h5py.File(file, "w") as target:
        table = pd.DataFrame(columns).to_records(index=False)
        target.create_dataset("drives/first", data=table, compression="gzip", chunks=True)


def save_table_of_pandas(file: Path, columns: Columns) -> None:
    """What DataFrame.to_hdf(format="table") writes through PyTables, for a table with times as index."""
    names = [name for name in columns if name != "t"]
    rows = np.zeros(len(columns["t"]), [("index", "<i8"), ("values_block_0", "<f8", (len(names),))])
    rows["index"], rows["values_block_0"] = np.round(1e6 * columns["t"]), np.stack([columns[n] for n in names], axis=1)
    with h5py.File(file, "w") as target:
        target["drive/table"] = rows
        target["drive/_i_table/index"] = np.arange(len(rows))
        target["drive/_i_table"].attrs["CLASS"] = np.bytes_("TINDEX")
        target["drive"].attrs["info"] = np.bytes_(pickle.dumps({"index": {"index_name": "t"}}, 0))
        target["drive/table"].attrs["index_kind"] = np.bytes_("datetime64[us]")
        target["drive/table"].attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(names, 0))


def save_frame_of_pandas(file: Path, columns: Columns) -> None:
    """What DataFrame.to_hdf writes in its default format."""
    names = [name for name in columns if name != "t"]
    with h5py.File(file, "w") as target:
        group = target.create_group("drive")
        group.attrs.update({"pandas_type": np.bytes_("frame"), "nblocks": 1})
        group["axis1"] = columns["t"]
        group["axis1"].attrs.update({"name": np.bytes_("t"), "kind": np.bytes_("float")})
        group["block0_items"] = np.array(names, "S")
        group["block0_values"] = np.stack([columns[name] for name in names], axis=1)


def save_export_of_asammdf(file: Path, columns: Columns) -> None:
    mdf = MDF()
    for names, step in (([name for name in columns if name not in ("t", *STEERING)], 1), (STEERING, 2)):
        mdf.append([Signal(np.degrees(columns[name][::step]) if name == "yaw" else columns[name][::step],
                           columns["t"][::step], "deg" if name == "yaw" else "", name) for name in names])
    mdf.export("hdf5", file)
    mdf.close()


def save_external(file: Path, columns: Columns) -> None:
    """The signals are in another file."""
    save_datasets(file.with_suffix(".samples"), columns)
    with h5py.File(file, "w") as target:
        target["drive"] = h5py.ExternalLink(f"{file.stem}.samples", "/")


def save_virtual(file: Path, columns: Columns) -> None:
    """Virtual datasets of the samples in another file."""
    with h5py.File(file.with_suffix(".samples"), "w") as source, h5py.File(file, "w") as target:
        for name, values in columns.items():
            source[name] = values
            layout = h5py.VirtualLayout(values.shape, values.dtype)
            layout[:] = h5py.VirtualSource(f"{file.stem}.samples", name, values.shape)
            target.create_virtual_dataset(name, layout)


def load(file: Path) -> DriveLog:
    (source,) = find_runs([file])
    if source.problem:
        raise source.problem
    return read(source).log


MATLAB = [save_flat, save_nested, save_milliseconds, save_milliseconds_twice, save_seconds_and_milliseconds,
          save_simulink, save_control_desk,
          save_signal_structs, save_two_rates, save_ros_stamps, save_control_desk_rasters, save_time_series_structs]


@pytest.mark.parametrize("save", MATLAB)
def test_drive_of_matlab_7_3_equals_the_one_of_the_csv_file(
        columns: Columns, tmp_path: Path, save: Callable[[Path, Columns], None], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys.modules[__name__], "savemat", save_version_7_3)
    test_drive_equals_the_one_of_the_csv_file(columns, tmp_path, save, ".mat")


@pytest.mark.parametrize(("save", "extension"), [
    *((save, ".mat") for save in MATLAB), (save_datasets, ".h5"), (save_compound, ".hdf5"),
    (save_external, ".h5"), (save_virtual, ".h5"), (save_table_of_pandas, ".h5"), (save_frame_of_pandas, ".h5"),
    (save_export_of_asammdf, ".hdf"),
    (save_parquet_with_date_index, ".parquet"), (save_parquet_with_structs, ".parquet"),
    (save_json_lines, ".jsonl"), (save_json_records, ".json"), (save_json_columns, ".json"),
    (save_json_split, ".json"), (save_json_index, ".json"), (save_json_rows, ".json"), (save_json_groups, ".json"),
    (save_json_series, ".json"), (save_json_lines_with_name_and_data, ".jsonl"),
    (save_parquet_with_long_cells, ".parquet"), (save_packed_datasets, ".h5"),
    (lambda file, columns: pd.DataFrame(columns).to_json(file, double_precision=12), ".json"),
    (lambda file, columns: pd.DataFrame(columns).to_parquet(file), ".parquet"), (save_parquet_with_index, ".parquet"),
    (lambda file, columns: pd.DataFrame(columns).to_feather(file), ".feather"), (save_arrow_stream, ".arrow")])
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


@pytest.mark.parametrize(("text", "warning", "n_lost"), [
    (lambda rows: "\n".join(rows)[:-9], "damaged or truncated and were left out: 1; the first is in line 400", 1),
    (lambda rows: "\n".join([*rows[:9], rows[9][:20], *rows[10:]]), "were left out: 1; the first is in line 10", 1),
    (lambda rows: f"[{','.join(rows)}"[:-9], "were left out: 1; the first is in line 1", 1),
    (lambda rows: '{"car": {"parts": [{"a": 1}]}, "log": [\n' + ",\n".join(rows)[:-9], "the first is in line 401", 1),
    (lambda rows: "\n".join(f'{row}\n{{"topic": "gyro", "t": {k}, "z": 1}}' for k, row in enumerate(rows)),
     r"only its records of '.no topic.' are used, not those of 'gyro' \(400\)", 0)])
def test_json_without_its_end_or_with_records_of_other_kinds(
        columns: Columns, tmp_path: Path, text: Callable[[list[str]], str], warning: str, n_lost: int) -> None:
    (tmp_path / "drive.jsonl").write_text(text([*map(json.dumps, nest(columns))]))
    run = read(find_runs([tmp_path / "drive.jsonl"])[0])
    assert len(run.log.ins_time_ns) == 400 - n_lost and re.search(warning, "; ".join(run.warnings)), run.warnings
    rows = np.isin(np.arange(400) * 20, np.round(run.log.ins_time_ns / 1e6))
    np.testing.assert_allclose(run.log.x, columns["x"][rows])


def test_only_the_beginning_of_json_shows_its_columns(columns: Columns, tmp_path: Path) -> None:
    file = tmp_path / "drive.json"
    rows = [*map(json.dumps, nest(columns))]
    file.write_text("\n".join([*rows, '{"t": 9.0, "topic": "other"}'] + ['{"t": 9.0, "x": 1.0}'] * 9))
    assert len("\n".join(rows)) > HEAD_SIZE and read_names(file) == [*pd.json_normalize(nest(columns)).columns]


def test_columns_are_found_behind_the_beginning_of_json(columns: Columns, tmp_path: Path) -> None:
    content = {name: np.resize(array, 9000).tolist() for name, array in columns.items()}
    (tmp_path / "drive.json").write_text(json.dumps(content))
    assert read_names(tmp_path / "drive.json") == [*columns]


def test_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.parquet").write_bytes(b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(RunError, match="cannot be read without the Python package pyarrow; read it without"):
        load(tmp_path / "a.parquet")


def test_folder_with_the_same_drive_as_csv_txt_and_mat_is_one_run(columns: Columns, tmp_path: Path):
    for name in ("drive.csv", "drive.txt", "third.txt"):
        pd.DataFrame(columns).to_csv(tmp_path / name, index=False)
    save_flat(tmp_path / "drive.mat", columns)
    save_flat(tmp_path / "other.mat", columns)
    assert [source.files[0].name for source in find_runs([tmp_path])] == ["drive.csv", "other.mat", "third.txt"]


def test_complete_table_next_to_an_ncom_file_without_can_log_is_a_run(columns: Columns, tmp_path: Path):
    (tmp_path / "drive.ncom").touch()
    pd.DataFrame(columns).to_csv(tmp_path / "drive.txt", index=False)
    assert [source.files[0].name for source in find_runs([tmp_path]) if not source.problem] == ["drive.txt"]


@pytest.mark.parametrize("axis", [0, 1])
def test_columns_or_rows_of_a_matrix_can_be_named_in_a_run_file(columns: Columns, tmp_path: Path, axis: int):
    savemat(tmp_path / "drive.mat", {"log": np.stack(list(columns.values()), axis=axis)})
    names = ", ".join(f"{name}: log_{number}" for number, name in enumerate(columns, 1))
    (tmp_path / "drive.run.yaml").write_text(f"csv: drive.mat\ncolumns: {{{names}}}\n")
    np.testing.assert_allclose(load(tmp_path / "drive.run.yaml").velocity_x, columns["velocity_x"])


def save_without_its_samples(file: Path, save: Callable[[Path, Columns], None]) -> None:
    save(file, {name: np.ones(9) for name in ("t", "x", *STEERING)})
    file.with_suffix(".samples").unlink()


def save_blosc(file: Path) -> None:
    """A dataset whose filter HDF5 does not contain."""
    with h5py.File(file, "w") as target:
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk((9,))
        settings.set_filter(32001, h5py.h5z.FLAG_OPTIONAL, (2, 2))
        dataset = h5py.h5d.create(target.id, b"speed", h5py.h5t.NATIVE_DOUBLE, h5py.h5s.create_simple((9,)), settings)
        dataset.write_direct_chunk((0,), bytes(20))


def write_truncated_version_7_3(file: Path) -> None:
    save_version_7_3(file, {"t": np.arange(1000.0), "x": np.arange(1000.0)})
    file.write_bytes(file.read_bytes()[:9000])


def test_code_in_an_attribute_of_a_table_is_not_run(columns: Columns, tmp_path: Path):
    class Code:
        def __reduce__(self) -> tuple[Any, ...]:
            return (tmp_path.joinpath("run").mkdir, ())

    save_table_of_pandas(tmp_path / "a.h5", columns)
    with h5py.File(tmp_path / "a.h5", "r+") as target:
        target["drive"].attrs["info"] = np.bytes_(pickle.dumps(Code(), 0))
    load(tmp_path / "a.h5")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("write", "name", "message"), [
    (write_truncated_version_7_3, "a.mat", r"cannot be read \(.*truncated.*\); copy it again, or export it as"),
    (lambda file: file.write_text("t,x,y\n1,2,3\n"), "a.h5", "cannot be read"),
    (lambda file: save_object(file, {"gain": 3.0}, log="timetable", v="timeseries", note="string"), "a.mat",
     r"objects that only MATLAB can read: log \(timetable\), v \(timeseries\); save their samples as vectors or fields "
     r"of a struct, for example v = struct\('Time', v\.Time, 'Data', v\.Data\); writetimetable\(log, 'log\.csv'\)"),
    (lambda file: save_object(file, {"x": np.ones(9), "y": np.ones(9)}, t="duration"), "a.mat",
     r"only MATLAB can read: t \(duration\); .* for example t = seconds\(t\)"),
    (lambda file: save_object(file, {"gain": 3.0}, note="string"), "a.mat", "it contains no vectors"),
    (lambda file: save_without_its_samples(file, save_external), "a.h5",
     r"a\.h5: its drive is a link to /\S* in the file a\.samples, which cannot be opened; also copy that file"),
    (lambda file: save_without_its_samples(file, save_virtual), "a.h5",
     r"its /\w+ is a link to the file a\.samples, which cannot be opened; also copy that file"),
    (save_blosc, "a.h5", r"its /speed is compressed with .* \(HDF5 filter 32001\), which h5py cannot read; save it un"),
    (lambda file: file.write_text("t,x,y\n1,2,3\n"), "a.mat", "cannot be read"),
    (lambda file: savemat(file, {"gain": 3.0, "car": "Leaf"}), "a.mat", "it contains no vectors; save the samples"),
    (lambda file: savemat(file, {"speed": np.ones(9)}), "a.mat",
     "no column was recognised as t, x .or longitude., y .or latitude., yaw"),
    (lambda file: file.write_bytes(b"PAR1 broken"), "a.parquet", "cannot be read"),
    (lambda file: file.write_text('{"name": "speed", "value": 3.5, "timestamp": 2.0}\n' * 2), "a.jsonl",
     r"it has one row for each value \(columns name and value\); export one column for each name"),
    (lambda file: file.write_text("[]"), "a.jsonl", "it has no records; write one file with all channels in each"),
    (lambda file: file.write_bytes('[{"t": 0, "Größe": 1}]'.encode("cp1252")), "a.jsonl", "its columns are t, Größe"),
    (lambda file: file.write_text('[{"t": 0, "Größe": 1}]', "utf-16"), "a.jsonl", "its columns are t, Größe"),
    (lambda file: file.write_text('{"t": 0.0, "x"'), "a.jsonl", r"cannot be read \(.*line 1 .*\); copy it again"),
    (lambda file: file.write_text('[{"sensor": "gyro", "z": 1}, {"sensor": "magnet", "z": 2}]'), "a.jsonl",
     r"it has no kinds of records with time, position, yaw and speed, among 'gyro' \(1\), 'magnet' \(1\); write one"),
    (lambda file: file.write_text('{"car": [{"t": 0, "x": 1}], "bus": [{"t": 0, "x": 2}]}'), "a.jsonl", "'car' .1., '"),
    (lambda file: file.write_text('[{"t": 0, "lat": 1}, {"t": 0, "speed": 2}]'), "a.jsonl",
     r"among 'lat t' \(1\), 'speed t' \(1\)"),
    (lambda file: file.write_text(json.dumps({key: [dict.fromkeys(("t", "x", "y", "yaw", "vx"), 1)] for key in "ab"})),
     "a.jsonl", r"it has several kinds of records with time, .*'a' \(1\), 'b'")])
def test_error_names_the_reason_and_the_remedy(tmp_path: Path, write: Callable[[Path], None], name: str,
                                                 message: str):
    write(tmp_path / name)
    for path in (tmp_path / name, tmp_path):  # a folder that contains only this file reports it, too
        with pytest.raises(RunError, match=message):
            load(path)
