"""Drives as CSV: the columns of the Genesis recordings, or an INS log with speed and yaw only (for clock alignment)."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from st_core.errors import StCoreError
from st_core.log import DriveLog

from .errors import RunError, check_readable
from .ncom import Motion

# Our name, and the names a column may have with the factor to SI.
COLUMNS: Mapping[str, Mapping[str, float]] = {
    "t": {"t": 1.0, "t_s": 1.0, "t_rt_s": 1.0, "time": 1.0},
    "x": {"x": 1.0}, "y": {"y": 1.0},
    "yaw": {"yaw": 1.0, "yaw_iso_deg": np.pi / 180, "yaw_deg": np.pi / 180},
    "velocity_x": {"vx": 1.0, "velocity_x": 1.0, "vel_forward_mps": 1.0},
    "velocity_y": {"vy": 1.0, "velocity_y": 1.0},
    "yaw_rate": {"yaw_rate": 1.0, "yaw_rate_iso_dps": np.pi / 180},
    "acceleration_x": {"ax": 1.0, "acceleration_x": 1.0},
    "acceleration_y": {"ay": 1.0, "acceleration_y": 1.0},
    "road_wheel_angle": {"delta": 1.0, "road_wheel_angle": 1.0},
    "steering_wheel_angle": {"steering_wheel_angle": 1.0, "steering_wheel_angle_deg": np.pi / 180},
}
DRIVE = ("t", "x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "road_wheel_angle")
MOTION = ("t", "velocity_x", "yaw_rate")
OPTIONAL = ("acceleration_x", "acceleration_y", "steering_wheel_angle")


@dataclass(frozen=True)
class Table:
    """Columns under our names, SI, rows with rising time only; absolute: t is UTC seconds. warnings name the file."""

    columns: Mapping[str, np.ndarray]
    time_ns: np.ndarray
    absolute: bool
    warnings: tuple[str, ...]


def read_drive(file: Path) -> tuple[DriveLog, tuple[str, ...]]:
    """A drive with all columns of DRIVE, and warnings. Raises RunError."""
    table = read_table(file, DRIVE)
    values = {name: table.columns[name] for name in (*DRIVE[1:], *OPTIONAL) if name in table.columns}
    values["yaw"] = np.unwrap(values["yaw"])
    try:
        log = DriveLog(file.stem, ins_time_ns=table.time_ns, steering_time_ns=table.time_ns, **values)
    except StCoreError as error:
        raise RunError(file, str(error)) from None
    return log, table.warnings


def read_motion(file: Path) -> tuple[Motion, tuple[str, ...]]:
    """An INS log with at least time, forward velocity and yaw rate. Raises RunError."""
    table = read_table(file, MOTION)
    columns = table.columns
    motion = Motion(table.time_ns, columns["velocity_x"], columns["yaw_rate"], columns.get("yaw"), table.absolute)
    return motion, table.warnings


def has_drive_columns(file: Path) -> bool:
    """Whether the header names all columns of a drive (not whether the rows are good)."""
    try:
        with file.open(encoding="utf-8-sig") as stream:
            names = set(_header(stream.readline()))
    except (OSError, UnicodeDecodeError):
        return False
    return all(names & set(COLUMNS[name]) for name in DRIVE)


def read_table(file: Path, needed: tuple[str, ...]) -> Table:
    """Raises RunError naming what is missing, or the row that cannot be read."""
    check_readable(file)
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise RunError(file, "this is not a text file", "give it the extension of what it is") from None
    header, _, body = text.partition("\n")
    names = _header(header)
    places = {our: next(((names.index(n), factor) for n, factor in known.items() if n in names), None)
              for our, known in COLUMNS.items()}
    missing = [our for our in needed if places[our] is None]
    if missing:
        wanted = ", ".join("/".join(COLUMNS[our]) for our in missing)
        raise RunError(file, f"the header has no column {wanted}; it has {', '.join(names)[:120]}",
                       "name the columns as in docs/recordings.md")
    warnings: list[str] = []
    rows = _rows(file, body, ";" if ";" in header else ",", len(names), warnings)
    columns = {our: rows[:, place[0]] * place[1] for our, place in places.items() if place is not None}
    columns = {our: c for our, c in columns.items() if our in needed or np.isfinite(c).all()}
    good = np.isfinite(np.stack(list(columns.values()))).all(axis=0)
    if not good.all():
        warnings.append(f"{file}: {int((~good).sum())} rows hold no number somewhere; they were left out")
        columns = {our: c[good] for our, c in columns.items()}
    # Microseconds: what decimal seconds since 1970 still carry as a float.
    time_ns = np.round(columns["t"] * 1e6).astype(np.int64) * 1000
    rising = np.diff(np.maximum.accumulate(time_ns), prepend=time_ns[:1] - 1) > 0
    if not rising.all():
        warnings.append(f"{file}: time does not rise in {int((~rising).sum())} rows; they were left out")
    if rising.sum() < 2:
        raise RunError(file, "fewer than two usable rows are in it", "take it off the list")
    columns = {our: c[rising] for our, c in columns.items()}
    return Table(columns, time_ns[rising], bool(time_ns[0] > 10**18), tuple(warnings))


def _header(line: str) -> list[str]:
    return [name.strip() for name in line.strip().replace(";", ",").split(",")]


def _rows(file: Path, body: str, delimiter: str, width: int, warnings: list[str]) -> np.ndarray:
    try:
        return _parsed(body, delimiter, width)
    except ValueError as first:
        error = first
    whole, _, rest = body.rpartition("\n")
    if rest:
        try:
            rows = _parsed(whole, delimiter, width)
            warnings.append(f"{file}: the last row is cut; it was left out")
            return rows
        except ValueError as second:
            error = second
    raise RunError(file, f"a row cannot be read ({' '.join(str(error).split())[:120]})",
                   "mend or remove that row (rows count from 0 behind the header)") from None


def _parsed(body: str, delimiter: str, width: int) -> np.ndarray:
    if not body.strip():
        return np.zeros((0, width))
    rows = np.loadtxt(io.StringIO(body), delimiter=delimiter, ndmin=2, converters=_number)
    if rows.shape[1] != width:
        raise ValueError(f"{rows.shape[1]} columns instead of {width}")
    return rows


def _number(text: str) -> float:
    return float(text) if text.strip() else float("nan")
