"""Groups files into runs: by their names, by their folders, by the time of split bags, or by a run.yaml."""

import glob
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, count, pairwise
from pathlib import Path

from st_core import yaml_text

from .bag_storage import EXTENSIONS as BAG_EXTENSIONS
from .bag_storage import read_time_span
from .binary_table import BINARY_EXTENSIONS
from .can_formats import EXTENSIONS as CAN_EXTENSIONS
from .can_formats import is_can_log, read_head
from .errors import RunError
from .mdf_blocks import describe_truncation
from .mf4 import MF4_EXTENSIONS, parse_session
from .readers import READERS, Reader, find_reader
from .run_file import find_described_files, find_described_run, find_logs, is_run_file, read_run_file
from .run_types import RunSource

DOCUMENT_EXTENSIONS = (".md", ".txt", ".rst", ".pdf", ".html", ".png", ".jpg", ".json", ".yaml", ".yml", "")
"""Extensions of documents such as README and LICENSE, which are ignored among recordings."""
MAX_SPLIT_GAP = 5.0  # longest gap or overlap [s] between the end of one file of a split bag and the start of the next
TEXT_EXPORTS = (".txt", ".tsv", ".dat", ".lvm")  # extensions of tables often exported alongside other files
UNKNOWN_ADVICE = {
    **dict.fromkeys((".dbc", ".kcd", ".sym", ".arxml"), "give this description of CAN messages with --dbc"),
    ".rd": "this is raw data of an OxTS unit: convert it to NCOM with the software of the unit",
    **{f".{kind}": f"convert it with `gpsbabel -t -i {kind} -f IN -o unicsv -F OUT.csv`" for kind in ("gpx", "nmea")},
    **dict.fromkeys((".ulg", ".npy", ".pkl"), "write a .csv with columns as in docs/csv_columns.md"),
    ".active": "the recording was not closed: repair it with `st recover` (.mcap) or `rosbag reindex` (.bag), then "
               "remove .active from its name",
    ".vbb": "export it as .vbo with the software of the logger",
    ".bin": "rename it to .ncom if it contains NCOM packets; else export a .csv",
    **dict.fromkeys((".gz", ".zip", ".7z", ".xz", ".zstd"), "unpack it first"),
    **dict.fromkeys((".bz2", ".zst"), "unpack it first; export an rlog of openpilot as .csv with PlotJuggler"),
    ".tdms": "export it as .csv, in Python with npTDMS: TdmsFile.read(IN).as_dataframe().to_csv(OUT)",
    **dict.fromkeys((".xls", ".xlsx", ".ods", ".erg", ".ld", ".pos", ".xrk", ".xrz"),  # some of these files are text
                    "rename it to .csv if it is a text table; else export a .csv in the program that wrote it"),
}
"""Extension -> advice, for files that no reader supports."""


def find_runs(paths: Path | str | Sequence[Path | str]) -> list[RunSource]:
    """Finds the runs in one or more files and folders, in order of name. A source that cannot be a run has a `problem`.

    Individual files that belong together (one INS recording and CAN logs, or the parts of a split bag) form one run.
    Folders are searched recursively; tables and bags without a drive, and other files, are ignored there.
    """
    runs: list[RunSource] = []
    single_files: list[Path] = []
    for path in map(Path, [paths] if isinstance(paths, Path | str) else paths):
        if not path.exists():
            folder = path.absolute().parent
            names = [other.name for other in folder.iterdir()] if folder.is_dir() else []
            advice = f"looked for in {folder}{yaml_text.suggest_key(path.name, names)}"
            runs.append(_report_problem(path, "the file or folder does not exist", advice))
        elif path.is_dir() and find_reader(path) is None:
            runs += _search_folder(path) or _report_folder_without_runs(path)
        elif is_run_file(path):
            runs += _read_run_file_or_problem(path)
        else:
            single_files.append(path)
    if len(single_files) > 1 or runs:
        single_files = [f for f in single_files if not _is_document(f)] or single_files
    described_runs = [run for path in filter(find_reader, single_files) if (run := find_described_run(path))]
    other_files = [f for f in single_files if not any(f in (*run.files, *run.can) for run in described_runs)]
    if any(f.suffix.lower() in CAN_EXTENSIONS for f in other_files):  # CAN logs that no run.yaml describes
        described_runs = [run for run in described_runs if not run.can]
        other_files = [f for f in single_files if not any(f in run.files for run in described_runs)]
    described_runs = [run for run in described_runs if run not in runs]  # its run.yaml is also given
    return _assign_distinct_names([*runs, *described_runs, *_group_files(other_files, named_by_user=True)])


