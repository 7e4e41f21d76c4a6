"""Errors of single predictions over a drive, channel by channel, with the conditions they were made under."""

from collections.abc import Sequence

import numpy as np

from ..batch import LogBatch
from ..filtering import NANOSECOND
from ..log import DriveLog
from ..log_evaluation import regular_starts, usable_starts
from ..log_signals import LogSignals
from ..models import Model
from ..readings import readings
from ..vehicle import VehicleParameters
from .settings import DiscoverySettings
from .where_bins import Samples

STEP = 0.05  # s, of the integration
SHORT = 1.0  # s; errors of velocity, rate and acceleration over this much say where they arise
FILTER_CUTOFF, MAXIMUM_GAP, MINIMUM_SPEED = 5.0, 0.1, 2.0  # Hz, s, m/s


def sample(runs: Sequence[DriveLog], model: Model, vehicle: VehicleParameters, settings: DiscoverySettings) -> Samples:
    """All predictions of all runs, one every `settings.interval`, over `settings.horizon`.

    Lateral velocity, yaw rate and lateral acceleration: mean square over the first second. Yaw and position: square at
    the end of the horizon.
    """
    parts = [_of_run(number, log, model, vehicle, settings) for number, log in enumerate(runs)]
    kept = [p for p in parts if len(p["time"])]
    channels = [c for c in settings.channels if kept and all(c in p["squares"] for p in kept)]

    def joined(key: str) -> np.ndarray:
        return np.concatenate([p[key] for p in kept]) if kept else np.empty(0)

    names = kept[0]["conditions"] if kept else ()
    conditions = {n: np.concatenate([p["conditions"][n] for p in kept]) for n in names}
    squares = {c: np.concatenate([p["squares"][c] for p in kept]) for c in channels}
    return Samples(tuple(log.name for log in runs), joined("run").astype(int), joined("time"), joined("x"), joined("y"),
                   joined("block").astype(np.int64), conditions, squares)


def _of_run(number: int, log: DriveLog, model: Model, vehicle: VehicleParameters, settings: DiscoverySettings) -> dict:
    signals = LogSignals(log, MAXIMUM_GAP, FILTER_CUTOFF, "zero_phase")
    starts, _ = usable_starts(signals, vehicle, regular_starts(log, settings.interval), MINIMUM_SPEED)
    batch = LogBatch(signals, starts, settings.horizon, STEP)
    half = np.round(batch.points * (STEP / NANOSECOND)).astype(np.int64)
    times = starts[:, None] + half
    speed, yaw_rate, acceleration = signals.ins_at(times, "velocity_x", "yaw_rate", "velocity_x_dot")
    angle = signals.road_wheel_angle_at(times)
    errors = channel_errors(batch, model, vehicle, times)
    short = batch.time <= SHORT + 1e-9
    complete = np.isfinite(angle).all(axis=1) & np.isfinite(acceleration).all(axis=1)
    conditions = {
        "speed": speed.mean(axis=1), "lateral_acceleration": (speed * yaw_rate)[:, short].mean(axis=1),
        "steering_angle": angle[:, short].mean(axis=1),
        "steering_rate": np.sqrt(np.square(np.diff(angle[:, short], axis=1) / STEP).mean(axis=1)),
        "forward_acceleration": acceleration[:, short].mean(axis=1),
    }
    squares = {}
    for channel in settings.channels:
        if channel in errors:
            e = errors[channel]
            squares[channel] = (np.square(e[:, -1]) if channel in ("yaw", "position")
                                else np.square(e[:, short][:, 1:]).mean(axis=1))
            complete &= np.isfinite(squares[channel])
    x, y = signals.ins_at(starts, "x", "y")
    time = (starts - log.ins_time_ns[0]) * NANOSECOND if len(starts) else np.empty(0)
    block = number * 1_000_000 + np.floor(time / settings.block)
    rows = {"run": np.full(len(starts), number), "time": time, "x": x, "y": y, "block": block}
    return {**{key: values[complete] for key, values in rows.items()},
            "conditions": {key: values[complete] for key, values in conditions.items()},
            "squares": {key: values[complete] for key, values in squares.items()}}


def channel_errors(batch: LogBatch, model: Model, vehicle: VehicleParameters, times_ns: np.ndarray) -> dict:
    """Predicted minus measured at the INS point, (n, points) by channel. position: distance [m], never negative."""
    prediction = batch.predict(model, vehicle)
    with np.errstate(all="ignore"):
        seen = readings(prediction.model, vehicle, tuple(np.moveaxis(prediction.states, -1, 0)))
    velocity_y, yaw_rate = batch.signals.ins_at(times_ns, "velocity_y", "yaw_rate")
    errors = batch.errors(prediction)
    found = {"velocity_y": seen.velocity_y - velocity_y, "yaw_rate": seen.yaw_rate - yaw_rate,
             "yaw": errors[..., 2], "position": np.hypot(errors[..., 0], errors[..., 1])}
    return found
