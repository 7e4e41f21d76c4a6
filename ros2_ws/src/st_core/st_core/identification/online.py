"""Online identification of steering offset, steering ratio and stiffness scale, by `driving_fit` on recent driving.

After every FIT_INTERVAL of usable driving, both stiffnesses, ratio, offset, INS misalignment, dead time of the steering
and relaxation length of the tyres are fitted together to the stored driving. The standard deviation of a value is
sqrt((h / 1.96)^2 + s^2), h: half-width of the 95 % interval, from the variation between blocks of driving, s: from
SYSTEMATIC_ERRORS of the single-track model. With sufficient excitation the status is estimated if the standard
deviation is at most MAX_DEVIATIONS, and invalid if the value is implausible for the car or at a limit of the fit, or if
the residual is large. Valid at |a_y| <= 4 m/s^2 on dry level roads. Checked by: test_online.py.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ..errors import StCoreError
from ..log import DriveLog
from ..regression import Z95
from ..timeseries import NANOSECOND
from ..types import InsSample
from ..vehicle import VehicleParameters
from .driving_fit import DELAY, MISALIGNMENT, RELAXATION, DrivingFitSettings, fit_driving
from .driving_prediction import STIFFNESSES, SYSTEMATIC_ERRORS
from .run_samples import prepare_drives

OnlineStatus = Literal["unestimated", "estimated", "invalid"]
NAMES = ("steering_wheel_offset", "steering_ratio", "stiffness_scale")
UNITS = ("rad", "1", "1")
FITTED_PARAMETERS = ("steering_wheel_offset", "steering_ratio", *STIFFNESSES, MISALIGNMENT, DELAY, RELAXATION)
FIT_SETTINGS = DrivingFitSettings(interval=1.0, min_windows=20)
BUFFER_DURATION, SPACING_NS = 400.0, 19_000_000  # stored driving [s], minimum spacing of the stored samples [ns]
FIT_INTERVAL = 15.0  # s of usable driving
MIN_SPEED = 2.0  # m/s; slower samples are not stored
MAX_GAP = 0.1  # s; longer intervals between samples do not count as driving time
DEVIATIONS_WITHOUT_FIT = (math.radians(30.0), 0.2, 0.5)  # standard deviations in the order of NAMES: [rad], relative
MAX_DEVIATIONS = (math.radians(0.5), 0.015, 0.06)  # largest with status `estimated`: [rad], relative
MAX_OFFSET = math.radians(45.0)  # of the steering wheel
PLAUSIBLE_RANGES = ((0.6, 1.6), (0.3, 3.0))  # steering ratio / that of the vehicle file; stiffness scale
MAX_RESIDUAL_RATIO = 0.2  # largest `OnlineFit.residual_ratio`: 96 % of the mean square of the yaw rate is explained
MIN_YAW_RATE = 0.02  # rad/s; smallest divisor of the residual, for driving with few bends
SPEED_BINS = (5.0, 7.0, 10.0, 14.0, 20.0)  # m/s; lower edges
MIN_BEND_ANGLE = 0.02  # rad; minimum |L r / v| in a bend, L: wheelbase
MIN_LOADED_ACCELERATION = 1.5  # m/s^2; minimum |v r| with significant lateral tyre forces


@dataclass(frozen=True)
class OnlineEstimate:
    """Current estimate of one parameter."""

    parameter: str
    value: float
    unit: str
    deviation: float  # standard deviation
    status: OnlineStatus
    reason: str  # why the status is unestimated or invalid; else empty


@dataclass
class DrivingTime:
    """Time driven so far [s], by type of driving."""

    used: float = 0.0  # within the limits of FIT_SETTINGS for speed and lateral acceleration
    straight: float = 0.0  # |L r / v| below a quarter of MIN_BEND_ANGLE
    left: float = 0.0  # L r / v above MIN_BEND_ANGLE
    right: float = 0.0  # L r / v below -MIN_BEND_ANGLE
    loaded_left: float = 0.0  # v r above MIN_LOADED_ACCELERATION
    loaded_right: float = 0.0  # v r below -MIN_LOADED_ACCELERATION
    speeds: list[float] = field(default_factory=lambda: [0.0] * len(SPEED_BINS))  # by speed bin
    rejected: dict[str, float] = field(default_factory=dict)  # by reason


@dataclass(frozen=True)
class OnlineFit:
    """Result of one fit."""

    values: tuple[float, ...]  # (3,) in the order of NAMES
    deviations: tuple[float, ...]  # standard deviations (3,)
    residual_ratio: float = 0.0  # RMS yaw rate residual / RMS yaw rate, or / MIN_YAW_RATE if larger
    at_bound: tuple[str, ...] = ()  # names of values at a limit of the fit
    problem: str = ""  # why the fit failed, or empty


def fit_recent(log: DriveLog, vehicle: VehicleParameters) -> OnlineFit:
    """Fit to a snapshot of recent driving; `problem` is set if it is unusable. May run in a separate thread."""
    try:
        logs, _ = prepare_drives([log], vehicle)
        fit = fit_driving(logs, vehicle, FITTED_PARAMETERS, "nonlinear", FIT_SETTINGS)
    except (StCoreError, np.linalg.LinAlgError) as error:
        return _make_failed_fit(vehicle, str(error))
    # Rows: offset, ratio, and stiffness scale (mean over both axles of stiffness / stiffness in the vehicle file).
    rows = np.zeros((3, len(FITTED_PARAMETERS)))
    rows[0, 0] = rows[1, 1] = 1.0
    rows[2, 2:4] = [0.5 / getattr(vehicle, name) for name in STIFFNESSES]
    values = rows @ fit.values
    # Factor from the standard error to h / 1.96, see the module docstring; > 1, because h is from Student's t.
    half_widths = np.array([fit.spread.interval(k, 0.0)[1] for k in range(len(FITTED_PARAMETERS))])
    widening = half_widths / Z95 / np.maximum(fit.spread.standard_errors, 1e-300)
    covariance = rows @ (fit.spread.covariance * np.outer(widening, widening)) @ rows.T
    systematic = np.array([SYSTEMATIC_ERRORS[0], SYSTEMATIC_ERRORS[1] * values[1], SYSTEMATIC_ERRORS[2] * values[2]])
    deviations = np.sqrt(np.diag(covariance) + systematic**2)
    rate = max(float(np.sqrt(np.mean(np.square(log.yaw_rate)))), MIN_YAW_RATE)
    residual = float(np.sqrt(np.mean(np.square(fit.residuals["yaw_rate"]))))
    return OnlineFit(tuple(values.tolist()), tuple(deviations.tolist()), residual / rate, fit.at_bound)


def _make_failed_fit(vehicle: VehicleParameters, problem: str) -> OnlineFit:
    ratio = vehicle.steering_ratio
    offset_deviation, ratio_deviation, scale_deviation = DEVIATIONS_WITHOUT_FIT
    return OnlineFit((vehicle.steering_wheel_offset, ratio, 1.0),
                     (offset_deviation, ratio_deviation * ratio, scale_deviation), problem=problem)


class OnlineIdentifier:
    """Stores samples in order of time, and makes estimates from `fit`, which the caller sets with `fit_recent`."""

    def __init__(self, vehicle: VehicleParameters):
        self.reset(vehicle)

    def reset(self, vehicle: VehicleParameters) -> None:
        """Discard all stored driving and estimates, and continue with this vehicle."""
        self.vehicle = vehicle
        self.driving_time = DrivingTime()
        capacity = round(BUFFER_DURATION / NANOSECOND / SPACING_NS)
        self._ins: deque[InsSample] = deque(maxlen=capacity)
        self._steering: deque[tuple[int, float]] = deque(maxlen=capacity)
        self._newest_ns, self._driving_time_at_fit = 0, 0.0
        self.fit = _make_failed_fit(vehicle, "no fit yet")

    def add_ins(self, sample: InsSample) -> bool:
        """Add a sample at the INS point; False if not finite or not newer. `reset` if time jumps back by over 1 s."""
        if not all(map(math.isfinite, sample[1:7])):
            return False
        step = (sample.time_ns - self._newest_ns) * NANOSECOND
        if step <= 0.0:
            if step < -1.0:
                self.reset(self.vehicle)
            return False
        self._newest_ns = sample.time_ns
        self._add_driving_time(sample, step if step <= MAX_GAP else 0.0)
        if sample.velocity_x > MIN_SPEED and (not self._ins or sample.time_ns - self._ins[-1].time_ns >= SPACING_NS):
            self._ins.append(sample)
        return True

    def add_steering(self, time_ns: int, angle: float) -> bool:
        """Add a reading of the steering wheel sensor [rad]; False if it is not finite or not newer."""
        if not math.isfinite(angle) or (self._steering and time_ns <= self._steering[-1][0]):
            return False
        if not self._steering or time_ns - self._steering[-1][0] >= SPACING_NS:
            self._steering.append((time_ns, angle))
        return True

    @property
    def is_fit_due(self) -> bool:
        """Whether there is enough new driving for the next fit."""
        return self.driving_time.used - self._driving_time_at_fit >= FIT_INTERVAL and len(self._steering) > 1

    def take_snapshot(self) -> tuple[DriveLog, VehicleParameters]:
        """Stored driving and vehicle, for `fit_recent`. The next fit is due after FIT_INTERVAL of further driving."""
        self._driving_time_at_fit = self.driving_time.used
        times = np.array([sample.time_ns for sample in self._ins], np.int64)
        steering_times = np.array([time for time, _ in self._steering], np.int64)
        angle = np.array([value for _, value in self._steering])
        x, y, yaw, velocity_x, velocity_y, yaw_rate = np.array([sample[1:7] for sample in self._ins]).T
        return DriveLog("recent driving", times, x, y, np.unwrap(yaw), velocity_x, velocity_y, yaw_rate,
                        steering_times, self.vehicle.road_wheel_angle(angle), angle), self.vehicle

    def make_estimates(self) -> tuple[OnlineEstimate, ...]:
        """Current estimate of each parameter, or the reason why it is not estimated."""
        missing, implausible = self._describe_missing_driving(), self._describe_implausible_values()
        estimates = []
        for k, name in enumerate(NAMES):
            value, deviation = self.fit.values[k], self.fit.deviations[k]
            reason = missing[name] or self.fit.problem
            if not reason and not deviation / (value if k else 1.0) <= MAX_DEVIATIONS[k]:
                reason = "the uncertainty is still too large"
            status: OnlineStatus = "unestimated" if reason else "estimated"
            if not missing[name] and implausible.get(name):
                status, reason = "invalid", implausible[name]
            estimates.append(OnlineEstimate(name, value, UNITS[k], deviation, status, reason))
        return tuple(estimates)

    def _add_driving_time(self, sample: InsSample, time: float) -> None:
        speed, rate, times = sample.velocity_x, sample.yaw_rate, self.driving_time
        rejection = "too slow" if speed < FIT_SETTINGS.minimum_speed else (
            "lateral acceleration too high" if abs(speed * rate) > FIT_SETTINGS.maximum_acceleration else "")
        if rejection:
            times.rejected[rejection] = times.rejected.get(rejection, 0.0) + time
            return
        bend, acceleration = self.vehicle.wheelbase * rate / speed, speed * rate
        times.used += time
        times.straight += time * (abs(bend) < 0.25 * MIN_BEND_ANGLE)
        times.left += time * (bend > MIN_BEND_ANGLE)
        times.right += time * (bend < -MIN_BEND_ANGLE)
        times.loaded_left += time * (acceleration > MIN_LOADED_ACCELERATION)
        times.loaded_right += time * (acceleration < -MIN_LOADED_ACCELERATION)
        times.speeds[sum(speed >= edge for edge in SPEED_BINS[1:])] += time

    def _describe_missing_driving(self) -> Mapping[str, str]:
        """The driving that each parameter still needs, as text; "" if there is enough."""
        times = self.driving_time
        bends = min(times.left, times.right)
        filled_bins = sum(time >= 5.0 for time in times.speeds)
        required = {
            "steering_wheel_offset": [(times.used, 10, "s of driving"),
                                      (max(times.straight, bends), 5, "s of straights, or of bends to each side")],
            # Ratio and front stiffness are not separable at a single speed.
            "steering_ratio": [(times.left, 5, "s of left bends"), (times.right, 5, "s of right bends"),
                               (filled_bins, 2, "speed ranges with 5 s each")],
            "stiffness_scale": [(times.loaded_left, 3, "s of left bends above 1.5 m/s^2"),
                                (times.loaded_right, 3, "s of right bends above 1.5 m/s^2"),
                                (filled_bins, 2, "speed ranges with 5 s each")],
        }
        return {name: "; ".join(f"{driven:.0f} of {needed} {text}" for driven, needed, text in rows if driven < needed)
                for name, rows in required.items()}

    def _describe_implausible_values(self) -> Mapping[str, str]:
        fit, (offset, ratio, scale) = self.fit, self.fit.values
        if fit.residual_ratio > MAX_RESIDUAL_RATIO:
            return dict.fromkeys(NAMES, f"the residual is {100 * fit.residual_ratio:.0f} % of the yaw rate: "
                                        "road, load or a sensor differs from the assumptions of the model")
        reasons = {}
        if abs(offset) > MAX_OFFSET:
            reasons[NAMES[0]] = f"{math.degrees(offset):.0f} deg is outside -45 to 45 deg"
        relative = ratio / self.vehicle.steering_ratio
        for name, value, (low, high) in zip(NAMES[1:], (relative, scale), PLAUSIBLE_RANGES, strict=True):
            if not low < value < high:
                reasons[name] = f"{value:.2f} times the value of the vehicle file is outside {low:g} to {high:g}"
        for name in fit.at_bound:
            if name in NAMES or name in STIFFNESSES:
                reasons[name if name in NAMES else NAMES[2]] = f"{name} reached a limit of the fit"
        return reasons
