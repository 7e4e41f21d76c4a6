"""Drives as CSV: the columns of columns.py, or an INS log with speed and yaw rate only (for clock alignment)."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from st_core.checks import Extras
from st_core.errors import StCoreError
from st_core.log import INS_SIGNALS, OPTIONAL_INS_SIGNALS, DriveLog
from st_core.vehicle import VehicleParameters

from .columns import Layout, doubtful_steering, find_columns
from .csv_table import Table, header_of, read_table
from .errors import RunError
from .extras import SPEEDS, car_speed, mostly_known
from .ins_log import Motion

MOTION = ("velocity_x", "yaw_rate")
ROAD, WHEEL, COMPASS = "road_wheel_angle", "steering_wheel_angle", "compass_heading"
ADVICE = "name the columns as in docs/manual/recordings.md, or say in a run.yaml which they are, as columns: {%s: NAME}"


@dataclass(frozen=True)
class CsvDrive:
    """columns: channel -> column and unit, as they were taken."""

    log: DriveLog
    columns: Mapping[str, str]
    extras: Extras
    warnings: tuple[str, ...]


def read_drive(file: Path) -> tuple[DriveLog, tuple[str, ...]]:
    """A drive that says all by itself, and warnings; see `read_csv`."""
    drive = read_csv(file)
    return drive.log, drive.warnings


def read_csv(file: Path, vehicle: VehicleParameters | None = None, layout: Layout | None = None,
             yaw_scale: float = 1.0) -> CsvDrive:
    """A drive with INS and steering columns.

    A row in which a channel holds no number is no sample of the INS, or of the steering, and still one of the other;
    an acceleration is NaN there. vehicle: for a file with the hand wheel alone. yaw_scale: on the yaw as recorded; it
    comes before unwrapping, which takes jumps of 2 pi for turns and must see radians. Raises RunError.
    """
    table = read_table(file, layout or Layout())
    _check_columns(table, (*INS_SIGNALS, ROAD))
    notes = list(table.warnings)
    columns = dict(table.columns)
    if "yaw" not in columns:
        columns["yaw"] = np.pi / 2 - columns[COMPASS]
    steering = _steering(table, columns, vehicle, notes)
    missing = _missing(table, columns, steering, notes)
    ins = table.rising & _known(columns, INS_SIGNALS)
    steered = table.rising & _known(columns, steering)
    if min(ins.sum(), steered.sum()) < 2:
        raise RunError(file, f"fewer than two usable rows are in it{_blame(missing, table)}", "take it off the list")
    if not table.rising.all():
        notes.append(f"{file}: time does not rise in {int((~table.rising).sum())} rows; they were left out")
    values = {name: columns[name][ins] for name in INS_SIGNALS}
    values["yaw"] = np.unwrap(yaw_scale * values["yaw"])
    values |= {name: columns[name][ins] for name in OPTIONAL_INS_SIGNALS if mostly_known(columns.get(name))}
    values |= {name: columns[name][steered] for name in {ROAD, *steering}}
    try:
        log = DriveLog(file.stem, ins_time_ns=table.time_ns[ins], steering_time_ns=table.time_ns[steered], **values)
    except StCoreError as error:
        raise RunError(file, str(error)) from None
    speeds = {name: (table.time_ns[table.rising], columns[name][table.rising]) for name in SPEEDS if name in columns}
    extras = Extras({"INS": table.time_ns}, missing, car_speed(speeds))
    taken = {channel: f"{place.name} [{place.unit}{'' if place.said else ', assumed'}]"
             for channel, place in table.places.items()}
    return CsvDrive(log, taken, extras, tuple(notes))


def read_motion(file: Path) -> tuple[Motion, tuple[str, ...]]:
    """An INS log with at least time, forward velocity and yaw rate. Raises RunError."""
    table = read_table(file, Layout())
    _check_columns(table, MOTION)
    notes = list(table.warnings)
    columns = dict(table.columns)
    if "yaw" not in columns and COMPASS in columns:
        columns["yaw"] = np.pi / 2 - columns[COMPASS]
    used = tuple(name for name in (*MOTION, "yaw") if name in MOTION or _any_known(columns, name))
    rows = table.rising & _known(columns, used)
    if rows.sum() < 2:
        raise RunError(file, "fewer than two usable rows are in it", "take it off the list")
    if not rows.all():
        notes.append(f"{file}: {int((~rows).sum())} rows hold no number somewhere, or are out of order; "
                     "they were left out")
    values = {name: columns[name][rows] for name in used}
    return Motion(table.time_ns[rows], values["velocity_x"], values["yaw_rate"], values.get("yaw"),
                  table.absolute), tuple(notes)


def has_drive_columns(file: Path) -> bool:
    """Whether the header names all columns of a drive (not whether the rows are good)."""
    names = header_of(file)
    return not _lacking(find_columns(file, names, Layout()), names, ("t", *INS_SIGNALS, ROAD))


def _lacking(places: Iterable[str], names: Iterable[str], needed: Iterable[str]) -> list[str]:
    there = {*places, *({"yaw"} if COMPASS in places else ()), *({ROAD} if WHEEL in places else ())}
    if doubtful_steering(list(names)):
        there.add(ROAD)
    return [name for name in needed if name not in there]


def _check_columns(table: Table, needed: tuple[str, ...]) -> None:
    missing = _lacking(table.places, table.names, ("t", *needed))
    if missing:
        raise RunError(table.file, f"the header has no column for {', '.join(missing)}; it has "
                       f"{', '.join(table.names)[:200]}", ADVICE % missing[0])
    doubtful = doubtful_steering(table.names)
    if ROAD in needed and ROAD not in table.places and WHEEL not in table.places:
        raise RunError(table.file, f"column {doubtful} may be of the steering wheel or of the road wheels",
                       f"say which in a run.yaml, as columns: {{{WHEEL}: {doubtful}}} or {{{ROAD}: {doubtful}}}")


def _steering(table: Table, columns: dict[str, np.ndarray], vehicle: VehicleParameters | None,
              notes: list[str]) -> tuple[str, ...]:
    """The steering channels that are used; the road wheel angle is added where only the hand wheel is there."""
    if ROAD not in columns:
        if vehicle is None:
            raise RunError(table.file, f"it has the steering wheel angle only (column {table.places[WHEEL].name}): the "
                           "road wheel angle needs ratio and offset of the car", "give its vehicle file")
        columns[ROAD] = vehicle.road_wheel_angle(columns[WHEEL])
        return (WHEEL,)
    if WHEEL in columns and np.isnan(columns[WHEEL]).mean() > 0.5:
        notes.append(f"{table.file}: {WHEEL} (column {table.places[WHEEL].name}) holds no number in more than half of "
                     "the rows; it is not used, the road wheel angle is")
        return (ROAD,)
    return (ROAD, WHEEL) if WHEEL in columns else (ROAD,)


def _missing(table: Table, columns: Mapping[str, np.ndarray], steering: tuple[str, ...],
             notes: list[str]) -> dict[str, int]:
    """Channel -> rows without a usable number, each said."""
    lost = {"time": table.timeless, **{
        name: int(np.isnan(columns[name]).sum()) for name in (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS, *steering)
        if name in columns}}
    lost = {name: count for name, count in lost.items() if count}
    total = len(table.time_ns) + table.timeless
    for name, count in lost.items():
        place = table.places.get({"time": "t"}.get(name, name)) or table.places[COMPASS]
        half = count > total / 2
        follows = ("these rows were left out" if name == "time" else
                   ("it is not used" if half else "it is not known there") if name in OPTIONAL_INS_SIGNALS else
                   f"these samples of the {'steering' if name in steering else 'INS'} were left out")
        notes.append(f"{table.file}: {name} (column {place.name}): {count} of {total} rows hold no number"
                     f"{', more than half' if half else ''}; {follows}")
    return lost if ROAD in steering else {ROAD if name == WHEEL else name: count for name, count in lost.items()}


def _blame(missing: Mapping[str, int], table: Table) -> str:
    if not missing:
        return ""
    worst = max(missing, key=lambda name: missing[name])
    return f": {worst} holds no number in {missing[worst]} of {len(table.time_ns) + table.timeless}"


def _known(columns: Mapping[str, np.ndarray], names: Iterable[str]) -> np.ndarray:
    return np.isfinite(np.stack([columns[name] for name in names])).all(axis=0)


def _any_known(columns: Mapping[str, np.ndarray], name: str) -> bool:
    return name in columns and bool(np.isfinite(columns[name]).any())
