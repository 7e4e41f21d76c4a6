"""Preparation of drives for identification: filtered samples at the CG, yaw rate bias, coverage of signals."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..channels import CHANNELS
from ..log import DriveLog
from ..timeseries import NANOSECOND, filtered_derivative, interpolate
from ..types import ins_to_cg_acceleration
from ..vehicle import VehicleParameters
from .result import Coverage, IdentificationError

FILTER_SETTLING_TIME = 0.2  # s; samples this close to an end of an interval without gaps are discarded
MAXIMUM_GAP = 0.1  # s; longest interval between samples that is interpolated
MIN_COMMON_TIME, MIN_SAMPLES = 5.0, 50  # time with both INS and steering [s], number of INS samples
MIN_REPORTED_BIAS = 5.0e-4  # rad/s; above the drift of a good INS; equivalent to 0.1 deg of steering wheel at 15 m/s
SPEED_EDGES = np.array([0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 30.0, 60.0])  # m/s
ACCELERATION_EDGES = np.array([-8.0, -4.0, -3.0, -2.0, -1.0, -0.3, 0.3, 1.0, 2.0, 3.0, 4.0, 8.0])  # m/s^2


@dataclass(frozen=True, eq=False)
class RunSamples:
    """Samples of one drive, (n,) each, at the CG in body axes, without NaN; positive to the left."""

    name: str
    time: np.ndarray  # s since the first INS sample
    velocity_x: np.ndarray  # m/s
    velocity_y: np.ndarray  # m/s
    yaw: np.ndarray  # rad, not filtered
    yaw_rate: np.ndarray  # rad/s
    yaw_acceleration: np.ndarray  # rad/s^2
    lateral_acceleration: np.ndarray  # v_y_dot + v_x r [m/s^2]
    road_wheel_angle: np.ndarray  # rad, with the ratio and offset of the vehicle file
    steering_wheel_angle: np.ndarray  # rad at the sensor, filtered

    def __len__(self) -> int:
        return len(self.time)


def sample_run(log: DriveLog, vehicle: VehicleParameters, cutoff: float = 2.0) -> RunSamples:
    """Samples of a drive at the INS sample times at which all signals are available; empty if gaps leave none.

    log: from `prepare_drives`. Velocity, yaw rate and steering pass the same first-order zero-phase Butterworth filter
    with `cutoff` [Hz] (`timeseries.filtered_derivative`), so that it attenuates both sides of an equation equally. The
    lateral acceleration is v_y_dot + v_x r, transformed to the CG.
    """
    def smooth(time_ns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return filtered_derivative(time_ns, values, cutoff, MAXIMUM_GAP, "zero_phase")

    gap_ns, settling_ns = round(MAXIMUM_GAP / NANOSECOND), round(FILTER_SETTLING_TIME / NANOSECOND)
    time_ns, d_x, d_y = log.ins_time_ns, vehicle.cg_to_ins_x, vehicle.cg_to_ins_y
    speed, _ = smooth(time_ns, log.velocity_x)
    velocity_y, velocity_y_dot = smooth(time_ns, log.velocity_y)
    yaw_rate, yaw_acceleration = smooth(time_ns, log.yaw_rate)
    _, a_y = ins_to_cg_acceleration(0.0, velocity_y_dot + speed * yaw_rate, yaw_rate, yaw_acceleration, d_x, d_y)
    angle, _ = smooth(log.steering_time_ns, log.road_wheel_angle)
    angle = interpolate(log.steering_time_ns, angle, time_ns, gap_ns)
    breaks = np.flatnonzero(np.diff(time_ns) > gap_ns)
    starts, ends = time_ns[np.append(0, breaks + 1)], time_ns[np.append(breaks, len(time_ns) - 1)]
    segment = np.searchsorted(starts, time_ns, side="right") - 1
    is_settled = np.minimum(time_ns - starts[segment], ends[segment] - time_ns) >= settling_ns
    is_valid = np.isfinite(angle) & is_settled & np.isfinite(yaw_acceleration) & np.isfinite(a_y)
    columns = ((time_ns - time_ns[:1]) * NANOSECOND, speed + yaw_rate * d_y, velocity_y - yaw_rate * d_x, log.yaw,
               yaw_rate, yaw_acceleration, a_y, angle, vehicle.steering_wheel_angle(angle))
    return RunSamples(log.name, *(column[is_valid] for column in columns))


def prepare_drives(logs: Sequence[DriveLog], vehicle: VehicleParameters,
                   *required: str) -> tuple[list[DriveLog], tuple[str, ...]]:
    """(drives prepared for an estimator, warnings).

    If the steering wheel angle was recorded, the road wheel angle is computed with ratio and offset of `vehicle`. The
    yaw rate bias of each drive is removed, since it would appear as an offset of the steering. required: channels that
    each drive must have. Raises IdentificationError without drives, and for a duplicate name or an unusable drive.
    """
    names = [log.name for log in logs]
    if not names:
        raise IdentificationError("no drives were given; name at least one recording")
    if len(set(names)) != len(names):
        raise IdentificationError(f"drives {', '.join(names)}: duplicate name; give each drive once")
    for log in logs:
        for name in required:
            if not CHANNELS[name].is_measured_in(log):
                raise IdentificationError(f"{log.name}: {name} was not measured, or is 0 throughout, but is required "
                                          "here: record it with a dual-antenna INS, or leave the drive out")
    prepared = [log if log.steering_wheel_angle is None else log.with_steering(vehicle) for log in logs]
    biases = []
    for k, log in enumerate(prepared):
        if log.overlap < MIN_COMMON_TIME or len(log.ins_time_ns) < MIN_SAMPLES:
            raise IdentificationError(
                f"{log.name}: {len(log.ins_time_ns)} INS samples, which overlap with the steering for "
                f"{log.overlap:.1f} s; at least {MIN_SAMPLES} samples and {MIN_COMMON_TIME:g} s are needed")
        bias = estimate_yaw_rate_bias(log)
        prepared[k] = replace(log, yaw_rate=log.yaw_rate - bias)
        if abs(bias) > MIN_REPORTED_BIAS:
            biases.append(f"{log.name} {bias:+.4f}")
    warning = f"Removed yaw rate bias [rad/s], estimated from the change of yaw: {', '.join(biases)}."
    return prepared, (warning,) if biases else ()


def estimate_yaw_rate_bias(log: DriveLog) -> float:
    """Mean of the yaw rate minus the derivative of yaw, outside gaps [rad/s]."""
    spacing = np.diff(log.ins_time_ns) * NANOSECOND
    is_without_gap = spacing <= MAXIMUM_GAP
    difference = (0.5 * (log.yaw_rate[1:] + log.yaw_rate[:-1]) * spacing - np.diff(log.yaw))[is_without_gap]
    return float(difference.sum() / max(spacing[is_without_gap].sum(), NANOSECOND))


def measure_coverage(signal: str, unit: str, edges: np.ndarray, values: Sequence[np.ndarray],
                     times: Sequence[np.ndarray], min_seconds: float, min_filled_bins: int) -> Coverage:
    """Coverage of the range of a signal in all drives. values: (n,) by drive. times: of all samples, by drive [s].
    min_seconds: minimum time in a filled bin. Raises IdentificationError if no drive has two samples."""
    spacing = np.concatenate([np.diff(time) for time in times])
    if not len(spacing):
        raise IdentificationError(f"nearly all samples are within {FILTER_SETTLING_TIME:g} s of a gap above "
                                  f"{MAXIMUM_GAP:g} s: record INS and steering at more than 10 Hz, without gaps")
    return Coverage(signal, unit, edges, np.histogram(np.concatenate(values), edges)[0],
                    max(1, round(min_seconds / float(np.median(spacing)))), min_filled_bins)


def measure_driving_coverage(logs: Sequence[DriveLog], vehicle: VehicleParameters, minimum_speed: float,
                             speed: tuple[float, int],
                             lateral_acceleration: tuple[float, int]) -> tuple[Coverage, Coverage]:
    """Coverage of speed and lateral acceleration v_x r in driving above a minimum speed [m/s]. speed,
    lateral_acceleration: required (seconds in a filled bin, number of filled bins)."""
    edges = SPEED_EDGES * vehicle.speed_scale
    times = [(log.ins_time_ns - log.ins_time_ns[:1]) * NANOSECOND for log in logs]
    is_fast = [log.velocity_x >= minimum_speed for log in logs]
    speeds = [log.velocity_x[mask] for log, mask in zip(logs, is_fast, strict=True)]
    accelerations = [(log.velocity_x * log.yaw_rate)[mask] for log, mask in zip(logs, is_fast, strict=True)]
    return (measure_coverage("speed", "m/s", edges, speeds, times, *speed),
            measure_coverage("lateral acceleration", "m/s^2", ACCELERATION_EDGES, accelerations, times,
                             *lateral_acceleration))


def require_coverage(coverages: Sequence[Coverage], advice: str) -> None:
    """Raises IdentificationError for too little excitation. advice: sentence on the required driving."""
    insufficient = [coverage.describe() for coverage in coverages if not coverage.sufficient]
    if insufficient:
        raise IdentificationError(f"too little excitation: {'; '.join(insufficient)}. {advice}")
