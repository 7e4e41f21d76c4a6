"""Errors of single predictions over the drives, channel by channel, with the conditions they were made under."""

from collections.abc import Sequence

import numpy as np

from ..augmented import AugmentedModel
from ..channels import OF_COLUMN
from ..filtering import NANOSECOND
from ..log import DriveLog
from ..log_signals import LogSignals
from ..vehicle import VehicleParameters
from .settings import DiscoverySettings
from .where_bins import Samples
from .windows import STEP, Errors, Windows

SHORT = 1.0  # s; errors of velocity, rate and acceleration over this much say where they arise


def sample(runs: Sequence[DriveLog], model: AugmentedModel, vehicle: VehicleParameters, settings: DiscoverySettings,
           gain: float = 0.0) -> Samples:
    """All windows of the runs, see `windows.Windows`.

    Mean square over the first second; of a channel whose errors add up, square at the end of the horizon.
    """
    windows = Windows(runs, vehicle, settings)
    errors = windows.errors(model, gain)
    squares = _squares(errors)
    rows = [_of_run(log, windows.seconds[windows.run == number], float(errors.time[-1]))
            for number, log in enumerate(runs)]
    place = {name: np.concatenate([r[name] for r in rows]) for name in rows[0]}
    known = np.isfinite(np.stack([*squares.values(), *place.values()])).all(axis=0)
    x, y, time = (place.pop(name)[known] for name in ("x", "y", "time"))
    return Samples(windows.names, windows.run[known], time, x, y, windows.block[known],
                   {name: values[known] for name, values in place.items()},
                   {channel: values[known] for channel, values in squares.items()})


def _squares(errors: Errors) -> dict[str, np.ndarray]:
    short = errors.time <= max(SHORT, float(errors.time[0]))
    found: dict[str, np.ndarray] = {}
    for index, column in enumerate(errors.columns):
        channel, square = OF_COLUMN[column], np.square(errors.values[..., index])
        value = square[:, -1] if channel.adds_up else square[:, short].mean(axis=1)
        found[channel.name] = found.get(channel.name, 0.0) + value
    return found


def _of_run(log: DriveLog, seconds: np.ndarray, horizon: float) -> dict[str, np.ndarray]:
    """Place and conditions of the windows of one run, seconds after INS and steering have both begun."""
    signals = LogSignals(log, 0.1, 5.0, "zero_phase")
    begin = max((int(t[0]) for t in (log.ins_time_ns, log.steering_time_ns) if len(t)), default=0)
    starts = begin + np.round(seconds / NANOSECOND).astype(np.int64)
    after = np.round(np.arange(0.0, min(SHORT, horizon) + STEP / 2, STEP) / NANOSECOND).astype(np.int64)
    times = starts[:, None] + after
    x, y = signals.ins_at(starts, "x", "y")
    speed, yaw_rate, acceleration = signals.ins_at(times, "velocity_x", "yaw_rate", "velocity_x_dot")
    angle = signals.road_wheel_angle_at(times)
    first = int(log.ins_time_ns[0]) if len(log.ins_time_ns) else begin
    return {
        "x": x, "y": y, "time": (starts - first) * NANOSECOND, "speed": speed.mean(axis=1),
        "lateral_acceleration": (speed * yaw_rate).mean(axis=1), "steering_angle": angle.mean(axis=1),
        "steering_rate": np.sqrt(np.square(np.diff(angle, axis=1) / STEP).mean(axis=1)),
        "forward_acceleration": acceleration.mean(axis=1),
    }
