"""Writes the files of a case: drives as CSV with sensor errors, the owner's car folder, and the true answers."""

import json
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from scipy.signal import lfilter
from st_core.integrate import required_slip_speed
from st_core.prediction import PredictionSettings
from st_recordings.car import STABILITY_SPEEDS, read_vehicle
from st_recordings.car_skeleton import write_skeleton

from . import multibody, simulation
from .cases import Case, file_car, true_car
from .roads import road
from .simulation import STEP, VX_DOT, VY_DOT, WHEEL
from .truth import find_truth
from .vehicles import MULTI_BODY, Car

FORMATS = {"t": "%.4f", "x": "%.4f", "y": "%.4f", "yaw": "%.5f", "velocity_x": "%.4f", "velocity_y": "%.4f",
           "yaw_rate": "%.5f", "acceleration_x": "%.4f", "acceleration_y": "%.4f", "steering_wheel_angle": "%.5f"}
HELD_OUT = ("hills", "country")
"""Roads of the drives that are not given to `st discover`."""
TREMOR = 0.002  # rad at the road wheels
NOISE = {"position": (0.003, 0.008), "yaw": (2e-4, 1e-3), "velocity": (0.01, 0.01), "yaw_rate": (5e-4, 5e-5),
         "acceleration": (0.05, 0.01), "steering": (5e-4, 0.0)}
"""Standard deviations of white and of slow noise [m, rad, m/s, rad/s, m/s^2, rad at the steering wheel]."""
SLOW_TIME = 40.0  # s, time constant of the slow noise


def write_case(case: Case, folder: Path, shorten: float = 1.0) -> dict:
    """Writes `drives/`, `held_out/`, `car/` and truth.json to a new folder; returns the content of truth.json.

    shorten: factor on the duration of the drives.
    """
    home = folder / "car"
    _write_car(case, home)
    vehicle = read_vehicle(home / "vehicle.yaml")
    rows = dict(_drive_case(case, shorten))
    for name, one in rows.items():
        path = folder / ("held_out" if name.startswith("held_out") else "drives") / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng([case.seed, 2, len(list(path.parent.iterdir())), path.parent.name == "drives"])
        _write_csv(path, measure(true_car(case), one, case.sensors, rng))
    truth = find_truth(case, [one for name, one in rows.items() if not name.startswith("held_out")], vehicle)
    truth = {"case": case.name, **truth, "noise": {key: list(value) for key, value in NOISE.items()}}
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return truth


def _drive_case(case: Case, shorten: float) -> Iterator[tuple[str, np.ndarray]]:
    """Yields name and rows of every drive of the true car."""
    car = true_car(case)
    comfort = float(np.mean([one[1] for one in case.drives]))
    planned = [(name, name, c, s) for name, c, s in case.drives]
    planned += [(f"held_out_{name}", name, comfort, 70.0) for name in HELD_OUT]
    for number, (name, road_name, accepted, seconds) in enumerate(planned):
        rng = np.random.default_rng([case.seed, 1, number])
        # Drives in which a multi-body car nearly stops are rejected.
        line = road(road_name, rng, accepted, stops=car.equations != MULTI_BODY)
        count = int(seconds * shorten / simulation.STEP)
        wander = np.convolve(rng.standard_normal(count), np.full(160, 1 / 12.6), "same") * TREMOR
        if car.equations == MULTI_BODY:
            yield name, multibody.drive(car, line, seconds * shorten, wander, case.seed + number)
        else:
            yield name, simulation.drive(car.equations, line, car.parameters, seconds * shorten, wander)


def _write_car(case: Case, home: Path) -> None:
    write_skeleton(home)
    for unused in ("can.dbc", "signals.yaml", "rt.dbc"):  # all recordings are CSV
        (home / unused).unlink()
    file = home / "vehicle.yaml"
    lines = [_fill_in(line, case) for line in file.read_text().splitlines()]
    file.write_text("\n".join(lines) + "\n")
    vehicle = read_vehicle(file)
    needed = required_slip_speed(("linear", "nonlinear"), vehicle, STABILITY_SPEEDS, PredictionSettings().step)
    if needed and needed > vehicle.minimum_slip_speed:
        raised = np.ceil(10 * needed) / 10
        file.write_text("\n".join(_edit_row(line, value=raised) if line.startswith("minimum_slip_speed:") else line
                                  for line in lines) + "\n")


