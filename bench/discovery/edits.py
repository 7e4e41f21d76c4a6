"""Block F: known changes of the recorded columns, or of the vehicle file, of real drives.

The stated value must differ by the change from that for the drives as recorded: the value of a stated effect, or else
of a candidate. Every case has all nine Genesis drives; each change is one that an effect of the library describes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_recordings.runs.columns import Layout
from st_recordings.runs.csv import build_drive
from st_recordings.runs.csv_table import read_table

from .._cases import Record
from .._drives import SOUND_DRIVES, genesis, move_ins, rotate_ins
from .cases import seed_of
from .effects import null_value

SMALLEST, LARGEST = 0.5, 1.5  # times the typical size

Column = Callable[[DriveLog, float], DriveLog]
Stated = dict[tuple[str, str], tuple[float, float, float]]
"""(effect, parameter) -> value, low, high."""


@dataclass(frozen=True)
class Edit:
    """A change of recordings."""

    effect: str  # effect of the library that describes it
    parameter: str  # parameter of this effect
    size: float  # typical size
    column: Column | None  # changes a recording; None for a change of the mass in the vehicle file
    multiplies: bool = False  # the value is multiplied by 1 + size; otherwise size is added
    inverse: bool = False  # the parameter changes with the opposite sign, or by the inverse factor

    def expected(self, value: float, size: float) -> float:
        """The value of the parameter after the edit, if it was `value` before."""
        if self.multiplies:
            return value / (1.0 + size) if self.inverse else value * (1.0 + size)
        return value - size if self.inverse else value + size


def _replace_steering(log: DriveLog, angle: np.ndarray) -> DriveLog:
    return replace(log, road_wheel_angle=angle, steering_wheel_angle=None)


def _delay(log: DriveLog, time: float) -> DriveLog:
    return replace(log, steering_time_ns=log.steering_time_ns + round(time * 1e9))


def _scale_speed(log: DriveLog, change: float) -> DriveLog:
    return replace(log, velocity_x=log.velocity_x * (1.0 + change), velocity_y=log.velocity_y * (1.0 + change))


EDITS: dict[str, Edit] = {
    "steering scaled": Edit("steering_ratio", "factor", 0.10, lambda log, k: _replace_steering(
        log, log.road_wheel_angle * (1.0 + k)), multiplies=True),
    "heading turned": Edit("heading_misalignment", "angle", 0.01, rotate_ins),
    "steering late": Edit("steering_delay", "time", 0.05, _delay, inverse=True),
    "yaw rate scaled": Edit("yaw_rate_scale", "factor", 0.03, lambda log, k: replace(
        log, yaw_rate=log.yaw_rate * (1.0 + k)), multiplies=True),
    "point moved": Edit("sensor_lever_arm", "x", 1.0, move_ins),
    "mass of the file": Edit("mass", "factor", 0.15, None, multiplies=True, inverse=True),
    "steering offset": Edit("steering_offset", "angle", 0.006, lambda log, a: _replace_steering(
        log, log.road_wheel_angle + a), inverse=True),
    "yaw rate biased": Edit("yaw_rate_bias", "bias", 0.008, lambda log, b: replace(log, yaw_rate=log.yaw_rate + b)),
    "speed scaled": Edit("speed_scale", "factor", 0.02, _scale_speed, multiplies=True),
    "a_y biased": Edit("lateral_acceleration_bias", "bias", 0.3, lambda log, b: replace(
        log, acceleration_y=log.acceleration_y + b)),
}


@dataclass(frozen=True)
class EditCase:
    """A case. name: key of EDITS, or "" for the drives as recorded. size: with sign."""

    set_: str
    index: int
    name: str
    size: float
    block: str = "F"


def cases_of(set_: str, count: int) -> list[EditCase]:
    """The drives as recorded (index -1), then all kinds of edits in turn."""
    cases = [EditCase(set_, -1, "", 0.0)]
    for index in range(count):
        draw = np.random.default_rng(seed_of(set_, "F", index))
        name = list(EDITS)[index % len(EDITS)]
        size = float(draw.choice([-1, 1]) * draw.uniform(SMALLEST, LARGEST) * EDITS[name].size)
        cases.append(EditCase(set_, index, name, size))
    return cases


def drives_of(case: EditCase, folder: Path = SOUND_DRIVES) -> tuple[list[DriveLog], VehicleParameters]:
    """(edited drives, vehicle). Raises FileNotFoundError without the recordings."""
    logs, vehicle = list(recorded_drives(folder)), genesis()
    if not case.name:
        return logs, vehicle
    edit = EDITS[case.name]
    if edit.column is None:
        return logs, replace(vehicle, mass=vehicle.mass * (1.0 + case.size))
    return [edit.column(log, case.size) for log in logs], vehicle


@cache
def recorded_drives(folder: Path) -> tuple[DriveLog, ...]:
    """The drives as recorded."""
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise FileNotFoundError(f"{folder}: the folder of the recorded drives is empty or missing")
    return tuple(build_drive(read_table(file, Layout())).log for file in files)


@dataclass(frozen=True)
class EditComparison:
    """Comparison for one edit."""

    # Whether the interval of the stated value contains the expected one, or the effect is an alternative of another.
    moved: bool
    others: tuple[str, ...]  # other effects of which a value has changed
    expected: float  # value of the edited parameter
    stated: tuple[float, float, float] | None


def compare_edit(plain: Record, r: Record) -> EditComparison:
    edit = EDITS[r["kind"]]
    before, after = stated_values(plain), stated_values(r)
    key = edit.effect, edit.parameter
    start = before[key][0] if key in before else plain["on_top"][edit.effect][edit.parameter]
    expected = edit.expected(start, r["size"])
    if edit.effect == "steering_offset" and ("steering_ratio", "factor") in before:
        # An offset of the recorded angle is divided by the steering ratio.
        expected = start - r["size"] / before["steering_ratio", "factor"][0]
    value = after.get(key)
    moved = value[1] <= expected <= value[2] if value else edit.effect in alternatives(r)
    others = {k for k in (*before, *after) if k[0] != edit.effect and not _same(k, before, after, plain, r)}
    return EditComparison(moved, tuple(sorted({effect for effect, _ in others})), expected, value)


def stated_values(r: Record) -> Stated:
    return {(e["name"], n): tuple(v) for e in r["effects"] for n, v in e["values"].items()}


def alternatives(r: Record) -> set[str]:
    return {name for e in r["effects"] for name in e["alternatives"]}


def _same(key: tuple[str, str], before: Stated, after: Stated, plain: Record, r: Record) -> bool:
    """Whether one of the two values is inside the interval of the other.

    A value that is not stated is null, unless its effect has become an alternative of a stated one.
    """
    effect = key[0]
    if key in before and key in after:
        (a, a_low, a_high), (b, b_low, b_high) = before[key], after[key]
        return a_low <= b <= a_high or b_low <= a <= b_high
    if effect in alternatives(r if key in before else plain):
        return True
    _, low, high = before.get(key) or after[key]
    return low <= null_value(*key) <= high
