"""Faults of a recorded drive, its findings, and the corrections that they propose, applied as from a run.yaml."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from exact_drive import delay
from st_core.checks import AuxiliaryData, Finding, check
from st_core.corrections import Correction, apply_corrections
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters

Fault = Callable[[DriveLog], DriveLog]
UNITS_PER_SECOND = {"ms": 10**3, "us": 10**6}


def scaled(factor: float, *channels: str) -> Fault:
    """Multiplies channels by a factor."""
    return lambda log: replace(log, **{name: factor * getattr(log, name) for name in channels})


def biased(value: float, *channels: str) -> Fault:
    """Adds a bias to channels [SI]."""
    return lambda log: replace(log, **{name: getattr(log, name) + value for name in channels})


def delayed(seconds: float, *channels: str) -> Fault:
    return lambda log: delay(log, seconds, *channels)


def steering_scaled(factor: float, offset: float = 0.0) -> Fault:
    """Changes the steering of a recording that contains only the road wheel angle."""
    return lambda log: replace(log, road_wheel_angle=factor * log.road_wheel_angle + offset, steering_wheel_angle=None)


def steering_wheel_turned(angle: float) -> Fault:
    """Offset of the steering wheel angle, + to the left [rad]; the road wheel angle is computed from it."""
    return lambda log: replace(log, steering_wheel_angle=log.steering_wheel_angle + angle)


def position_point_moved(ahead: float) -> Fault:
    """Moves the reference point of the positions forward [m]."""
    return lambda log: replace(log, x=log.x + ahead * np.cos(log.yaw), y=log.y + ahead * np.sin(log.yaw))


def ins_moved(ahead: float) -> Fault:
    """Moves the INS forward [m]."""
    return lambda log: replace(position_point_moved(ahead)(log), velocity_y=log.velocity_y + ahead * log.yaw_rate)


def ins_rotated(angle: float) -> Fault:
    """Rotates the INS to the left [rad]."""
    def rotated(log: DriveLog) -> DriveLog:
        parts = {"yaw": log.yaw + angle}
        for kind in ("velocity", "acceleration"):
            body = (getattr(log, f"{kind}_x") + 1j * getattr(log, f"{kind}_y")) * np.exp(-1j * angle)
            parts |= {f"{kind}_x": body.real, f"{kind}_y": body.imag}
        return replace(log, **parts)
    return rotated


def yaw_from_north(size: float = 1.0) -> Fault:
    """Replaces yaw by a heading from north, clockwise."""
    return lambda log: replace(log, yaw=size * (0.5 * np.pi - log.yaw))


def axes_exchanged(sign: float = 1.0) -> Fault:
    """Exchanges x and y."""
    return lambda log: replace(log, x=sign * log.y, y=sign * log.x)


def time_unit_misread(per_second: int) -> Fault:
    """Reads time stamps in a smaller unit as seconds."""
    def misread(time: np.ndarray) -> np.ndarray:
        return time[0] + (time - time[0]) * per_second
    return lambda log: replace(log, **{name: misread(getattr(log, name))
                                       for name in ("ins_time_ns", "steering_time_ns")})


def findings_by_name(log: DriveLog, car: VehicleParameters | None = None,
                     auxiliary: AuxiliaryData | None = None) -> dict[str, Finding]:
    found = check(log, car, auxiliary).findings
    assert len({one.name for one in found}) == len(found)
    return {one.name: one for one in found}


def corrected_drive(log: DriveLog, entry: Mapping[str, Any], car: VehicleParameters) -> DriveLog:
    """The drive as read with the entry of a run.yaml: first columns, then units, then corrections."""
    assert set(entry) <= {"columns", "units", "correct", "leave_out"} and set(entry.get("units", ())) <= {"t"}
    log = replace(log, **{name: getattr(log, column) for name, column in entry.get("columns", {}).items()})
    if "units" in entry:
        count, start = UNITS_PER_SECOND[entry["units"]["t"]], log.ins_time_ns[0]
        log = replace(log, **{name: start + (getattr(log, name) - start) // count
                              for name in ("ins_time_ns", "steering_time_ns")})
    corrections = {channel: Correction(**fields) for channel, fields in entry.get("correct", {}).items()}
    return apply_corrections(log, corrections, car, entry.get("leave_out", ()))