def _fill_in(line: str, case: Case) -> str:
    """A row of the vehicle file, with the value that the owner measured or guessed."""
    car, key = file_car(case), line.partition(":")[0]
    n, shift = car.parameters, case.hidden.get("cg", 0.0)
    known = {"mass": round(n.mass * (1 + case.hidden.get("mass", 0.0))), "wheelbase": round(n.wheelbase, 3),
             "cg_to_front_axle": round(n.front + shift, 3), "cg_to_ins_x": car.ins + shift,
             "steering_ratio": round(car.ratio * (1 + case.hidden.get("ratio", 0.0)), 3),
             "drive_front": n.drive_front, **case.guess}
    if key == "name":
        return f"name: {car.name}"
    if key not in known:
        return line
    return _edit_row(line, value=float(known[key]), source='"guess"' if key in case.guess else '"measured"',
                     uncertainty=case.uncertainty.get(key))


def _edit_row(line: str, value: float, source: str | None = None, uncertainty: float | None = None) -> str:
    """A row of a vehicle file with another value, source and uncertainty."""
    line = re.sub(r"value: [^,]+,", f"value: {value!r},".replace("np.float64(", "").replace(")", ""), line, count=1)
    line = re.sub(r", uncertainty: [^,}]+", "", line)
    if source is not None:
        line = re.sub(r'source: (FILL_IN|"[^"]*")', f"source: {source}", line)
    return line if uncertainty is None else re.sub(r"\}\s*$", f", uncertainty: {float(uncertainty):.6g}}}", line)


def _write_csv(path: Path, channels: dict[str, np.ndarray]) -> None:
    columns = [[form % value if np.isfinite(value) else "" for value in channels[name].tolist()]
               for name, form in FORMATS.items()]
    path.write_text("\n".join([",".join(FORMATS), *(",".join(row) for row in zip(*columns, strict=True))]) + "\n")


def measure(car: Car, rows: np.ndarray, hidden: Mapping[str, float],
            rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Channels [SI] at the rate of the INS; the steering wheel angle is NaN in rows without a steering sample.

    hidden: heading [rad], lever [m], delay of the steering [s], offset of the steering wheel [rad], yaw_rate_scale [1],
    yaw_rate_bias [rad/s].
    """
    every = round(1 / STEP / car.ins_rate)
    q = rows[::every]
    n, rate = len(q), car.ins_rate
    t = np.arange(n) / rate
    skew, arm = hidden.get("heading", 0.0), car.ins + hidden.get("lever", 0.0)
    leaning = -car.ins_height * q[:, 6]  # of the body, moves the INS to the left
    vx, vy, yaw, r = q[:, 3], q[:, 4] + arm * q[:, 5] + np.gradient(leaning, t), q[:, 2], q[:, 5]
    ax, ay = q[:, VX_DOT] - r * q[:, 4] - arm * r * r, q[:, VY_DOT] + r * vx
    ay += np.gradient(arm * r + np.gradient(leaning, t), t)

    def noise(kind: str) -> np.ndarray:
        white, slow = NOISE[kind]
        memory = math.exp(-1 / (rate * SLOW_TIME))
        kicks = slow * math.sqrt(1 - memory * memory) * rng.standard_normal(n)
        drift = lfilter([1.0], [1.0, -memory], kicks, zi=[memory * slow * rng.standard_normal()])[0]
        return white * rng.standard_normal(n) + drift

    c, s = math.cos(skew), math.sin(skew)
    steering = rows[:, WHEEL] * car.ratio
    late = round(hidden.get("delay", 0.0) / STEP)
    steering = np.concatenate([np.full(late, steering[0]), steering[:len(steering) - late]])[::every]
    steering = steering + noise("steering") + hidden.get("offset", 0.0)
    resolution = math.radians(car.steering_step)
    steering = np.round(steering / resolution) * resolution
    steering[np.arange(n) % max(1, rate // car.steering_rate) != 0] = np.nan
    return {
        "t": t, "x": q[:, 0] + arm * np.cos(yaw) - leaning * np.sin(yaw) + noise("position"),
        "y": q[:, 1] + arm * np.sin(yaw) + leaning * np.cos(yaw) + noise("position"), "yaw": yaw + skew + noise("yaw"),
        "velocity_x": c * vx + s * vy + noise("velocity"), "velocity_y": c * vy - s * vx + noise("velocity"),
        "yaw_rate": r * hidden.get("yaw_rate_scale", 1.0) + hidden.get("yaw_rate_bias", 0.0) + noise("yaw_rate"),
        "acceleration_x": c * ax + s * ay + noise("acceleration"),
        "acceleration_y": c * ay - s * ax + noise("acceleration"), "steering_wheel_angle": steering}
