"""Reads tables from MDF files of measured signals (version 3 or 4, as ETAS INCA, Vector CANape and asammdf write them),
and from files of MATLAB (.mat), HDF5 (.h5, .hdf5, .hdf), Apache Parquet (.parquet), Feather (.feather) and JSON.

The tables are converted to the text of a CSV file, so that names, units, times and rates are handled in the same way.
"""

import json
import mmap
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from datetime import UTC
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from st_core.log import INS_SIGNALS

from ..paths import cached_by_version
from . import hdf5
from .columns import Layout, add_fraction, find_ambiguous_steering, find_columns, find_missing, find_stamp_columns
from .errors import CP1252_FALLBACK, RunError, convert_errors, find_codec
from .mdf_blocks import describe_truncation
from .mf4 import MDF_OPTIONS, open_mdf

PARQUET_EXTENSIONS = (".parquet", ".pq")
ARROW_EXTENSIONS = (*PARQUET_EXTENSIONS, ".feather", ".arrow")
JSON_EXTENSIONS = (".json", ".jsonl", ".ndjson")
BINARY_EXTENSIONS = (".mat", *hdf5.EXTENSIONS, *ARROW_EXTENSIONS, *JSON_EXTENSIONS)
NAME_FIELDS = ("label", "Name", "name")
HEAD_SIZE = 1 << 16  # number of characters in which the columns of JSON records are found
_RECORDS, _SEPARATORS = re.compile(r"(?:\A|\[)\s*(?={)"), re.compile(r"[\s,]*")
_RAW_FRAMES = re.compile(rb"\0CAN_(Data|Remote|Error)Frame")
"""Name of the channel of raw frames, after the zero byte that ends the block header; in a comment, none precedes it."""
_NO_DELIMITERS = str.maketrans(',"\n', "   ")


class _Vector(NamedTuple):
    """One vector of samples in a file.

    path: names of the structs that contain it, and its own name. time: (name, times (n,)) from the innermost struct
    that has a time vector of this length; None if there is none.
    """

    path: tuple[str, ...]
    unit: str
    samples: np.ndarray  # (n,)
    time: tuple[str, np.ndarray] | None


@cached_by_version(maxsize=4)
def read_binary_table(file: Path) -> tuple[list[str], str, list[str]]:
    """(header, comma-separated rows, warnings) of a file. Raises RunError if it cannot be read or has no vectors."""
    warnings: list[str] = []
    frame = _load_frame(file, -1, warnings).apply(lambda column: column if column.dtype.kind in "biufmM" else
                                                  column.map(lambda cell: " ".join(str(cell).split()), "ignore"))
    return [*map(str, frame.columns)], frame.to_csv(index=False, header=False, lineterminator="\n"), warnings


@cached_by_version(maxsize=256)
def read_names(file: Path) -> list[str]:
    """Column names; those of MDF are "t [s]", then the signals with their units, such as "YawRate [deg/s]". Only the
    schema of Parquet and the first records of JSON are read. Raises RunError."""
    if not is_signal_table(file):
        return [str(name) for name in _load_frame(file, HEAD_SIZE, []).columns]
    with _open_file(file) as mdf:
        return ["t [s]", *(name for name, _, _, _ in _list_signals(mdf))]


def _load_frame(file: Path, size: int, warnings: list[str]) -> Any:
    """DataFrame of a file. size: number of characters of JSON records that are read; -1: all."""
    extension, objects = file.suffix.lower(), dict[str, str]()
    with convert_errors(file, "cannot be read", "copy it again, or export it as .csv", Exception):  # of any library
        if extension in ARROW_EXTENSIONS:
            return _load_arrow(file, size)
        if extension in JSON_EXTENSIONS:
            return _load_json(file, size, warnings)
        if extension in hdf5.EXTENSIONS or hdf5.is_hdf5(file):
            content, objects = hdf5.read_hdf5(file)
        else:
            content = import_module("scipy.io").loadmat(file, simplify_cells=True)
    has_objects = content.pop("__function_workspace__", None) is not None
    signals = list(_find_signals(content))
    lacks_times = not any(signal.time for signal in signals) and not hdf5.TIME_CLASSES.isdisjoint(objects.values())
    if objects and (len(signals) < 2 or lacks_times):
        hdf5.reject_objects(file, objects)
    if has_objects and len(signals) < 2:  # none, or only the vector tout of Simulink
        raise RunError(file, "it contains objects such as timeseries or timetables, which only MATLAB can read",
                       "save their samples as vectors or fields of a struct")
    return _join_signals(file, signals)