def _report_folder_without_runs(folder: Path) -> list[RunSource]:
    """Sources that report why the files in a folder are not runs; without such files, one that reports the folder."""
    bag = READERS["bag"]
    files = sorted(folder.rglob("*"))
    if any(f.name == "timestamps.txt" and f.absolute().parent.name == "oxts" for f in files):
        return [_report_problem(folder, "KITTI recordings contain no steering angle", "write a .csv of the files in "
                                "oxts/data with a column for it and names as in docs/csv_columns.md")]
    bags = [f for f in files if bag.accepts(f) and not any(bag.accepts(parent) for parent in f.parents)]
    unknown_files = [f for f in files if f.suffix.lower() in UNKNOWN_ADVICE.keys() - {*DOCUMENT_EXTENSIONS}]
    tables = [f for f in files if READERS["csv"].accepts(f) and f.suffix.lower() not in (".dat", *DOCUMENT_EXTENSIONS)]
    # The problems of bags and tables are reported when they are read.
    return [*(_make_single_run(f, bag) for f in bags), *(_make_single_run(f, READERS["csv"]) for f in tables),
            *map(_report_unknown_file, unknown_files)] or [_report_problem(
        folder, "this folder contains no recording", "give a folder with .ncom and CAN logs, bags, CSV or VBO files")]


def _search_folder(folder: Path) -> list[RunSource]:
    runs, files = list[RunSource](), list[Path]()
    used_files, bag_folders = set[Path](), set[Path]()
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        is_hidden = any(part.startswith(".") for part in relative.parts)
        is_node_log = path.is_file() and not path.stat().st_size and any(
            f.name == "logs" and (folder / f).with_name("parameters.yaml").is_file() for f in relative.parents)
        if is_hidden or is_node_log or not bag_folders.isdisjoint(path.parents):
            continue
        if path.is_dir():
            if find_reader(path) is not None:
                bag_folders.add(path)
                files.append(path)
        elif is_run_file(path):
            known_run_files = [run.run_file for run in runs]  # including runs of a run.yaml with `each`
            described_runs = _read_run_file_or_problem(path)
            runs += [run for run in described_runs if run.run_file not in known_run_files]
            used_files.update(file.resolve() for run in described_runs for file in (*run.files, *run.can))
            # The files of an invalid run.yaml are not separate runs, so that one mistake is reported once.
            if any(run.problem and run.run_file == path for run in described_runs):
                used_files.update(file.resolve() for file in find_described_files(path))
        else:
            files.append(path)
    # A run of `each` may be a part of a recording that another run.yaml describes.
    runs = [run for run in runs if not any({*run.files} < {*other.files} for other in runs)]
    single_files = [path for path in files if path.resolve() not in used_files]
    usable_files = {path for path in single_files if _may_belong_to_run(path, files)}
    # A file of a split bag may lack odometry, for example if the INS was switched on later.
    bags = [path for path in single_files if path.suffix.lower() in BAG_EXTENSIONS and path.is_file()]
    for group in _group_split_bags(bags):
        usable_files.update(group if usable_files.intersection(group) else ())
    return runs + _group_files([path for path in single_files if path in usable_files], named_by_user=False)


