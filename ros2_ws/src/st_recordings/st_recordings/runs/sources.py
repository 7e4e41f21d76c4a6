"""Which files make a run: the same stem, one folder, one list of files, or a run.yaml that says it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from st_core import yaml_text
from st_core.errors import ConfigurationError

from . import run_keys
from .can_formats import EXTENSIONS as CAN_EXTENSIONS
from .errors import RunError
from .mf4 import session_of
from .readers import READERS, Reader, reader_of
from .run_types import Label, RunSource

RUN_FILE = "run.yaml"
RUN_SUFFIX = ".run.yaml"
NO_NAME = ("run", "bag")  # says nothing (run.ncom with run.mf4, bag/ of st live): the folder's name is the run's
_FILES = tuple(dict.fromkeys(reader.key for reader in sorted(READERS.values(), key=lambda one: not one.with_can)))
_KEYS = ("name", *_FILES, "can", "offset", "ins_can_latency", "labels", "dbc", "signals", *run_keys.KEYS)


def find_runs(paths: Sequence[Path | str]) -> list[RunSource]:
    """The runs in files and folders, in order of name; what should have been a run and is none carries its `problem`.

    Files given one by one that belong together (one INS recording and CAN logs) are one run. In a folder, searched
    through all its levels, files that are no recording at all are passed over, and so are bags without odometry.
    """
    runs: list[RunSource] = []
    loose: list[Path] = []
    for path in map(Path, paths):
        if not path.exists():
            around = path.absolute().parent
            beside = [other.name for other in around.iterdir()] if around.is_dir() else []
            runs.append(_failed(path, RunError(path, "there is no such file or folder", f"looked for in {around}"
                                               f"{yaml_text.nearest(path.name, beside)}")))
        elif (reader := reader_of(path)) is not None and not reader.with_can:
            runs.append(_alone(path, reader))
        elif path.is_dir():
            found = _in_folder(path)
            runs += found or [_failed(path, RunError(path, "no recording is in this folder",
                                                     "give a folder with .ncom and CAN logs, bags or CSV files"))]
        elif path.name == RUN_FILE or path.name.endswith(RUN_SUFFIX):
            runs.append(_from_run_file(path))
        else:
            loose.append(path)
    runs += _from_files(loose, given=True)
    return _with_own_names(runs)


def _in_folder(folder: Path) -> list[RunSource]:
    runs: list[RunSource] = []
    taken: set[Path] = set()
    files: list[Path] = []
    for path in sorted(folder.rglob("*")):
        if any(part.startswith(".") for part in path.relative_to(folder).parts):
            continue
        if any(parent in taken for parent in path.parents):
            continue
        if path.is_dir():
            if (reader := reader_of(path)) is not None:
                taken.add(path)
                if reader.holds_drive(path):
                    runs.append(_alone(path, reader))
        elif path.name == RUN_FILE or path.name.endswith(RUN_SUFFIX):
            run = _from_run_file(path)
            runs.append(run)
            taken.update({*run.files, *run.can})
        else:
            files.append(path)
    loose = []
    for path in files:
        if path in taken:
            continue
        if (reader := reader_of(path)) is None or reader.with_can:
            loose.append(path)
        elif reader.holds_drive(path):
            runs.append(_alone(path, reader))
    return runs + _from_files(loose, given=False)


def _alone(path: Path, reader: Reader) -> RunSource:
    return RunSource(path.name if path.is_dir() else path.stem, reader.kind, (path,))


def _from_files(files: Sequence[Path], given: bool) -> list[RunSource]:
    """Runs out of INS recordings and CAN logs that lie loose.

    given: the user named each of them, so one that is no recording is a problem.
    """
    runs: list[RunSource] = []
    kinds = {f: reader.kind for f in files if (reader := reader_of(f)) is not None}
    ins = list(kinds)
    logs = [f for f in files if f.suffix.lower() in CAN_EXTENSIONS]
    for file in files:
        if given and file not in ins and file not in logs:
            known = ", ".join(sorted({*CAN_EXTENSIONS, *(e for one in READERS.values() for e in one.extensions)}))
            what = f"the extension {file.suffix or '(none)'} is not one of a recording"
            runs.append(_failed(file, RunError(file, what, f"known are {known}, folders of bags, and run.yaml")))
    rest = []
    for file in ins:
        same = [f for f in logs if f.stem == file.stem and f.parent == file.parent]
        if given and not same and not any(f.suffix.lower() in CAN_EXTENSIONS for f in files):
            same = [f for f in sorted(file.parent.iterdir())
                    if f.stem == file.stem and f.suffix.lower() in CAN_EXTENSIONS]
        if same:
            runs.append(RunSource(file.stem, kinds[file], (file,), tuple(same)))
            logs = [f for f in logs if f not in same]
        else:
            rest.append(file)
    if len(rest) == 1 and logs:
        return [*runs, RunSource(rest[0].stem, kinds[rest[0]], (rest[0],), tuple(logs))]
    for file in rest:
        several = "several INS recordings and CAN logs lie here" if logs else "there is no CAN log with the same stem"
        runs.append(_failed(file, RunError(file, f"no CAN log belongs to it: {several}",
                                           "name the files alike, or say which belong together in a run.yaml")))
    for session in dict.fromkeys(session_of(f)[0] for f in logs) if not rest else ():
        file = next(f for f in logs if session_of(f)[0] == session)
        runs.append(_failed(file, RunError(file, "there is no INS recording (.ncom) for this CAN log",
                                           "give both, or say in a run.yaml which belong together")))
    return runs


def _from_run_file(path: Path) -> RunSource:
    try:
        return _parsed(path)
    except RunError as error:
        return _failed(path, error)


def _parsed(path: Path) -> RunSource:
    try:
        content = yaml_text.load(path.read_text(encoding="utf-8"))
    except (OSError, ConfigurationError, UnicodeDecodeError) as error:
        raise RunError(path, f"is not YAML as wanted here: {' '.join(str(error).split())[:200]}") from None
    if not isinstance(content, dict):
        raise RunError(path, "does not hold keys and values", f"known keys are {', '.join(_KEYS)}")
    unknown = [key for key in content if key not in _KEYS]
    if unknown:
        raise RunError(path, f"key {unknown[0]} is not known", f"known keys are {', '.join(_KEYS)}")
    keys = [key for key in _FILES if key in content]
    if len(keys) != 1:
        what = f"{', '.join(_FILES[:-1])} and {_FILES[-1]}"
        raise RunError(path, f"one of the keys {what} must say where the INS measurements are")
    file = _existing(path, keys[0], content[keys[0]])
    reader = reader_of(file, keys[0])
    assert reader is not None  # the key is one of theirs
    logs: list[Path] = []
    for text in _listed(path, "can", content.get("can", [])):
        logs += [f for entry in _matching(path, text) for f in (sorted(entry.rglob("*")) if entry.is_dir() else [entry])
                 if f.is_file() and f.suffix.lower() in CAN_EXTENSIONS]
    if reader.with_can and not logs:
        raise RunError(path, "key can names no CAN log", "list the logs, a folder of them, or a pattern")
    offset = content.get("offset")
    if offset is not None and (isinstance(offset, bool) or not isinstance(offset, int | float)):
        raise RunError(path, f"offset: {offset!r} is not a number of seconds")
    settings: dict[str, Any] = {key: _existing(path, key, content[key]) for key in ("dbc", "signals") if key in content}
    if offset is not None:
        settings["offset"] = float(offset)
    if "ins_can_latency" in content:
        settings["ins_can_latency"] = _latency(path, content["ins_can_latency"])
    settings |= run_keys.understood(path, content, keys[0])
    default = path.parent.name if path.name == RUN_FILE else path.name.removesuffix(RUN_SUFFIX)
    name = _plain_name(path, content.get("name", default))
    return RunSource(name, reader.kind, (file,), tuple(logs), _labels(path, content.get("labels", [])), settings)


def _matching(path: Path, text: str) -> list[Path]:
    if not any(c in text for c in "*?["):
        return [_existing(path, "can", text)]
    try:
        return sorted(path.parent.glob(text))
    except (ValueError, NotImplementedError, OSError) as error:
        raise RunError(path, f"can: {text[:100]!r} is no pattern ({error})",
                       "patterns are relative to the run file; * is a part of a name, **/ are folders") from None


def _latency(path: Path, value: Any) -> tuple[float, float]:
    try:
        latency, deviation = map(float, value)
        if 0.0 <= latency <= 1.0 and 0.0 <= deviation <= 1.0:
            return latency, deviation
    except (TypeError, ValueError):
        pass
    raise RunError(path, f"ins_can_latency: {value!r} is not [latency, standard deviation] in seconds, each 0 to 1")


def _plain_name(path: Path, value: Any) -> str:
    """Results are filed by it, so it must not lead anywhere else."""
    name = str(value)
    if not name.isprintable() or name in ("", ".", "..") or "/" in name or "\\" in name:
        raise RunError(path, f"name: {name[:100]!r} cannot be the name of a folder", "leave out slashes")
    return name


def _existing(path: Path, key: str, text: Any) -> Path:
    try:
        if isinstance(text, str) and (path.parent / text).exists():
            return path.parent / text
    except (OSError, ValueError):  # a name no file can have
        pass
    raise RunError(path, f"{key}: there is no {str(text)[:200]!r} beside it")


def _listed(path: Path, key: str, value: Any) -> list[str]:
    entries = [value] if isinstance(value, str) else value
    if not isinstance(entries, list) or not all(isinstance(e, str) for e in entries):
        raise RunError(path, f"{key}: a file or a list of files is wanted")
    return entries


def _labels(path: Path, value: Any) -> tuple[Label, ...]:
    try:
        labels = tuple(Label(str(entry["name"]), float(entry["start"]), float(entry["end"])) for entry in value)
    except (KeyError, TypeError, ValueError):
        raise RunError(path, "labels: a list of {name, start, end} is wanted, in seconds from the start") from None
    for label in labels:
        if not label.start < label.end:
            raise RunError(path, f"labels: {label.name} ends ({label.end:g} s) before it starts ({label.start:g} s)")
    return labels


def _failed(path: Path, problem: RunError) -> RunSource:
    return RunSource(path.name, "", (path,), problem=problem)


def _with_own_names(runs: Sequence[RunSource]) -> list[RunSource]:
    """Names told apart by their folder where two are the same: results are filed by them."""
    taken: set[str] = set()
    named = []
    for run in sorted(runs, key=lambda r: (r.name, str(r.where))):
        name = run.name
        if name in NO_NAME and run.files:
            name = run.where.absolute().parent.name or name
        if name in taken and run.files:
            name = f"{run.where.absolute().parent.name}_{run.name}"
        number = 2
        while name in taken:
            name, number = f"{run.name}_{number}", number + 1
        taken.add(name)
        named.append(RunSource(name, run.kind, run.files, run.can, run.labels, run.settings, run.problem))
    return named