def _load_arrow(file: Path, size: int) -> Any:
    import pandas as pd
    from pyarrow import feather, ipc, parquet, types

    with file.open("rb") as stream:
        is_stream = stream.peek(4)[:4] == b"\xff" * 4  # Arrow stream, without the magic bytes of a file
        if file.suffix.lower() in PARQUET_EXTENSIONS:
            table = parquet.read_table(file) if size < 0 else parquet.read_schema(file).empty_table()
        else:
            table = ipc.open_stream(stream).read_all() if is_stream else feather.read_table(file)
    while any(map(types.is_struct, table.schema.types)):
        table = table.flatten()
    frame = table.to_pandas()
    if isinstance(frame.index, pd.RangeIndex):
        return frame
    return frame.reset_index(names="time" if frame.index.name is None and frame.index.dtype.kind in "mM" else None)


def _load_json(file: Path, size: int, warnings: list[str]) -> Any:
    """Table of records of one kind, nested fields as columns such as pose.x; or of columns, as by DataFrame.to_json."""
    import pandas as pd

    content, records = None, dict[str, list[dict[str, Any]]]()
    with file.open("rb") as stream:
        codec = find_codec(stream.read(4096))
    with file.open(encoding=codec, errors=CP1252_FALLBACK) as stream:
        with suppress(ValueError):  # the first characters may contain no complete record
            content = _parse_json(file, stream.read(size), warnings) if size > 0 else None
            records = _find_records(content)
        if not records:
            stream.seek(0)
            content = _parse_json(file, stream.read(), warnings)
            records = _find_records(content)
    if any(map(_are_series, records.values())):
        return _join_signals(file, list(_find_signals(_make_vectors(content))))
    if records or not content or not isinstance(content, dict | list):
        return pd.json_normalize(_select_records(file, records, warnings))
    if isinstance(content, list):  # the names of the columns, then rows
        return pd.DataFrame(content[1:], columns=content[0])
    if content.keys() >= {"columns", "data"}:
        return pd.DataFrame(content["data"], columns=content["columns"])
    columns = {name: array for name, array in content.items() if isinstance(array, list)}
    if len(set(map(len, columns.values()))) == 1:
        return pd.DataFrame(columns)
    if all(isinstance(cells, dict) and not any(isinstance(cell, list | dict) for cell in cells.values())
           for cells in content.values()):  # column -> row -> cell, or row -> column -> cell
        frames = pd.DataFrame(content), pd.DataFrame.from_dict(content, orient="index")
        return max(frames, key=lambda frame: len(find_columns(file, [*map(str, frame.columns)], Layout())))
    return _join_signals(file, list(_find_signals(_make_vectors(content))))


def _make_vectors(value: Any) -> Any:
    """JSON content with lists of numbers as arrays; null is NaN."""
    if isinstance(value, dict):
        return {name: _make_vectors(entry) for name, entry in value.items()}
    if isinstance(value, list) and value and all(isinstance(number, float | int | None) for number in value):
        return np.array(value, float)
    return [*map(_make_vectors, value)] if isinstance(value, list) else value


def _are_series(rows: list[dict[str, Any]]) -> bool:
    """Whether each record has a name of its own and all samples of a signal, as {"name": "vx", "data": [...]}."""
    labels = {row[name] for row in rows for name in NAME_FIELDS if isinstance(row.get(name), str) and any(
        isinstance(row.get(field), list) for field in hdf5.SAMPLE_FIELDS)}
    return len(labels) >= len(rows) > 1