def _may_belong_to_run(path: Path, files: Sequence[Path]) -> bool:
    """Whether a file may belong to a run; False for duplicates, and for tables and bags without INS data or CAN log."""
    reader = find_reader(path)
    if reader is None or reader.needs_can or is_can_log(path):
        return True
    same_stem = [(other, other_reader) for other in files if other.stem == path.stem and other != path
                 and (other_reader := find_reader(other)) and other.suffix.lower() not in BINARY_EXTENSIONS]
    is_text = path.suffix.lower() in TEXT_EXPORTS
    if (is_text or path.suffix.lower() in BINARY_EXTENSIONS) and any(
            other.has_drive(file) and not (is_text and other.needs_can)
            for file, other in same_stem if file.suffix.lower() not in TEXT_EXPORTS):
        return False  # probably the same drive
    if reader.is_table and any(is_text or other.needs_can for _, other in same_stem) and not reader.has_drive(path):
        return False  # probably an export of a recording with the same stem
    return reader.may_contain_drive(path) or (
        path.suffix.lower() == ".csv" and any(map(is_can_log, find_logs(path, files))))


def _is_document(file: Path) -> bool:
    """Whether a file has the extension of a document and is neither a CAN log nor a table with a drive."""
    reader = find_reader(file)
    return file.suffix.lower() in DOCUMENT_EXTENSIONS and not is_can_log(file) and not (
        reader and reader.may_contain_drive(file))


def _group_files(files: Sequence[Path], named_by_user: bool) -> list[RunSource]:
    """Groups single files into runs. If the user named them, a file of unknown type is a problem."""
    readers = {f: reader for f in files if (reader := find_reader(f)) is not None and not is_can_log(f)}
    logs = [f for f in files if f not in readers
            and (is_can_log(f) or (named_by_user and f.suffix.lower() in CAN_EXTENSIONS))]
    runs = [_report_unknown_file(f) for f in files if named_by_user and f not in readers and f not in logs]
    for group in _group_split_bags([f for f in readers if f.suffix.lower() in BAG_EXTENSIONS and f.is_file()]):
        runs.append(RunSource(group[0].stem.rpartition("_")[0] or group[0].stem, readers[group[0]].kind, tuple(group)))
        readers = {f: reader for f, reader in readers.items() if f not in group}
    complete_drives, recordings_without_logs = list[Path](), list[Path]()
    for file, reader in readers.items():
        own_logs = find_logs(file, logs)
        # A table that has a CAN log of the same stem is an INS recording, even if its columns are unknown.
        if not reader.needs_can and not (logs and reader.is_ins_only(file)) and (
                reader.kind != "csv" or not own_logs or reader.has_drive(file)):
            complete_drives.append(file)
            continue
        notes: tuple[str, ...] = ()
        if named_by_user and not own_logs and not logs and reader.needs_can:
            own_logs = find_logs(file, sorted(file.parent.iterdir()))
            notes = (f"{file}: its CAN log in the same folder is used: {', '.join(log.name for log in own_logs)}",)
        if own_logs:
            runs.append(RunSource(file.stem, reader.kind, (file,), tuple(own_logs), notes=notes))
            logs = [f for f in logs if f not in own_logs]
        else:
            recordings_without_logs.append(file)
    paired = {folder for run in runs if run.can for folder in run.files[0].absolute().parents}
    partners = _find_partners(recordings_without_logs, logs, paired)
    runs += [RunSource(f.stem, readers[f].kind, (f,), own_logs) for f, own_logs in partners.items() if own_logs]
    logs = [log for log in logs if not any(log in own_logs for own_logs in partners.values())]
    for file in complete_drives:
        notes = tuple(f"{log}: not used, because {file.name} is a complete drive" for log in find_logs(file, logs))
        runs.append(replace(_make_single_run(file, readers[file]), notes=notes))
    logs = [log for log in logs if not any(find_logs(file, [log]) for file in complete_drives)]
    return [*runs, *_report_unmatched([f for f, own_logs in partners.items() if not own_logs], readers, logs)]


