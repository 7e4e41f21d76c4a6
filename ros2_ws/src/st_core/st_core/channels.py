"""Channels: measured quantities that discovery and identification compare with predictions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .regression import robust_deviation, white_noise
from .timeseries import moving_average_noise_ratio
from .types import body_to_map, map_to_body, wrap_angle

SMOOTHING_NS = 100_000_000  # width of the moving average of the smoothed channels
STANDSTILL_SPEED = 0.5  # m/s; a car that is never faster counts as stationary


@dataclass(frozen=True)
class Channel:
    """One measured quantity.

    errors(measured, predicted): measured minus predicted, by column; None: the difference of a single signal.
    noise(log, step, x, y, yaw, v_x, v_y, r): standard deviation, by column, of the errors that noise alone causes at
    the end of windows, from redundant measurements. x to r: (windows, instants), `step` [s] apart. None: the noise is
    white, and is estimated from third differences, to which the motion of a car hardly contributes.
    """

    name: str
    label: str  # name in reports
    unit: str  # SI
    min_residual_scale: float  # lower limit of the scale of residuals [unit]; lower than the noise of an INS
    signals: tuple[str, ...] = ()  # DriveLog fields with the measurements; default: name
    columns: tuple[str, ...] = ()  # components of the error; default: name
    errors: Callable[[Mapping[str, np.ndarray], Any], tuple[np.ndarray, ...]] | None = None
    smoothed: bool = False  # measured and predicted values are averaged over SMOOTHING_NS
    accumulates: bool = False  # errors grow over the horizon
    zero_means_missing: bool = False  # the channel was not measured if all values are 0
    noise: Callable[..., tuple[float, ...]] | None = None

    def __post_init__(self) -> None:
        for field in ("signals", "columns"):
            object.__setattr__(self, field, getattr(self, field) or (self.name,))

    def is_measured_in(self, log: Any) -> bool:
        """Whether a DriveLog contains measurements of the channel; zeros count as measured if the car never moves."""
        if self.name == "velocity_y" and not log.sideslip_measured:
            return False
        values = [getattr(log, name) for name in self.signals]
        zero_means_missing = self.zero_means_missing and bool((np.abs(log.velocity_x) > STANDSTILL_SPEED).any())
        return all(v is not None and np.isfinite(v).any() and not (zero_means_missing and not v.any()) for v in values)

    def residuals(self, measured: Mapping[str, np.ndarray], predicted: Any) -> tuple[np.ndarray, ...]:
        """Measured minus predicted [unit], by column."""
        if self.errors:
            return self.errors(measured, predicted)
        return (measured[self.name] - getattr(predicted, self.name),)

    def noise_deviations(self, log: Any, *motion: Any) -> tuple[float, ...]:
        """Standard deviation of the errors due to noise [unit], by column."""
        if self.noise:
            return self.noise(log, *motion)
        values = getattr(log, self.name)
        finite = np.isfinite(values)
        ratio = moving_average_noise_ratio(log.ins_time_ns[finite], SMOOTHING_NS) if self.smoothed else 1.0
        return (ratio * white_noise(values),)


def _position_noise(log: Any, step: float, x: Any, y: Any, yaw: Any, v_x: Any, v_y: Any, r: Any) -> tuple[float, ...]:
    """Standard deviations (left, ahead) [m] of displacement minus dead reckoning, including noise of yaw and speed."""
    east, north = (_integrate(values, step) for values in body_to_map(v_x, v_y, yaw))
    ahead, left = map_to_body(x[:, -1] - x[:, 0] - east, y[:, -1] - y[:, 0] - north, yaw[:, -1])
    horizon = step * (x.shape[1] - 1)
    from_yaw = white_noise(log.yaw) * horizon * float(np.nanmean(v_x))
    from_speed = white_noise(log.velocity_x) * horizon
    return float(np.hypot(_finite_deviation(left), from_yaw)), float(np.hypot(_finite_deviation(ahead), from_speed))


def _heading_noise(log: Any, step: float, x: Any, y: Any, yaw: Any, v_x: Any, v_y: Any, r: Any) -> tuple[float, ...]:
    """Standard deviation of the measured change of yaw minus the integral of the measured yaw rate [rad]."""
    return (_finite_deviation(wrap_angle(yaw[:, -1] - yaw[:, 0] - _integrate(r, step))),)


def _finite_deviation(errors: np.ndarray) -> float:
    errors = errors[np.isfinite(errors)]
    return robust_deviation(errors) if len(errors) else 0.0


def _integrate(values: np.ndarray, step: float) -> np.ndarray:
    return (0.5 * (values[:, :-1] + values[:, 1:])).sum(axis=1) * step


CHANNELS: Mapping[str, Channel] = {channel.name: channel for channel in (
    Channel("velocity_y", "lateral velocity", "m/s", 1e-3, zero_means_missing=True),
    Channel("yaw_rate", "yaw rate", "rad/s", 2e-4, smoothed=True),
    Channel("acceleration_y", "lateral acceleration", "m/s^2", 5e-3, smoothed=True),
    Channel("yaw", "heading", "rad", 1e-4, errors=lambda m, predicted: (wrap_angle(m["yaw"] - predicted.yaw),),
            accumulates=True, noise=_heading_noise),
    Channel("position", "position", "m", 1e-3, ("x", "y"), ("position_lateral", "position_longitudinal"),
            errors=lambda m, predicted: map_to_body(m["x"] - predicted.x, m["y"] - predicted.y, m["yaw"])[::-1],
            accumulates=True, noise=_position_noise),
)}
"""Channels by name, the most informative about the car first."""

CHANNEL_OF_COLUMN = {column: channel for channel in CHANNELS.values() for column in channel.columns}
POSITION_5S = "position_5s"
"""Mean position error at the end of the horizon, the main quantity in reports. Name and label assume the default
horizon, 5 s. Without velocity_y the error is after 5.75 s: scoring begins `windows.SIDESLIP_SETTLING_TIME` later."""
UNITS = {POSITION_5S: "m"} | {name: channel.unit for name, channel in CHANNELS.items()}
LABELS = {POSITION_5S: "position after 5 s"} | {name: channel.label for name, channel in CHANNELS.items()}