def _parse_json(file: Path, text: str, warnings: list[str]) -> Any:
    """The value in a text; or its records if there is one in each line, or if the text is truncated or damaged, with a
    warning about the damage."""
    try:
        return json.loads(text)
    except ValueError as error:
        reason = error
    decoder, records, damage, end = json.JSONDecoder(), list[Any](), list[int](), 0
    for start in _RECORDS.finditer(text):  # of an array, or of the text
        if start.end() < end:  # an array in a record
            continue
        found, damaged, end = list[Any](), list[int](), start.end()
        while end < len(text) and text[end] not in "]}" and (found or not damaged):
            try:
                record, end = decoder.raw_decode(text, end)
                found.append(record)
            except ValueError:
                damaged.append(text.count("\n", 0, end) + 1)
                end = text.find("\n", end) % (len(text) + 1)  # -1: the end
            end = _SEPARATORS.match(text, end).end()  # type: ignore[union-attr]
        if len(found) > len(records):
            records, damage = found, damaged
    if len(records) <= len(damage):
        raise reason
    if damage:
        warnings.append(f"{file}: records that are damaged or truncated and were left out: {len(damage)}; the first is "
                        f"in line {damage[0]}")
    return records


def _find_records(content: Any) -> dict[str, list[dict[str, Any]]]:
    """Kind -> its records, from arrays of objects: by the name of the array, by topic or sensor, and by the keys if no
    record has those of all others."""
    kinds: dict[str, list[dict[str, Any]]] = {}
    for name, value in (entries := [("", content)]):
        entries += value.items() if isinstance(value, dict) else ()
        for row in value if isinstance(value, list) else ():
            if isinstance(row, dict):
                kinds.setdefault(str(row.get("topic", row.get("sensor", name or "(no topic)"))), []).append(row)
    for kind, rows in list(kinds.items()):
        keys = [*map(frozenset, rows)]
        if frozenset().union(*keys) not in keys:
            del kinds[kind]
            for row, names in zip(rows, keys, strict=True):
                key = " ".join([kind.removeprefix("(no topic)"), *sorted(names)]).strip()[:40]
                kinds.setdefault(key, []).append(row)
    return kinds


def _select_records(file: Path, kinds: dict[str, list[dict[str, Any]]], warnings: list[str]) -> list[dict[str, Any]]:
    """The records of the only kind, or of the only one with all INS channels. Raises RunError."""
    import pandas as pd

    names = {kind: [*map(str, pd.json_normalize(max(rows, key=len)).columns)] for kind, rows in kinds.items()}
    usable_kinds = [kind for kind in kinds if len(kinds) == 1 or not find_missing(
        find_columns(file, names[kind], Layout()), names[kind], ("t", *INS_SIGNALS))]
    others = ", ".join(f"{kind!r} ({len(rows)})" for kind, rows in kinds.items() if [kind] != usable_kinds)[:200]
    if len(usable_kinds) != 1:
        kinds_text = f"kinds of records with time, position, yaw and speed, among {others}" if others else "records"
        raise RunError(file, f"it has {'several' if usable_kinds else 'no'} {kinds_text}", "write one file with all "
                       'channels in each record, as [{"t": 0.0, "x": 1.2}, ...]')
    if others:
        warnings.append(f"{file}: only its records of {usable_kinds[0]!r} are used, not those of {others}")
    return kinds[usable_kinds[0]]