def _find_partners(recordings: Sequence[Path], logs: Sequence[Path], paired: set[Path]) -> dict[Path, tuple[Path, ...]]:
    """CAN logs of each INS recording; empty if they are uncertain.

    The logs of a recording are in the outermost folder around it that contains no other INS recording; if some of these
    have its stem (or STEM_1, STEM_2, ...), only they are used. If the folder has no logs, those with its stem in other
    folders are used. A stem counts only if no other recording has it. The logs are uncertain if stems and folders
    disagree, if two recordings would share a log, or if the logs are of several sessions and not all have its stem,
    while its folder contains pairs with equal stems. paired: folders with such pairs.
    """
    candidates: dict[Path, tuple[Path, ...]] = {}
    contradictory = set[Path]()
    for file in recordings:
        other_folders = {folder for other in recordings if other != file for folder in other.absolute().parents}
        folders = [folder for folder in file.absolute().parents if folder not in other_folders]
        nearby = tuple(log for log in logs if folders and folders[-1] in log.absolute().parents)
        other_stems = {other.stem for other in recordings if other != file}
        same_stem = tuple(log for log in logs if log.stem not in other_stems
                          and re.fullmatch(rf"{re.escape(file.stem)}(_\d+)?", log.stem))
        candidates[file] = tuple(log for log in same_stem if log in nearby) or (*nearby, *same_stem)
        is_mixed = file.absolute().parent in paired and not {*candidates[file]} <= {*same_stem} and (
            len({parse_session(log)[0] for log in candidates[file]}) > 1)
        if is_mixed or (nearby and {*candidates[file]} - {*nearby}):
            contradictory.add(file)
    counts = Counter(log for own_logs in candidates.values() for log in own_logs)
    return {file: () if file in contradictory or any(counts[log] > 1 for log in own_logs) else own_logs
            for file, own_logs in candidates.items()}


def _report_unknown_file(file: Path) -> RunSource:
    extensions = sorted({*CAN_EXTENSIONS, *(e for reader in READERS.values() for e in reader.extensions)})
    advice = f"give files with {', '.join(extensions)}, bag folders, or run.yaml, and export others as .csv"
    return _report_problem(file, f"recordings with the extension {file.suffix or '(none)'} are not supported",
                           UNKNOWN_ADVICE.get(file.suffix.lower(), advice))


def _report_unmatched(recordings: Sequence[Path], readers: dict[Path, Reader],
                      logs: Sequence[Path]) -> Iterator[RunSource]:
    """Yields a source for each INS recording without CAN logs; without such recordings, for each session of logs."""
    for file in recordings:
        if not readers[file].needs_can:
            yield _make_single_run(file, readers[file])  # its reader reports the missing data
            continue
        reason = "names and folders do not show which one belongs to it" if logs else "no CAN log has the same name"
        advice = "give them the same name, or list the files of each run in a run.yaml"
        others = [f.name for f in sorted(file.parent.glob(f"{glob.escape(file.stem)}.*")) if f not in recordings]
        signals = [name for name in others if Path(name).suffix.lower() in MF4_EXTENSIONS]
        if signals and not logs:
            advice = f"{signals[0]} contains signals but no CAN frames: give the log with the frames"
        elif others and not logs:
            known_advice = UNKNOWN_ADVICE.get(Path(others[0]).suffix.lower())
            advice += f"; {others[0]}: {known_advice}" if known_advice else (
                f"; if {others[0]} is a CAN log, convert it to .asc, .blf, .log (candump), .trc or .mf4")
        yield _report_problem(file, f"no matching CAN log: {reason}", advice)
    for session in dict.fromkeys(parse_session(f)[0] for f in logs) if not recordings else ():
        file = next(f for f in logs if parse_session(f)[0] == session)
        try:
            truncation = describe_truncation(read_head(file), file.stat().st_size)
        except OSError as error:
            yield _report_problem(file, f"cannot be read: {error.strerror}", "check its permissions, or copy it again")
            continue
        if truncation:
            yield _report_problem(file, f"the file is truncated: {truncation}", "copy it again")
            continue
        csv = READERS["csv"]
        tables = [f.name for f in sorted(file.parent.iterdir())
                  if csv.accepts(f) and not is_can_log(f) and not _is_document(f)
                  and not (csv.has_drive(f) or csv.is_ins_only(f))]
        advice = "give both, or list the files of the run in a run.yaml"
        if tables:
            advice += f"; the run.yaml can also name unknown columns of {tables[0]}, as columns: {{x: NAME, ...}}"
        advice += "".join(f"; {f.name}: {UNKNOWN_ADVICE[f.suffix.lower()]}" for f in sorted(file.parent.iterdir())
                          if f.name.split(".")[0] == file.stem and f.suffix.lower() in UNKNOWN_ADVICE)
        problem = "no INS recording (.ncom, .csv, .vbo, bag) matches this CAN log"
        if not is_can_log(file):
            problem, advice = "this is not a CAN log of a known format", (
                "convert a CAN log to .asc, .blf, .trc or .mf4, and export other recordings as .csv")
        yield _report_problem(file, problem, advice)


