"""Frames of the passenger's page: the newest measurement, predictions, error and health as plain numbers.

All positions are of the centre of gravity in the axes of the car at the moment: x forward, y left.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from st_core.frames import cg_to_ins_position, map_to_body
from st_core.types import InsSample
from st_core.vehicle import VehicleParameters
from st_predictor import convert

MODELS = ("kinematic", "linear", "nonlinear", "augmented")
TRACK_SPAN, TRACK_STEP = 20.0, 0.2  # s of measured track shown, and between its points
PATH_STRIDE = 2  # every second point of a prediction is sent
STALE_PREDICTION = 1.0  # s; an older prediction is not shown
DIAGNOSTICS_TIMEOUT = 3.0  # s; every node publishes its diagnostics once a second
BAND_LEVEL = 0.9
LEVELS = ("ok", "warning", "error", "error")  # of diagnostic_msgs; stale counts as an error
# Topic -> method that takes its messages.
INPUTS = {"forecast": "held", "course": "remembered", "plan": "planned"}  # by mode, the preferred last
TOPICS = {
    "predictor/status": "status", "ins/status": "ins_status", "ins/odometry": "odometry",
    "vehicle/steering": "steering",
    **{f"predictor/{model}/prediction": "prediction" for model in MODELS},
    **{f"predictor/{model}/{mode}": mode for mode in convert.OTHER_MODES for model in MODELS},
    "evaluator/errors": "error", "/diagnostics": "diagnostics",
}


class PassengerFrames:
    """Takes messages of a running suite and makes frames for the page. Times in s of one monotonic clock."""

    def __init__(self, car: VehicleParameters, map_frame: str):
        self._car, self._map_frame = car, map_frame
        self._sample: InsSample | None = None
        self._received: float | None = None  # time of the newest odometry
        self._angle: float | None = None
        self._reason = ""
        self._mode: tuple[str, float] = ("", 0.0)
        self._track: deque[tuple[float, float, float]] = deque()  # (measured s, x, y)
        # By mode and model.
        self._predictions: dict[str, dict[str, tuple[float, Any]]] = {mode: {} for mode in INPUTS}
        self._errors: dict[str, dict[str, dict[str, float]]] = {mode: {} for mode in INPUTS}
        self._health: dict[str, tuple[float, int, str]] = {}
        self._takers: dict[str, Callable[[Any, float], None]] = {
            name: getattr(self, f"_{name}") for name in set(TOPICS.values())}

    def take(self, topic: str, message: Any, now: float) -> None:
        """A message of one of TOPICS, received at `now`."""
        self._takers[TOPICS[topic]](message, now)

    def frame(self, now: float) -> dict[str, Any]:
        """JSON-able content of the page. `received`: time of the newest odometry, null before the first."""
        light, text = self._light(now)
        sample, (mode, mode_time) = self._sample, self._mode
        frame: dict[str, Any] = {
            "received": self._received and round(self._received, 4), "light": light, "text": text, "mode": mode,
            "mode_age": round(now - mode_time, 1), "reason": self._reason,
            "errors": {model: error for mode, of_model in self._errors.items() if mode == "forecast" or any(
                now - at < STALE_PREDICTION for at, _ in self._predictions[mode].values())
                for model, error in of_model.items()},
            "steering": self._angle and round(self._angle, 4),
        }
        if sample is None:
            return frame
        pose = (*self._cg_position(sample), sample.yaw)
        track = np.array([point[1:] for point in self._track]).reshape(-1, 2)
        return frame | {
            "pose": [round(value, 3) for value in pose], "speed": round(sample.velocity_x, 2),
            "lateral_acceleration": round(sample.velocity_x * sample.yaw_rate, 2),
            "track": _in_car(track[:, 0], track[:, 1], pose),
            "paths": {model: self._path(message, pose, mode) for mode, of_model in self._predictions.items()
                      for model, (at, message) in of_model.items() if now - at < STALE_PREDICTION},
        }

    def _cg_position(self, sample: InsSample) -> tuple[float, float]:
        x, y = cg_to_ins_position(sample.x, sample.y, sample.yaw, -self._car.cg_to_ins_x, -self._car.cg_to_ins_y)
        return float(x), float(y)

    def _path(self, message: Any, pose: tuple[float, float, float], mode: str) -> dict[str, Any]:
        x, y, yaw = (np.asarray(column)[::PATH_STRIDE] for column in (message.x, message.y, message.yaw))
        path: dict[str, Any] = {"points": _in_car(x, y, pose), "step": PATH_STRIDE * message.step,
                                "inputs": INPUTS[mode], "yaw": np.round(yaw - pose[2], 3).tolist()}
        # All bands of a start are in its forecast.
        _, forecast = self._predictions["forecast"].get(message.model, (0.0, None))
        bands = forecast.bands if forecast and forecast.header.stamp == message.header.stamp else ()
        band = next((b for b in bands if b.mode == mode and abs(b.level - BAND_LEVEL) < 1e-6), None)
        if band is not None:
            path["band"] = np.round(np.asarray(band.across, float)[::PATH_STRIDE], 2).tolist()
        return path

    def _light(self, now: float) -> tuple[str, str]:
        """(level, text) of the worst check; "none" without diagnostics."""
        current = [(level, f"{name}: {text}") for name, (at, level, text) in self._health.items()
                   if now - at < DIAGNOSTICS_TIMEOUT]
        if not current:
            return "none", "no diagnostics"
        level, text = max(current)
        if level == 0:
            return "ok", "all checks OK"
        others = sum(other > 0 for other, _ in current) - 1
        return LEVELS[min(level, 3)], text + (f", and {others} more" if others else "")

    def _odometry(self, message: Any, now: float) -> None:
        sample = convert.ins_sample(message, self._map_frame)
        if isinstance(sample, str):
            return
        measured = sample.time_ns * 1e-9
        if self._track and measured < self._track[-1][0]:  # a replay that starts over
            self._track.clear()
            for errors in self._errors.values():
                errors.clear()
        self._sample, self._received = sample, now
        if not self._track or measured - self._track[-1][0] >= TRACK_STEP:
            self._track.append((measured, *self._cg_position(sample)))
            while measured - self._track[0][0] > TRACK_SPAN:
                self._track.popleft()

    def _ins_status(self, message: Any, now: float) -> None:
        self._mode = message.position_mode_text, now

    def _steering(self, message: Any, now: float) -> None:
        self._angle = message.road_wheel_angle if math.isfinite(message.road_wheel_angle) else None

    def _status(self, message: Any, now: float) -> None:
        self._reason = message.reason

    def _prediction(self, message: Any, now: float, mode: str = "forecast") -> None:
        columns = np.array([message.x, message.y, message.yaw])
        if columns.shape[1] > 1 and np.isfinite(columns).all():
            self._predictions[mode][message.model] = now, message

    def _plan(self, message: Any, now: float) -> None:
        self._prediction(message, now, "plan")

    def _course(self, message: Any, now: float) -> None:
        self._prediction(message, now, "course")

    def _error(self, message: Any, now: float) -> None:
        """Errors [m] at the end of the horizon [s] that has just passed."""
        if message.complete and message.mode in INPUTS:
            self._errors[message.mode][message.model] = {
                "longitudinal": round(message.longitudinal[-1], 2), "lateral": round(message.lateral[-1], 2),
                "horizon": round(message.horizon[-1], 2)}

    def _diagnostics(self, message: Any, now: float) -> None:
        for status in message.status:
            level = status.level if isinstance(status.level, int) else int.from_bytes(status.level, "little")
            self._health[status.name] = now, level, status.message


def _in_car(x: np.ndarray, y: np.ndarray, pose: tuple[float, float, float]) -> list[list[float]]:
    """[[forward, left], ...] in m of map points, seen from a car at pose (x, y [m], yaw [rad])."""
    forward, left = map_to_body(x - pose[0], y - pose[1], pose[2])
    return np.round(np.stack([forward, left], axis=1), 2).tolist()