def _join_signals(file: Path, signals: list[_Vector]) -> Any:
    """Table of the signals with a time vector.

    With several time vectors, each time [s] has a row, in which signals of the other vectors are NaN. Without a
    time vector, the table has the signals of the most frequent length. Raises RunError without signals.
    """
    import pandas as pd

    if not signals:
        raise RunError(file, "it contains no vectors", "save the samples as vectors or fields of a struct")
    own_names = Counter(signal.path[-1] for signal in signals)
    time_bases: dict[bytes, tuple[str, np.ndarray, dict[str, np.ndarray]]] = {}  # by times: (name, times, columns)
    length = Counter(len(signal.samples) for signal in signals).most_common(1)[0][0]
    untimed_columns: dict[str, np.ndarray] = {}
    for signal in signals:
        name = signal.path[-1] if own_names[signal.path[-1]] == 1 else "_".join(signal.path)
        name += f" [{signal.unit}]" if signal.unit else ""
        if signal.time is None:
            if len(signal.samples) == length:
                untimed_columns[name] = signal.samples
            continue
        time_name, times = signal.time
        _, _, columns = time_bases.setdefault(times.tobytes(), (time_name, times, {}))
        if not np.array_equal(signal.samples, times):
            columns[name] = signal.samples
    used_bases = [base for base in time_bases.values() if base[2]] or list(time_bases.values())
    if not used_bases:
        return pd.DataFrame(untimed_columns)
    if len(used_bases) == 1:
        ((time_name, times, columns),) = used_bases
        return pd.DataFrame({time_name: times, **columns})
    parts = []
    for time_name, times, columns in used_bases:
        factor = find_columns(Path(), [time_name], Layout())["t"].factor
        parts.append(pd.DataFrame(columns, index=np.round(times * factor, 6)))  # rounding errors depend on the unit
    merged = pd.concat([part[~part.index.duplicated()] for part in parts], axis=1, sort=True)
    return merged.rename_axis("t [s]").reset_index()


def _find_signals(value: Any, path: tuple[str, ...] = (), unit: str = "",
                  times: tuple[tuple[str, np.ndarray], ...] = ()) -> Iterator[_Vector]:
    """Yields the signals in structs, arrays of structs and matrices. times: (name, times) of the enclosing structs."""
    if isinstance(value, dict):
        own_times, value = _find_own_times(value)
        unit = next((value[name] for name in hdf5.UNIT_FIELDS if isinstance(value.get(name), str)), "")
        for name, entry in value.items():
            is_sample_field = path and name.lower() in hdf5.SAMPLE_FIELDS
            yield from _find_signals(entry, path if is_sample_field else (*path, name),
                                     unit if is_sample_field else "", (*own_times, *times))
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype.kind == "O"):
        for number, entry in enumerate(value, 1):
            labels = [label for name in NAME_FIELDS
                      if isinstance(entry, dict) and isinstance(label := entry.get(name), str) and label]
            yield from _find_signals(entry, (*path[:-1], labels[0]) if labels else (*path, str(number)), "", times)
    elif _is_vector(value):
        yield _Vector(path, unit, value, next((time for time in times if len(time[1]) == len(value)), None))
    elif isinstance(value, np.ndarray) and value.ndim == 2 and 1 < min(value.shape) <= hdf5.MAX_MATRIX_COLUMNS:
        # The columns are signals, or the rows if there are too many columns.
        for number, column in enumerate(value.T if value.shape[1] <= hdf5.MAX_MATRIX_COLUMNS else value, 1):
            yield from _find_signals(column, (*path[:-1], f"{path[-1]}_{number}"), unit, times)


def _find_own_times(struct: dict[str, Any]) -> tuple[list[tuple[str, np.ndarray]], dict[str, Any]]:
    """((name, times) of each time vector of a struct, the fields of the struct except time axes of ControlDesk)."""
    vectors = [name for name, entry in struct.items() if _is_vector(entry)]
    source, stamp = find_columns(Path(), vectors, Layout()).get("t"), find_stamp_columns(vectors)
    own_times = [(vectors[source.column], struct[vectors[source.column]])] if source else []
    if source and stamp and source.column == stamp[0]:  # for example, sec and nanosec of a ROS stamp
        seconds, fraction = (struct[vectors[column]] for column in stamp[:2])
        if len(seconds) == len(fraction) and (total := add_fraction(seconds, stamp[2] * fraction)) is not seconds:
            own_times = [("t [s]", total)]
    axes = struct.get("X")  # dSPACE ControlDesk: one time vector, or one for each raster, of different lengths
    axes = [axis["Data"] for axis in (axes if isinstance(axes, list) else [axes])
            if isinstance(axis, dict) and _is_vector(axis.get("Data"))]
    if axes and len(set(map(len, axes))) == len(axes):
        own_times += [("time", axis) for axis in axes]
        struct = {name: entry for name, entry in struct.items() if name != "X"}
    return own_times, struct