def _group_split_bags(files: Sequence[Path]) -> list[list[Path]]:
    """Groups of two or more bag files drive_0, drive_1, ..., in order of time, each of which begins when the
    previous one ends. No number between those of two consecutive files is missing."""
    series: dict[tuple[Path, str, str], dict[int, Path]] = {}
    for file in files:
        stem, _, digits = file.stem.rpartition("_")
        if digits.isdecimal():
            series.setdefault((file.parent, stem, file.suffix), {})[int(digits)] = file
    groups: list[list[Path]] = []
    for parts in series.values():
        spans = {number: span for number, part in parts.items() if len(parts) > 1 and (span := read_time_span(part))}
        numbers = sorted(spans, key=lambda number: spans[number])
        groups += [[parts[number]] for number in numbers[:1]]
        for previous, number in pairwise(numbers):
            part, between = parts[number], range(min(previous, number), max(previous, number))
            gap = abs(spans[number][0] - spans[previous][1]) * 1e-9  # s
            if gap < MAX_SPLIT_GAP and all(k in parts for k in between):  # `all` ends early: numbers may be time stamps
                groups[-1].append(part)
            else:
                groups.append([part])
    return [group for group in groups if len(group) > 1]


def _make_single_run(path: Path, reader: Reader) -> RunSource:
    return RunSource(path.name if path.is_dir() else path.stem, reader.kind, (path,))


def _read_run_file_or_problem(path: Path) -> list[RunSource]:
    try:
        return read_run_file(path)
    except RunError as error:
        return [RunSource(path.name, "", (path,), problem=error, run_file=path)]


def _report_problem(path: Path, problem: str, advice: str) -> RunSource:
    return RunSource(path.name, "", (path,), problem=RunError(path, problem, advice))


def _assign_distinct_names(runs: Sequence[RunSource]) -> list[RunSource]:
    """Gives runs distinct names, because results are stored by name; adds the folder or a number to repeated names."""
    used_names: set[str] = set()
    renamed_runs = []
    for run in sorted(runs, key=lambda r: (r.name, str(r.path))):
        folder = run.path.absolute().parent.name if run.files else ""
        first = (run.name in ("run", "bag") and folder) or run.name  # generic file names; the folder names the run
        names = chain((first, f"{folder}_{run.name}") if run.files else (first,),
                      (f"{run.name}_{number}" for number in count(2)))
        name = next(name for name in names if name not in used_names)
        used_names.add(name)
        renamed_runs.append(replace(run, name=name))
    return renamed_runs
