"""Corrections of known errors of a recording: scale, bias, delay, reference point, misalignment of the INS.

    corrected value = scale * recorded value + add,   corrected time = recorded time - earlier

Corrections belong in the run.yaml of a recording; recorded files are not changed. Checked by: test_corrections.py.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .errors import StCoreError
from .log import INS_SIGNALS, OPTIONAL_INS_SIGNALS, DriveLog
from .timeseries import NANOSECOND, interpolate
from .types import body_to_map, map_to_body
from .vehicle import VehicleParameters

MAX_GAP = 0.25  # s, longest gap across which a signal shifted in time is interpolated
MAX_VALUES = {"scale": 1e12, "add": 1e12, "earlier": 60.0, "ahead": 100.0}  # largest magnitude of each field
STEERING = ("road_wheel_angle", "steering")
COMPONENTS = {"position": ("x", "y"), "velocity": ("velocity_x", "velocity_y")}
_FIELDS = ("scale", "add", "earlier")
CHANNELS: Mapping[str, tuple[str, ...]] = {
    "x": _FIELDS, "y": _FIELDS, "position": ("scale", "earlier", "ahead"), "yaw": _FIELDS, "heading": ("add",),
    "velocity_x": _FIELDS, "velocity_y": _FIELDS, "velocity": ("scale", "earlier"),
    **dict.fromkeys(("yaw_rate", *OPTIONAL_INS_SIGNALS, *STEERING), _FIELDS),
}
"""Fields of Correction that apply, by channel."""
UNITS: Mapping[str, str] = {
    **dict.fromkeys(("x", "y", "position"), "m"), **dict.fromkeys(("velocity_x", "velocity_y", "velocity"), "m/s"),
    "yaw_rate": "rad/s", **dict.fromkeys(("acceleration_x", "acceleration_y"), "m/s^2"),
    **dict.fromkeys(("yaw", "heading", *STEERING), "rad"),
}


@dataclass(frozen=True)
class Correction:
    """Correction of one channel. scale [1]. add [unit of the channel]. earlier: delay that is removed [s].
    ahead: shift of the position along body x [m], > 0 forward."""

    scale: float = 1.0
    add: float = 0.0
    earlier: float = 0.0
    ahead: float = 0.0


def apply_corrections(log: DriveLog, corrections: Mapping[str, Correction], vehicle: VehicleParameters | None = None,
                      leave_out: Sequence[tuple[float, float]] = ()) -> DriveLog:
    """The corrected drive.

    Each channel is scaled, then offset, then shifted in time. Corrections of "position" and "velocity" apply to both
    components, after those of a single component. Then

        heading.add = a:    yaw -> yaw + a,  (v, acceleration)_body -> R(-a) (v, acceleration)_body; R(yaw) v unchanged
        position.ahead = d: (x, y) -> (x, y) + d (cos yaw, sin yaw)

    An INS channel that is shifted in time is interpolated at the times of the other channels. Samples without an
    interpolated value (at the ends, in gaps longer than MAX_GAP) are removed; missing accelerations are NaN. For
    the steering, the times are shifted. If the road wheel angle is scaled or offset, the steering wheel angle is
    changed so that ratio and offset of `vehicle` give the corrected angle; without a vehicle it is removed.

    leave_out: intervals of INS samples to remove, (start, end) [s] after the first recorded sample, both included.
    Raises StCoreError for invalid corrections (`check_corrections`), and if the time shifts leave no sample.
    """
    check_corrections(corrections)
    seconds = (log.ins_time_ns - log.ins_time_ns[:1]) * NANOSECOND
    is_used = np.ones(len(seconds), bool)
    for begin, end in leave_out:
        is_used &= (seconds < begin - NANOSECOND) | (seconds > end + NANOSECOND)
    if not is_used.all():
        log = log.select_ins(is_used)
    log = _correct_ins(log, corrections)
    if angle := corrections.get("heading", Correction()).add:
        changes: dict[str, Any] = {"yaw": log.yaw + angle}
        for vector in ("velocity", "acceleration"):
            x, y = getattr(log, f"{vector}_x"), getattr(log, f"{vector}_y")
            if x is not None and y is not None:
                changes[f"{vector}_x"], changes[f"{vector}_y"] = map_to_body(x, y, angle)
        log = replace(log, **changes)
    if ahead := corrections.get("position", Correction()).ahead:
        east, north = body_to_map(ahead, 0.0, log.yaw)
        log = replace(log, x=log.x + east, y=log.y + north)
    for name in STEERING:
        log = _correct_steering(log, corrections.get(name, Correction()), vehicle)
    if is_used.any() and not len(log.ins_time_ns):
        raise StCoreError(f"{log.name}: the corrections leave no INS sample")
    return log


def check_corrections(corrections: Mapping[str, Correction]) -> None:
    """Raises StCoreError for an unknown channel, an invalid value, and corrections of both steering channels."""
    for channel, correction in corrections.items():
        if channel not in CHANNELS:
            raise StCoreError(f"{channel}: unknown channel; known: {', '.join(CHANNELS)}")
        for name, neutral in vars(Correction()).items():
            value = getattr(correction, name)
            if not abs(value) <= MAX_VALUES[name]:
                raise StCoreError(f"{channel}: {name}: {value!r} is not within +-{MAX_VALUES[name]:g}")
            if value != neutral and name not in CHANNELS[channel]:
                raise StCoreError(f"{channel}: {name} does not apply here; use {', '.join(CHANNELS[channel])}")
        if correction.scale == 0.0:
            raise StCoreError(f"{channel}: scale: must not be 0")
    if all(name in corrections for name in STEERING):
        raise StCoreError(f"{' and '.join(STEERING)} are the same channel; correct only one of them")


def describe_corrections(corrections: Mapping[str, Correction]) -> tuple[str, ...]:
    """One phrase per channel, such as "yaw_rate x 0.01745 - 0.004 rad/s, 0.31 s earlier"."""
    phrases = []
    for channel, correction in corrections.items():
        phrase = channel
        if correction.scale != 1.0:
            phrase += f" x {correction.scale:.6g}"
        if correction.add:
            phrase += f" {'+' if correction.add > 0 else '-'} {abs(correction.add):.6g} {UNITS[channel]}"
        if correction.earlier:
            phrase += f", {abs(correction.earlier):.6g} s {'earlier' if correction.earlier > 0 else 'later'}"
        if correction.ahead:
            phrase += f", {abs(correction.ahead):.6g} m {'ahead' if correction.ahead > 0 else 'behind'}"
        phrases.append(phrase)
    return tuple(phrases)


def _correct_ins(log: DriveLog, corrections: Mapping[str, Correction]) -> DriveLog:
    group = {name: pair for pair, names in COMPONENTS.items() for name in names}
    changes: dict[str, Any] = {}
    for name in (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS):
        applied = [corrections[key] for key in (name, group.get(name, "")) if key in corrections]
        values = getattr(log, name)
        if not applied or values is None:
            continue
        for correction in applied:
            values = correction.scale * values + correction.add
        delay_ns = round(sum(correction.earlier for correction in applied) / NANOSECOND)
        if delay_ns:
            values = interpolate(log.ins_time_ns, values, log.ins_time_ns + delay_ns, round(MAX_GAP / NANOSECOND))
        changes[name] = values
    if not changes:
        return log
    known = np.all([np.isfinite(changes.get(name, getattr(log, name))) for name in INS_SIGNALS], axis=0)
    return replace(log.select_ins(known), **{name: values[known] for name, values in changes.items()})


def _correct_steering(log: DriveLog, correction: Correction, vehicle: VehicleParameters | None) -> DriveLog:
    if delay_ns := round(correction.earlier / NANOSECOND):
        log = replace(log, steering_time_ns=log.steering_time_ns - delay_ns)
    if correction.scale == 1.0 and not correction.add:
        return log
    steering_wheel_angle = None
    if log.steering_wheel_angle is not None and vehicle is not None:
        offset = vehicle.steering_wheel_offset
        steering_wheel_angle = (offset + correction.scale * (log.steering_wheel_angle - offset)
                                + correction.add * vehicle.steering_ratio)
    return replace(log, road_wheel_angle=correction.scale * log.road_wheel_angle + correction.add,
                   steering_wheel_angle=steering_wheel_angle)
