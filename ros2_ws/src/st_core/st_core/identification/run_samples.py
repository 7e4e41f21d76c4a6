"""A drive as samples at the CG, on the INS clock, all signals behind the same filter: what regressions work on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..filtering import NANOSECOND, filtered_derivative
from ..frames import ins_to_cg_acceleration
from ..log import DriveLog
from ..log_signals import LogSignals
from ..vehicle import VehicleParameters
from .result import IdentificationError

LateralAcceleration = Literal["velocity", "accelerometer"]

EDGE = 0.2
"""s. The filter starts at rest at both ends of a stretch without gaps; so long its answer is not used."""


SHORTEST, FEWEST = 5.0, 50
"""s of common measurement, and INS samples, below which a drive is not used."""


NOTICED_BIAS = 5.0e-4
"""rad/s, 0.03 deg/s: more than an INS that is in order shows; 0.1 deg at the hand wheel at 15 m/s."""


@dataclass(frozen=True, eq=False)
class RunSamples:
    """Samples of one drive, (n,) each, at the CG in body axes; all known.

    time [s] after the first INS sample. velocity_x, velocity_y [m/s], yaw_rate [rad/s], yaw_acceleration [rad/s^2],
    velocity_x_dot, lateral_acceleration (v_y_dot + v_x r) [m/s^2], left +. road_wheel_angle [rad], of the vehicle
    file's ratio and offset, and steering_wheel_angle [rad], as the sensor reads. yaw [rad], not filtered.
    """

    name: str
    time: np.ndarray
    velocity_x: np.ndarray
    velocity_y: np.ndarray
    yaw: np.ndarray
    yaw_rate: np.ndarray
    yaw_acceleration: np.ndarray
    velocity_x_dot: np.ndarray
    lateral_acceleration: np.ndarray
    road_wheel_angle: np.ndarray
    steering_wheel_angle: np.ndarray

    def __len__(self) -> int:
        return len(self.time)

    @property
    def curvature(self) -> np.ndarray:
        """r / v_x [1/m], left +; of the path of the rear axle as long as its tyres do not slip."""
        return self.yaw_rate / np.maximum(np.abs(self.velocity_x), 0.5) * np.sign(self.velocity_x)


def run_samples(log: DriveLog, vehicle: VehicleParameters, cutoff: float = 2.0, maximum_gap: float = 0.1,
                lateral_acceleration: LateralAcceleration = "velocity") -> RunSamples:
    """Samples of a drive at the instants of the INS at which everything is known.

    Filter of velocity, yaw rate, steering and accelerometer alike, forward and backward: first-order Butterworth of
    `cutoff` [Hz], see `filtering.filtered_derivative`; derivatives are central differences behind it. No delay, and
    the same attenuation on both sides of every equation.

    lateral_acceleration: velocity = v_y_dot + v_x r, free of gravity; accelerometer = a_y as recorded, which on a
    rolling body or a banked road contains g sin(roll) too. Both are moved to the CG (`frames.ins_to_cg_acceleration`).
    Raises IdentificationError for a drive without common measurements, or without the required accelerometer.
    """
    def smooth(time_ns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return filtered_derivative(time_ns, values, cutoff, maximum_gap, "zero_phase")

    if log.overlap <= 2.0 * EDGE:
        raise IdentificationError(f"{log.name}: INS and steering were measured together for {log.overlap:.2g} s; "
                                  "record longer")
    time_ns, d_x, d_y = log.ins_time_ns, vehicle.cg_to_ins_x, vehicle.cg_to_ins_y
    speed, speed_dot = smooth(time_ns, log.velocity_x)
    across, across_dot = smooth(time_ns, log.velocity_y)
    yaw_rate, yaw_acceleration = smooth(time_ns, log.yaw_rate)
    if lateral_acceleration == "velocity":
        a_y = across_dot + speed * yaw_rate
    elif log.acceleration_y is None:
        raise IdentificationError(f"{log.name}: no accelerometer was recorded; use the acceleration from velocity")
    else:
        a_y = _where_there(log.ins_time_ns, log.acceleration_y, smooth, maximum_gap)
    _, a_y = ins_to_cg_acceleration(0.0, a_y, yaw_rate, yaw_acceleration, d_x, d_y)

    angle, _ = smooth(log.steering_time_ns, log.road_wheel_angle)
    signals = LogSignals(log, maximum_gap, 5.0)
    angle = signals.sample(log.steering_time_ns, angle, time_ns)
    known = np.isfinite(angle) & _inside(time_ns, maximum_gap) & np.isfinite(yaw_acceleration) & np.isfinite(a_y)
    seconds = (time_ns - time_ns[:1]) * NANOSECOND
    columns = (seconds, speed + yaw_rate * d_y, across - yaw_rate * d_x, log.yaw, yaw_rate, yaw_acceleration,
               speed_dot + yaw_acceleration * d_y, a_y, angle, vehicle.steering_wheel_angle(angle))
    return RunSamples(log.name, *(column[known] for column in columns))


def _where_there(time_ns: np.ndarray, recorded: np.ndarray, smooth: Callable, maximum_gap: float) -> np.ndarray:
    """acceleration_y behind the filter; NaN where it was not recorded and where the filter is not settled."""
    there, result = np.flatnonzero(np.isfinite(recorded)), np.full(len(recorded), np.nan)
    if len(there):
        filtered, _ = smooth(time_ns[there], recorded[there])
        result[there] = np.where(_inside(time_ns[there], maximum_gap), filtered, np.nan)
    return result


def prepared(logs: Sequence[DriveLog], vehicle: VehicleParameters) -> tuple[list[DriveLog], tuple[str, ...]]:
    """(drives prepared for the estimators, warnings).

    The road wheel angle is that of this vehicle's ratio and offset, where the hand wheel was recorded. The mean yaw
    rate of each drive is made that of its heading: the bias of a gyro would pass for an offset of the steering.
    Raises IdentificationError for no drive, two of one name, and one that is too short. `checks` tests
    before whether its signals are consistent.
    """
    names = [log.name for log in logs]
    if not names:
        raise IdentificationError("no drives were given; name at least one recording")
    if len(set(names)) != len(names):
        raise IdentificationError(f"drives {', '.join(names)}: one is named twice; each may enter once")
    own = [log if log.steering_wheel_angle is None else log.with_steering(vehicle) for log in logs]
    for log in own:
        _check_length(log)
    biases = [yaw_rate_bias(log) for log in own]
    own = [replace(log, yaw_rate=log.yaw_rate - bias) for log, bias in zip(own, biases, strict=True)]
    noticed = [f"{name} {bias:+.4f}" for name, bias in zip(names, biases, strict=True) if abs(bias) > NOTICED_BIAS]
    words = f"The yaw rate drifts against the heading (taken away, rad/s): {', '.join(noticed)}."
    return own, (words,) if noticed else ()


def _check_length(log: DriveLog) -> None:
    if log.overlap < SHORTEST or len(log.ins_time_ns) < FEWEST:
        raise IdentificationError(f"{log.name}: too few samples: {len(log.ins_time_ns)} of the INS, {log.overlap:.1f} "
                                  f"s together with the steering; at least {SHORTEST:g} s and {FEWEST} are needed")


def yaw_rate_bias(log: DriveLog, maximum_gap: float = 0.1) -> float:
    """Mean of yaw rate minus rate of change of yaw, over all that has no gaps [rad/s]."""
    spacing = np.diff(log.ins_time_ns) * NANOSECOND
    whole = spacing <= maximum_gap
    turned = (0.5 * (log.yaw_rate[1:] + log.yaw_rate[:-1]) * spacing - np.diff(log.yaw))[whole]
    return float(turned.sum() / max(spacing[whole].sum(), NANOSECOND))


def _inside(time_ns: np.ndarray, maximum_gap: float) -> np.ndarray:
    """Whether a sample lies EDGE away from the ends of its stretch without a gap."""
    edge = round(EDGE / NANOSECOND)
    breaks = np.flatnonzero(np.diff(time_ns) > round(maximum_gap / NANOSECOND))
    begins = time_ns[np.concatenate(([0], breaks + 1))]
    ends = time_ns[np.concatenate((breaks, [len(time_ns) - 1]))]
    stretch = np.searchsorted(begins, time_ns, side="right") - 1
    return (time_ns - begins[stretch] >= edge) & (ends[stretch] - time_ns >= edge)