def _is_vector(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 1 and len(value) > 1 and value.dtype.kind in "biuf"


@cached_by_version(maxsize=256)
def is_signal_table(file: Path) -> bool:
    """Whether a file is a finalised, readable MDF file without raw CAN frames."""
    try:
        with file.open("rb") as stream:
            if stream.read(4) != b"MDF ":
                return False
            with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
                return not describe_truncation(content[:96], len(content)) and _RAW_FRAMES.search(content) is None
    except OSError:
        return False


def read_signals(file: Path, layout: Layout, warnings: list[str]) -> tuple[list[str], str]:
    """(header, comma-separated rows) of the signals that are or may be channels of a drive, or are named by the layout.

    Each time at which a signal was measured has a row, with nan for signals without a sample; of several samples at one
    time, the first is used. Times are UTC, or relative to the start of a measurement without a date. An array
    becomes the text "array". Appends a warning about each name with several signals. Raises RunError if asammdf fails.
    """
    import pandas as pd

    columns = []
    with _open_file(file) as mdf:
        signals = _list_signals(mdf)
        names = ["t [s]", *(name for name, _, _, _ in signals)]
        named_signals = {source.column - 1 for source in find_columns(file, names, layout).values()}
        start = mdf.header.start_time  # without a time zone it is read as UTC, so that all machines agree
        start_us = round((start if start.tzinfo else start.replace(tzinfo=UTC)).timestamp() * 1e6)
        for number, (name, group, index, occurrences) in enumerate(signals):
            if not (number in named_signals or find_columns(file, [name], Layout()) or find_ambiguous_steering([name])):
                continue
            signal = mdf.get(group=group, index=index)
            samples = signal.samples
            if samples.ndim > 1 or samples.dtype.names:
                samples = np.full(len(samples), "array")  # asammdf also lists its elements: NAME[0], NAME[1], ...
            elif samples.dtype.kind == "b":
                samples = samples.astype(np.uint8)  # with gaps, pandas would write booleans as text
            elif samples.dtype.kind == "S":  # names of an enumeration
                samples = np.array([text.decode("utf-8", "replace").translate(_NO_DELIMITERS) for text in samples])
            is_valid = slice(None) if signal.invalidation_bits is None else ~signal.invalidation_bits
            time_us = start_us + np.round(signal.timestamps * 1e6).astype(np.int64)
            column = pd.Series(samples[is_valid], time_us[is_valid] / 1e6, name=name)
            columns.append(column[~column.index.duplicated()])
            if occurrences > 1:
                warnings.append(f"{file}: {occurrences} signals share the name {name}; the one with the most samples "
                                "is used")
    if not columns:
        return ["t [s]"], ""
    table = pd.concat(columns, axis=1, sort=True)
    # Three times as fast as DataFrame.to_csv
    row = ",".join(["%.6f", *("%.12g" if pd.api.types.is_numeric_dtype(kind) else "%s" for kind in table.dtypes)])
    return ["t [s]", *table.columns], "\n".join([row % cells for cells in table.itertuples(name=None)])


def _list_signals(mdf: Any) -> list[tuple[str, int, int, int]]:
    """(name with unit, group and index of the longest signal, number of signals) for each name except times."""
    longest: dict[str, tuple[int, str, int, int]] = {}  # name -> (number of samples, name with unit, group, index)
    occurrences: Counter[str] = Counter()
    for group, content in enumerate(mdf.groups):
        length = content.channel_group.cycles_nr
        for index, channel in enumerate(content.channels):
            name = channel.name.split("\\")[0]  # INCA appends the device: YawRate\CAN-Monitoring:1
            if index == mdf.masters_db.get(group):
                continue
            occurrences[name] += 1
            if name in longest and length <= longest[name][0]:
                continue
            unit = mdf.get_channel_unit(group=group, index=index)
            name_lacks_unit = unit and not name.endswith(f"[{unit}]")
            longest[name] = length, f"{name} [{unit}]" if name_lacks_unit else name, group, index
    return [(*signal[1:], occurrences[name]) for name, signal in longest.items()]


def _open_file(file: Path) -> AbstractContextManager[Any]:
    from asammdf import MDF

    return open_mdf(file, lambda: MDF(file, **MDF_OPTIONS), "copy or export it again")
