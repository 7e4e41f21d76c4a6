"""Reads a run.yaml, which lists the files of a run and describes how to read, correct and label them."""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from canedge_bridge.units import UNITS, find_unit
from canedge_bridge.yaml_reader import read_document
from st_core import yaml_text
from st_core.corrections import CHANNELS, Correction, check_corrections
from st_core.errors import ConfigurationError, StCoreError
from st_core.log import INS_SIGNALS, OPTIONAL_INS_SIGNALS

from .can_formats import EXTENSIONS as CAN_EXTENSIONS
from .can_formats import is_can_log
from .columns import COLUMNS, Layout
from .errors import RunError, convert_errors, log_warnings
from .readers import READERS, find_reader
from .run_types import Label, RunSource

RUN_FILE = "run.yaml"
RUN_SUFFIX = ".run.yaml"
TABLE_KEYS = tuple(reader.key for reader in READERS.values() if reader.is_table)
_FILE_KEYS = tuple(dict.fromkeys(reader.key for reader in sorted(READERS.values(), key=lambda r: not r.needs_can)))
_KEYS = ("name", *_FILE_KEYS, "each", "can", "offset", "ins_can_latency", "labels", "dbc", "signals", "columns",
         "units", "correct", "leave_out")
_SINGLE_RUN_KEYS = (*_FILE_KEYS, "name", "can", "labels", "leave_out")


def is_run_file(path: Path) -> bool:
    return path.name == RUN_FILE or path.name.endswith(RUN_SUFFIX)


def read_run_file(path: Path) -> list[RunSource]:
    """Reads the run that a run.yaml describes, or one run per file under its key `each`, with the CAN logs of the same
    stem; a file's own run.yaml takes priority. Raises RunError."""
    content = _read_content(path)
    if "each" not in content:
        return [_parse_single_run(path, content)]
    if keys := [key for key in content if key in _SINGLE_RUN_KEYS]:
        raise RunError(path, f"key {keys[0]} describes one run, but `each` describes several",
                       "write a NAME.run.yaml for this run")
    files = dict.fromkeys(_find_matching_files(path, "each", content["each"]))
    if not files:
        raise RunError(path, f"each: no file matches {content['each']!r}",
                       "patterns are relative to the folder of the run.yaml")
    drives = [file for file in files if not is_can_log(file)] or files  # *.csv may also match CAN logs
    return [_read_own_run_file(file, path) or _parse_run_of_each(path, content, file) for file in drives]


def find_described_run(file: Path) -> RunSource | None:
    """The run of a single recording, as its own run.yaml or a run.yaml with `each` in its folder describes it; None if
    none does. If that run.yaml is invalid, its error is the `problem` of the result."""
    own_run = _read_own_run_file(file)
    if own_run and own_run.problem:
        return RunSource(file.name, "", (file,), problem=own_run.problem)
    if own_run and own_run.files == (file,):
        return own_run
    for path in sorted(file.parent.glob(f"*{RUN_FILE}")):
        if is_run_file(path) and path.is_file() and re.search(r"(?m)^each\s*:", path.read_text("utf-8", "replace")):
            try:
                runs = read_run_file(path)
            except RunError as error:
                if _may_describe(path, file):
                    return RunSource(file.name, "", (file,), problem=error)
                _log_unused_run_file(error)
                continue
            if (run := next((run for run in runs if file in run.files), None)) is not None:
                return run
    return None


def _may_describe(path: Path, file: Path) -> bool:
    """Whether an invalid run.yaml may be about a recording, judging by its own name and by names or patterns in its
    text (single words or ends of lines); True if the text is not UTF-8."""
    text = path.read_text("utf-8", "replace")
    values = re.findall(r"[^\s'\",\[\]]+", text) + re.findall(r"[:-] +(\S.*)", text)
    return path.name == file.stem + RUN_SUFFIX or file.name in text or "\N{REPLACEMENT CHARACTER}" in text or any(
        fnmatch(file.name, Path(value.strip("'\" \r")).name) for value in values)


def find_described_files(path: Path) -> list[Path]:
    """Files in the folder that an invalid run.yaml may describe; all for a plain run.yaml that names no recording."""
    files = [f for f in path.parent.iterdir() if f.is_file() or find_reader(f)]
    named_files = [f for f in files if _may_describe(path, f)]
    return files if path.name == RUN_FILE and not any(map(find_reader, named_files)) else named_files


def _log_unused_run_file(error: RunError) -> None:
    log_warnings([f"{error}; recordings that this file does not name are read without it"])


def read_yaml_mapping(file: Path) -> dict[str, Any]:
    """Reads the mapping in a YAML file; {} for an empty file. Raises RunError if it is unreadable or not a mapping."""
    try:
        mapping = read_document(file)
    except ConfigurationError as error:
        raise RunError(file, str(error).removeprefix(f"{file}: ")) from None
    if not isinstance(mapping, dict | None):
        raise RunError(file, "the file is not a YAML mapping")
    return mapping or {}


