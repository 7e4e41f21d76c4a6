"""What is hidden in the recordings, what a right answer may say, and the files a user would have."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from st_core.tyres import magic_formula_peak
from st_recordings.car import car_named, read_vehicle
from st_recordings.car_skeleton import write_skeleton

from .cars import CARS, GRAVITY, Stranger, drives, sensed, side_force

LEAF = read_vehicle(car_named("leaf").vehicle)
LOAD_AHEAD = 0.3  # m of the rear axle, where the load lies
FORMATS = {"t": "%.4f", "x": "%.4f", "y": "%.4f", "yaw": "%.5f", "velocity_x": "%.4f", "velocity_y": "%.4f",
           "yaw_rate": "%.5f", "acceleration_x": "%.4f", "acceleration_y": "%.4f", "steering_wheel_angle": "%.5f"}


@dataclass(frozen=True)
class Case:
    """car: of CARS. words: what is hidden.

    hidden: SI. ratio: of the file over the true one; worn: what is left of the front stiffness; load: kg at the rear;
    the others are errors of sensors as `sensed` makes them.
    """

    car: str
    words: str
    hidden: dict = field(default_factory=dict)


def _degrees(**hidden: float) -> dict:
    return {name: math.radians(value) for name, value in hidden.items()}


CASES = {
    "saloon_healthy": Case("saloon", "nothing"),
    "saloon_ratio": Case("saloon", "steering ratio of the file 8 % too large", {"ratio": 1.08}),
    "saloon_worn": Case("saloon", "front tyres 15 % softer", {"worn": 0.85}),
    "saloon_heading": Case("saloon", "heading 0.7° to the left", _degrees(heading=0.7)),
    "light_ev_healthy": Case("light_ev", "nothing"),
    "light_ev_offset": Case("light_ev", "steering wheel reads 1.5° too far left", _degrees(offset=1.5)),
    "light_ev_lever_delay": Case(
        "light_ev", "INS 0.4 m further back, steering 0.1 s late", {"lever": -0.4, "delay": 0.1}),
    "light_ev_gyro": Case("light_ev", "yaw rate 2 % too large", {"yaw_rate_scale": 1.02}),
    "van_healthy": Case("van", "nothing"),
    "van_load": Case("van", "250 kg at the rear", {"load": 250.0}),
    "van_heading_offset": Case(
        "van", "heading 0.7°, steering wheel 1.5° to the left", _degrees(heading=0.7, offset=1.5)),
}


def true_car(case: Case) -> Stranger:
    """The car that drives; the file describes CARS[case.car]."""
    car, load = CARS[case.car], case.hidden.get("load", 0.0)
    arm = car.wheelbase - LOAD_AHEAD - car.front  # of the load, behind the empty car's CG
    back = load * arm / (car.mass + load)
    return replace(car, stiffness_front=car.stiffness_front * case.hidden.get("worn", 1.0), mass=car.mass + load,
                   front=car.front + back, ins=car.ins + back,
                   inertia=car.inertia + car.mass * back**2 + load * (arm - back) ** 2)


def truths(case: Case, compliance: bool) -> dict[str, float]:
    """Value of each effect that is in this car beside its file. compliance: whether the answer has it as well."""
    hidden, car, file = case.hidden, true_car(case), CARS[case.car]
    softened = 1.0 if compliance else 1.0 + car.stiffness_front * car.compliance
    found = {
        "front_stiffness": car.stiffness_front / softened / file.guess["cornering_stiffness_front"],
        "rear_stiffness": car.stiffness_rear / file.guess["cornering_stiffness_rear"],
        "yaw_inertia": car.inertia / file.guess["yaw_inertia"], "steering_compliance": car.compliance,
        "tyre_relaxation": car.relaxation, "steering_lag": car.steer_lag,
        "steering_ratio": 1.0 / hidden.get("ratio", 1.0), "heading_misalignment": hidden.get("heading", 0.0),
        "steering_offset": -hidden.get("offset", 0.0) / car.ratio, "sensor_lever_arm": hidden.get("lever", 0.0),
        "steering_delay": -hidden.get("delay", 0.0), "yaw_rate_scale": hidden.get("yaw_rate_scale", 1.0),
        "mass": car.mass / file.mass, "cg_position": file.front - car.front,
        # The skeleton of a vehicle file has the tyres and the height of the Leaf.
        "friction": _friction(car), "longitudinal_load_transfer": car.height - LEAF.cg_height}
    return {name: value for name, value in found.items() if value not in (0.0, 1.0)}


def _friction(car: Stranger) -> float:
    """Largest side force of the tyres over that of the file's, mean of the axles."""
    found = []
    for stiffness, lever, tyre in ((car.stiffness_front, car.wheelbase - car.front, LEAF.tyre_front),
                                   (car.stiffness_rear, car.front, LEAF.tyre_rear)):
        load = 0.5 * car.mass * GRAVITY * lever / car.wheelbase
        slips = np.linspace(0.01, 0.5, 100)
        most = max(abs(side_force(car.tyre, slip, 0.5 * stiffness, load, 0.0, car.grip)) for slip in slips)
        found.append(most / magic_formula_peak(load, tyre))
    return float(np.mean(found))


def write(name: str, seconds: float, folder: Path, seed: int = 1) -> tuple[Path, Path]:
    """The recordings, CSV, and the folder of the car."""
    case = CASES[name]
    runs, home = folder / "drives", folder / "car"
    write_skeleton(home)
    for unused in ("can.dbc", "signals.yaml", "rt.dbc"):  # all recordings are CSV
        (home / unused).unlink()
    file, text = home / "vehicle.yaml", (home / "vehicle.yaml").read_text()
    file.write_text("\n".join(_filled(line, case) for line in text.splitlines()) + "\n")
    runs.mkdir()
    car = true_car(case)
    for number, (road, truth) in enumerate(drives(car, seconds, seed).items()):
        _csv(runs / f"{road}.csv", sensed(car, truth, case.hidden, 100 * seed + number))
    return runs, home


def _filled(line: str, case: Case) -> str:
    """Measured with tape, scales and turntables, or guessed; the slip speed as `st car check` asks."""
    car, key = CARS[case.car], line.partition(":")[0]
    known = {"mass": car.mass, "wheelbase": car.wheelbase, "cg_to_front_axle": car.front, "cg_to_ins_x": car.ins,
             "steering_ratio": car.ratio * case.hidden.get("ratio", 1.0), "drive_front": car.drive_front, **car.guess}
    if key == "name":
        return f"name: {car.name}"
    if key == "minimum_slip_speed":
        return line.replace("3.0", "3.6")
    source = '"guess"' if key in car.guess else '"measured"'
    return line.replace("value: FILL_IN", f"value: {known.get(key)}").replace("source: FILL_IN", f"source: {source}")


def _csv(path: Path, channels: dict[str, np.ndarray]) -> None:
    rows = [",".join(channels)]
    columns = [[form % value if np.isfinite(value) else "" for value in channels[name]]
               for name, form in FORMATS.items()]
    rows += [",".join(row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join(rows) + "\n")
