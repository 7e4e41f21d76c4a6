"""An INS recording and a CAN log, read as far as clock alignment needs them: what `st align` looks at."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from st_core.clock_types import Alignment, SharedSignal

from . import csv
from .can_formats import EXTENSIONS
from .can_logs import CanLog, read_can_logs
from .can_signals import CanSignals, decode_signals, load_signal_table
from .clocks import align_clocks
from .errors import RunError
from .ins_log import Motion
from .raw import clock_settings, latency_in_words
from .readers import READERS
from .run_types import ReadSettings, RunSource, signal_files
from .sources import find_runs


@dataclass(frozen=True)
class Pair:
    """dbc: by which the CAN frames were decoded. shared: the signals the alignment rests on, or by which it can be
    looked at. latency: of INS frames, in words."""

    name: str
    dbc: Path
    motion: Motion
    can: CanLog
    signals: CanSignals
    alignment: Alignment
    shared: list[SharedSignal]
    latency: str
    warnings: tuple[str, ...]


def read_pair(files: Sequence[Path], settings: ReadSettings) -> Pair:
    """files: one INS recording (NCOM, or CSV with speed and yaw) and CAN logs, or a folder or run.yaml that names them.

    No steering is needed. Raises RunError.
    """
    source = _source(files)
    if source.kind == "csv":
        motion, warnings = csv.read_motion(source.where, source.settings.get("layout"))
    else:
        read_ins = READERS[source.kind].read_ins
        assert read_ins is not None  # only such kinds have CAN logs beside them
        ins = read_ins(source, settings)
        motion, warnings = ins.motion, ins.warnings
    can = read_can_logs(source.can)
    dbc, table = signal_files(source, settings)
    signals = decode_signals(can.frames, load_signal_table(dbc, table))
    alignment, shared = align_clocks(motion, signals, **clock_settings(source, settings))
    return Pair(source.name, dbc, motion, can, signals, alignment, shared, latency_in_words(source, settings),
                (*warnings, *can.warnings))


def _source(files: Sequence[Path]) -> RunSource:
    """CSV and CAN logs are a pair here only: elsewhere a CSV is a whole drive."""
    tables = [f for f in files if f.suffix.lower() == ".csv"]
    logs = [f for f in files if f.suffix.lower() in EXTENSIONS]
    if len(tables) == 1 and len(logs) == len(files) - 1 and logs:
        return RunSource(tables[0].stem, "csv", (tables[0],), tuple(logs))
    runs = find_runs(files)
    for run in runs:
        if run.problem is not None:
            raise run.problem
    raw = [run for run in runs if run.can]
    if len(raw) != 1:
        what = "no pair" if not raw else f"more than one pair ({', '.join(run.name for run in raw)})"
        raise RunError(", ".join(map(str, files)), f"{what} of an INS recording and CAN logs is in there",
                       "give one .ncom (or CSV) and its CAN logs")
    return raw[0]