def _read_content(path: Path) -> dict[str, Any]:
    content = read_yaml_mapping(path)
    if unknown := [key for key in content if key not in _KEYS]:
        raise RunError(path, f"unknown key {unknown[0]}{yaml_text.suggest_key(unknown[0], _KEYS)}",
                       f"known keys are {', '.join(_KEYS)}")
    return content


def _parse_single_run(path: Path, content: Mapping[str, Any]) -> RunSource:
    file_keys = [key for key in _FILE_KEYS if key in content]
    if len(file_keys) != 1:
        keys = f"{', '.join(_FILE_KEYS[:-1])} and {_FILE_KEYS[-1]}"
        raise RunError(path, f"exactly one of the keys {keys} must name the file with the INS measurements",
                       "use `each` instead to read several recordings in the same way")
    key = file_keys[0]
    if key in TABLE_KEYS:  # only tables may consist of several files
        files = tuple(dict.fromkeys(_find_matching_files(path, key, content[key])))
        if not files:
            raise RunError(path, f"{key}: no file matches {content[key]!r}",
                           "patterns are relative to the folder of the run.yaml")
    else:
        files = (_find_file(path, key, content[key]),)
    logs = [f for entry in _find_matching_files(path, "can", content.get("can", []))
            for f in (sorted(entry.rglob("*")) if entry.is_dir() else [entry])
            if f.is_file() and (is_can_log(f) or (f == entry and f.suffix.lower() in CAN_EXTENSIONS))]
    default = path.parent.name if path.name == RUN_FILE else path.name.removesuffix(RUN_SUFFIX)
    name = str(content.get("name", default))  # results are stored under it
    if not name.isprintable() or name in ("", ".", "..") or "/" in name or "\\" in name:
        raise RunError(path, f"name: {name[:100]!r} cannot be the name of a folder",
                       "choose a name without slashes and control characters")
    return _build_run(path, content, name, key, files, logs)


def _read_own_run_file(file: Path, skipped: Path | None = None) -> RunSource | None:
    """Reads the run.yaml next to `file`, other than `skipped`, that lists `file`, or is invalid and may describe it."""
    own_files = (file.with_name(file.stem + RUN_SUFFIX), file.with_name(RUN_FILE))
    for own_file in (own_file for own_file in own_files if own_file.exists() and own_file != skipped):
        try:
            content = _read_content(own_file)
            if "each" not in content and file in (run := _parse_single_run(own_file, content)).files:
                return run
        except RunError as error:
            if _may_describe(own_file, file):
                return RunSource(own_file.name, "", (own_file,), problem=error, run_file=own_file)
            _log_unused_run_file(error)
    return None


def _parse_run_of_each(path: Path, content: Mapping[str, Any], file: Path) -> RunSource:
    reader = find_reader(file)
    if reader is None:
        raise RunError(path, f"each: {file.name} is not a recording", "make the pattern match only recordings")
    is_complete = reader.kind == "csv" and reader.has_drive(file)
    logs = [] if is_complete else [log for log in find_logs(file, sorted(file.parent.iterdir())) if is_can_log(log)]
    if reader.needs_can and not logs:
        raise RunError(path, f"each: the folder contains no CAN log with the name {file.stem} for {file.name}",
                       "list the files of each run in a run.yaml")
    return _build_run(path, content, file.name if file.is_dir() else file.stem, reader.key, (file,), logs)


def _build_run(path: Path, content: Mapping[str, Any], name: str, key: str, files: tuple[Path, ...],
               logs: Sequence[Path]) -> RunSource:
    reader = find_reader(files[0], key)
    assert reader is not None  # _FILE_KEYS are the keys of the readers
    if reader.needs_can and not logs:
        raise RunError(path, "can: no CAN log is listed", "list the logs, a folder that contains them, or a pattern")
    columns, units = content.get("columns", {}), content.get("units", {})
    layout = Layout(_parse_columns(path, columns), _parse_units(path, units), path)
    is_exchange = {*layout.columns} == {*layout.columns.values()} <= {*INS_SIGNALS, *OPTIONAL_INS_SIGNALS}
    if not reader.is_table and (layout.units or not is_exchange):
        raise RunError(path, f"only {' and '.join(TABLE_KEYS)} files have columns and units; `columns` of another "
                       "recording can only exchange its channels, as {x: y, y: x}", "change its values with `correct:`")
    settings = {setting: parse(path, setting, content[setting]) for setting, parse in _SETTINGS.items()
                if setting in content and (setting != "offset" or content[setting] is not None)}
    if layout.columns or layout.units:
        settings |= {"layout": layout} if reader.is_table else {"columns": layout.columns}
    return RunSource(name, reader.kind, files, tuple(logs), _parse_labels(path, content.get("labels", [])), settings,
                     run_file=path)


def find_logs(file: Path, files: Sequence[Path]) -> list[Path]:
    """Finds, among `files`, the CAN logs with the same folder and stem as the recording `file`."""
    return [f for f in files if f.stem == file.stem and f.parent == file.parent
            and (f.suffix.lower() in CAN_EXTENSIONS or is_can_log(f))]


