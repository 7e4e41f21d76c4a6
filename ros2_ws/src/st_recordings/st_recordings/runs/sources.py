"""Which files make a run: the same stem, one folder, one list of files, the splits of a bag, or a run.yaml."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from st_core import yaml_text

from ..paths import natural_order
from .bag_storage import EXTENSIONS as BAG_EXTENSIONS
from .bag_storage import time_span
from .can_formats import EXTENSIONS as CAN_EXTENSIONS
from .can_formats import is_can_log
from .errors import RunError
from .mf4 import session_of
from .readers import READERS, Reader, reader_of
from .run_file import RUN_FILE, RUN_SUFFIX, is_run_file, read_run_file
from .run_types import RunSource

__all__ = ["RUN_FILE", "RUN_SUFFIX", "find_runs"]

NO_NAME = ("run", "bag")  # of no meaning (run.ncom with run.mf4, bag/ of st live): the run has the folder's name
DOCUMENTS = (".md", ".txt", ".rst", ".pdf", ".html", ".png", ".jpg", ".json", ".yaml", ".yml", "")
"""Extensions that no recording has: README, LICENSE and the like, ignored among recordings."""
SPLIT_GAP = 5.0
"""s, longest time between the end of one file of a bag and the start of the next."""


def find_runs(paths: Sequence[Path | str]) -> list[RunSource]:
    """The runs in files and folders, in order of name; an entry that cannot be a run carries its `problem`.

    Files given one by one that belong together (one INS recording and CAN logs, or the splits of a bag) are one run.
    In a folder, searched through all its levels, other files are ignored, and so are bags without
    odometry.
    """
    runs: list[RunSource] = []
    loose: list[Path] = []
    for path in map(Path, paths):
        if not path.exists():
            around = path.absolute().parent
            others = [other.name for other in around.iterdir()] if around.is_dir() else []
            runs.append(_failed(path, RunError(path, "the file or folder does not exist", f"looked for in {around}"
                                               f"{yaml_text.nearest(path.name, others)}")))
        elif path.is_dir() and reader_of(path) is None:
            found = _in_folder(path)
            runs += found or [_failed(path, RunError(path, "no recording is in this folder",
                                                     "give a folder with .ncom and CAN logs, bags, CSV or VBO files"))]
        elif is_run_file(path):
            runs.append(_from_run_file(path))
        else:
            loose.append(path)
    if len(loose) > 1 or runs:
        kept = [f for f in loose if reader_of(f) or f.suffix.lower() not in DOCUMENTS]
        loose = kept or loose
    return _with_own_names([*runs, *_from_files(loose, given=True)])


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
            if reader_of(path) is not None:
                taken.add(path)
                files.append(path)
        elif is_run_file(path):
            run = _from_run_file(path)
            runs.append(run)
            taken.update({*run.files, *run.can})
        else:
            files.append(path)
    loose = []
    for path in files:
        reader = reader_of(path)
        if path in taken and not path.is_dir():
            continue
        if reader is None or reader.needs_can or reader.has_drive(path) or reader.is_ins_only(path) or (
                reader.is_incomplete(path)) or (reader.kind == "csv" and any(map(is_can_log, _logs_of(path, files)))):
            loose.append(path)
    return runs + _from_files(loose, given=False)


def _from_files(files: Sequence[Path], given: bool) -> list[RunSource]:
    """Runs out of loose files. given: the user named each of them, so any other file is a problem."""
    runs: list[RunSource] = []
    readers = {f: reader for f in files if (reader := reader_of(f)) is not None}
    logs = [f for f in files if f not in readers and f.suffix.lower() in CAN_EXTENSIONS and (given or is_can_log(f))]
    for file in files:
        if given and file not in readers and file not in logs:
            known = ", ".join(sorted({*CAN_EXTENSIONS, *(e for one in READERS.values() for e in one.extensions)}))
            what = f"the extension {file.suffix or '(none)'} is not one of a recording"
            advice = ("convert the ROS 1 bag with rosbags-convert" if file.suffix.lower() == ".bag" else
                      "a DBC belongs to --dbc or into the folder of --car" if file.suffix.lower() == ".dbc" else
                      "unpack it first" if file.suffix.lower() in (".gz", ".zip", ".7z", ".bz2", ".xz", ".zst") else
                      f"known are {known}, folders of bags, and run.yaml")
            runs.append(_failed(file, RunError(file, what, advice)))
    for group in _splits([f for f in readers if f.suffix.lower() in BAG_EXTENSIONS and f.is_file()]):
        runs.append(RunSource(group[0].stem.rpartition("_")[0] or group[0].stem, readers[group[0]].kind, tuple(group)))
        readers = {f: reader for f, reader in readers.items() if f not in group}
    rest = []
    for file, reader in readers.items():
        same = _logs_of(file, logs)
        # A table with a CAN log of the same name and columns that are not recognised is an INS recording as well.
        if not reader.needs_can and not (logs and reader.is_ins_only(file)) and (
                reader.kind != "csv" or not same or reader.has_drive(file)):
            runs.append(_alone(file, reader))
            continue
        if given and not same and not logs and reader.needs_can:
            same = [f for f in sorted(file.parent.iterdir())
                    if f.stem == file.stem and f.suffix.lower() in CAN_EXTENSIONS]
        if same:
            runs.append(RunSource(file.stem, reader.kind, (file,), tuple(same)))
            logs = [f for f in logs if f not in same]
        else:
            rest.append(file)
    if len(rest) == 1 and logs:
        return [*runs, RunSource(rest[0].stem, readers[rest[0]].kind, (rest[0],), tuple(logs))]
    return [*runs, *_unmatched(rest, readers, logs)]


def _unmatched(rest: Sequence[Path], readers: dict[Path, Reader], logs: Sequence[Path]) -> Iterator[RunSource]:
    """INS recordings without CAN logs, and CAN logs without an INS recording."""
    for file in rest:
        if not readers[file].needs_can:
            yield _alone(file, readers[file])  # the error of its reader names what is missing in it
            continue
        several = "several INS recordings and CAN logs are here" if logs else "no CAN log has the same stem"
        yield _failed(file, RunError(file, f"no CAN log belongs to it: {several}",
                                     "give them the same name, or list the files of each run in a run.yaml"))
    for session in dict.fromkeys(session_of(f)[0] for f in logs) if not rest else ():
        file = next(f for f in logs if session_of(f)[0] == session)
        csv = READERS["csv"]
        tables = [f.name for f in sorted(file.parent.iterdir())
                  if csv.takes(f) and not (csv.has_drive(f) or csv.is_ins_only(f))]
        advice = "give both, or list the files of the run in a run.yaml"
        if tables:
            advice += f"; it can name columns that are not recognised in {tables[0]}, as columns: {{x: NAME, ...}}"
        yield _failed(file, RunError(file, "no INS recording (.ncom, CSV, bag) belongs to this CAN log", advice))


def _logs_of(file: Path, files: Sequence[Path]) -> list[Path]:
    """CAN logs with the stem of a recording in its folder."""
    return [f for f in files if f.stem == file.stem and f.parent == file.parent and f.suffix.lower() in CAN_EXTENSIONS]


def _splits(files: Sequence[Path]) -> list[list[Path]]:
    """Bag files that follow each other, drive_0, drive_1, ...: each begins where the one before ended."""
    groups: list[list[Path]] = []
    for file in sorted(files, key=lambda f: (f.parent, natural_order(f))):
        if groups and _follows(groups[-1][-1], file):
            groups[-1].append(file)
        else:
            groups.append([file])
    return [group for group in groups if len(group) > 1]


def _follows(before: Path, file: Path) -> bool:
    (a, _, first), (b, _, second) = before.stem.rpartition("_"), file.stem.rpartition("_")
    if (before.parent, a, before.suffix) != (file.parent, b, file.suffix) or not (first.isdigit() and second.isdigit()):
        return False
    spans = time_span(before), time_span(file)
    return int(second) == int(first) + 1 and None not in spans and (
        -SPLIT_GAP < (spans[1][0] - spans[0][1]) * 1e-9 < SPLIT_GAP)  # type: ignore[index]


def _alone(path: Path, reader: Reader) -> RunSource:
    return RunSource(path.name if path.is_dir() else path.stem, reader.kind, (path,))


def _from_run_file(path: Path) -> RunSource:
    try:
        return read_run_file(path)
    except RunError as error:
        return _failed(path, error)


def _failed(path: Path, problem: RunError) -> RunSource:
    return RunSource(path.name, "", (path,), problem=problem)


def _with_own_names(runs: Sequence[RunSource]) -> list[RunSource]:
    """The runs with distinct names, their folder in front where two are the same: results are stored under them."""
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
        named.append(replace(run, name=name))
    return named