def _find_matching_files(path: Path, key: str, value: Any) -> list[Path]:
    """Finds the files and folders that match a name or pattern, or a list of these. Raises RunError."""
    entries = [value] if isinstance(value, str) else value
    if not isinstance(entries, list) or not all(isinstance(e, str) for e in entries):
        raise RunError(path, f"{key}: expected a file or a list of files")
    matching_files: list[Path] = []
    for text in entries:
        with convert_errors(path, f"{key}: {text[:100]!r} is not a valid pattern", "patterns are relative to the "
                            "folder of the run.yaml; * matches a part of a name, **/ matches folders",
                            ValueError, NotImplementedError, OSError):
            is_pattern = any(c in text for c in "*?[") and not os.path.exists(path.parent / text)
            matching_files += sorted(path.parent.glob(text)) if is_pattern else [_find_file(path, key, text)]
    return matching_files


def _parse_latency(path: Path, key: str, value: Any) -> tuple[float, float]:
    try:
        latency, standard_deviation = map(float, value)
        if 0.0 <= latency <= 1.0 and 0.0 <= standard_deviation <= 1.0:
            return latency, standard_deviation
    except (TypeError, ValueError):
        pass
    raise RunError(path, f"{key}: {value!r} is not [latency, standard deviation] in seconds, each 0 to 1")


def _parse_number(path: Path, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise RunError(path, f"{key}: {str(value)[:40]!r} is not a number",
                       "write it without quotes or a unit, as -0.5 or 1.0e-2")
    return float(value)


def _find_file(path: Path, key: str, text: Any) -> Path:
    if isinstance(text, str) and os.path.exists(path.parent / text):
        return path.parent / text
    problem = "is not one file (join NCOM files with cat)" if isinstance(text, list) else "does not exist"
    raise RunError(path, f"{key}: {str(text)[:200]!r} {problem}", "paths are relative to the folder of the run.yaml")


def _parse_labels(path: Path, value: Any) -> tuple[Label, ...]:
    try:
        labels = tuple(Label(str(entry["name"]), float(entry["start"]), float(entry["end"])) for entry in value)
    except (KeyError, TypeError, ValueError):
        raise RunError(path, "labels: expected a list of {name, start, end} in s after the first INS sample") from None
    for label in labels:
        if not label.start < label.end:
            raise RunError(path, f"labels: {label.name} ends at {label.end:g} s but starts at {label.start:g} s")
    return labels


def _parse_columns(path: Path, value: Any) -> dict[str, str]:
    for channel, name in _check_mapping(path, "columns", value, COLUMNS).items():
        if not isinstance(name, str) or not name:
            raise RunError(path, f"columns: {channel}: {name!r} is not the name of a column", "put the name in quotes")
    return dict(value)


def _parse_units(path: Path, value: Any) -> dict[str, str]:
    units = {}
    for channel, text in _check_mapping(path, "units", value, COLUMNS).items():
        kind = COLUMNS[channel].kind
        unit = find_unit(kind, text) if isinstance(text, str) else None
        if unit is None:
            raise RunError(path, f"units: {channel}: {str(text)[:40]!r} is not a unit of {kind}",
                           f"known units are {', '.join(UNITS[kind])}")
        if unit:  # "" for a clock such as UTC
            units[channel] = unit
    return units


def _parse_corrections(path: Path, key: str, value: Any) -> dict[str, Correction]:
    corrections = {}
    for channel, mapping in _check_mapping(path, key, value, CHANNELS).items():
        entries = _check_mapping(path, f"{key}: {channel}", mapping, CHANNELS[channel])
        corrections[channel] = Correction(**{name: _parse_number(path, f"{key}: {channel}: {name}", number)
                                             for name, number in entries.items()})
    try:
        check_corrections(corrections)
    except StCoreError as error:
        raise RunError(path, f"{key}: {error}") from None
    return corrections


def _parse_intervals(path: Path, key: str, value: Any) -> tuple[tuple[float, float], ...]:
    try:
        intervals = tuple((float(start), float(end)) for start, end in value)
    except (TypeError, ValueError):
        intervals = ((np.nan, np.nan),)
    if not all(start < end for start, end in intervals):
        raise RunError(path, f"{key}: expected a list of [start, end] in seconds after the first INS measurement, "
                       "start before end")
    return intervals


def _check_mapping(path: Path, key: str, value: Any, known_keys: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise RunError(path, f"{key}: expected a mapping", f"known keys are {', '.join(known_keys)}")
    unknown = [name for name in value if name not in known_keys]
    if unknown:
        raise RunError(path, f"{key}: unknown key {unknown[0]}{yaml_text.suggest_key(unknown[0], known_keys)}",
                       f"known keys are {', '.join(known_keys)}")
    return value


_SETTINGS: Mapping[str, Callable[[Path, str, Any], Any]] = {
    "dbc": _find_file, "signals": _find_file, "offset": _parse_number, "ins_can_latency": _parse_latency,
    "correct": _parse_corrections, "leave_out": _parse_intervals}
