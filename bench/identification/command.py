"""Identification from driving: bias and coverage for 50 noise seeds, held-out real drives, procedure of the paper."""

import time
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from st_core.augmented import augment
from st_core.identification.axle_forces import AXLES, identify_stiffness
from st_core.identification.driving_prediction import (
    STIFFNESSES,
    fit_stiffness,
    identify_steering,
    identify_yaw_inertia,
)
from st_core.identification.ins_mounting import identify_ins_mounting
from st_core.identification.result import Identification
from st_core.identification.steering import identify_steering_offset
from st_core.models import nonlinear_tyre
from st_core.vehicle import VehicleParameters
from st_sim.settings import REALISTIC

from .._drives import leaf
from .drives import LEVER_ERROR, MISALIGNMENT, TIGHT_BENDS, record, record_all, with_stiffness
from .genesis import identify_genesis
from .paper_procedure import run_procedure

SEEDS = range(400, 450)  # not used in the development of the estimators
NO_NOISE = ("ins_noise=0", "steering_sensor_noise=0")
KNOWN_EFFECTS = {"steered_drive_force": {"share": 1.0}}  # added to the model, because the plant has it


def run() -> dict:
    """Runs all parts, which takes about ten minutes."""
    return {"seeds": score_seeds(), "noise-free": score_noise_free(), "realistic car": score_realistic(),
            "speed": measure_speed(), "genesis": identify_genesis(), "chain": run_procedure()}


def make_wrong_file(car: VehicleParameters) -> VehicleParameters:
    """The vehicle file from which an identification starts, with wrong values."""
    other = replace(car, steering_wheel_offset=0.0, yaw_inertia=0.8 * car.yaw_inertia, cg_to_ins_x=-0.3)
    return with_stiffness(other, 0.8 * car.cornering_stiffness_front, 1.25 * car.cornering_stiffness_rear)


def identify_seed(seed: int, car: VehicleParameters) -> dict[str, tuple[Identification, dict[str, float]]]:
    """Method -> result and true values, for drives with one noise seed."""
    logs = record_all("ideal", seed)
    start = make_wrong_file(car)
    offset = identify_steering_offset(logs["straight"], start)
    # The next steps use the estimated offset, as for a real car.
    start = replace(start, steering_wheel_offset=offset["steering_wheel_offset"].value)
    known_ins = replace(start, cg_to_ins_x=car.cg_to_ins_x)
    stiffness = {name: getattr(car, name) for name in STIFFNESSES}
    steering = {"steering_ratio": car.steering_ratio, "steering_wheel_offset": car.steering_wheel_offset}
    known = augment("nonlinear", KNOWN_EFFECTS)
    known_inertia = replace(known_ins, yaw_inertia=car.yaw_inertia)
    paper = identify_stiffness(logs["bends"], known_inertia)
    return {
        "offset": (offset, {"steering_wheel_offset": car.steering_wheel_offset,
                            "steering_wheel_offset_direct": car.steering_wheel_offset}),
        "paper": (paper, stiffness),
        "paper, against the curve over the slip range": (paper, fit_curve_slopes(paper, car)),
        "prediction": (fit_stiffness(logs["bends"], known_inertia, known), stiffness),
        "ins": (identify_ins_mounting(logs["slow"], start),
                {"cg_to_ins_x": car.cg_to_ins_x + LEVER_ERROR, "ins_misalignment": MISALIGNMENT, "cg_to_ins_y": 0.0}),
        "steering": (identify_steering(logs["bends"], replace(known_inertia, steering_ratio=19.0), known),
                     steering),
        "yaw inertia": (identify_yaw_inertia(logs["transient"], known_ins, known),
                        {"yaw_inertia": car.yaw_inertia})}


def fit_curve_slopes(identification: Identification, car: VehicleParameters) -> dict[str, float]:
    """Slopes [N/rad] of the regression with true instead of measured tyre forces, at the same slip angles."""
    p = nonlinear_tyre.parameters(car)
    w = nonlinear_tyre.inputs(0.0, 0.0, p)
    result = {}
    for number, (name, axle) in enumerate(zip(STIFFNESSES, AXLES, strict=True)):
        slip = identification.figure[f"slip_{axle}"]
        result[name] = -float(np.polyfit(slip, nonlinear_tyre.axle_forces(slip, slip, w, p)[number], 1)[0])
    return result


def score_seeds(numbers: Iterable[int] = SEEDS) -> dict:
    """Coverage of the 95 % intervals over the seeds, errors, and mean standard uncertainty of the estimates."""
    car = leaf()
    rows: dict[tuple[str, str], list] = {}
    for seed in numbers:
        for method, (outcome, truth) in identify_seed(seed, car).items():
            for name, value in truth.items():
                rows.setdefault((method, name), []).append((outcome[name], value))
    return {f"{method}: {name}": _summary(estimates) for (method, name), estimates in rows.items()}


def _summary(rows: list) -> dict:
    """Bias, spread, stated uncertainty and coverage of (estimate, true value) pairs."""
    truth = float(np.mean([t for _, t in rows]))
    errors = np.array([e.value - t for e, t in rows])
    covered = np.mean([e.interval95[0] <= t <= e.interval95[1] for e, t in rows])
    stated = np.mean([e.standard_uncertainty for e, _ in rows])
    unit, factor = ("deg", np.rad2deg(1.0)) if rows[0][0].unit == "rad" else (
        ("%", 100.0 / truth) if rows[0][0].unit != "m" else ("m", 1.0))
    return {"truth": truth, "seeds": len(rows), "within": float(covered),
            f"mean error, {unit}": float(errors.mean() * factor),
            f"largest error, {unit}": float(np.abs(errors).max() * factor),
            f"spread, {unit}": float(errors.std() * factor), f"stated, {unit}": float(stated * factor)}


def score_noise_free() -> dict:
    """Stiffness errors [%] without noise, because the model is single-track and the plant double-track."""
    car = leaf()
    return {"radii 40 to 100 m": _stiffness_errors(record_all("ideal", 0, NO_NOISE)["bends"], car, car),
            "radii 19 to 24 m": _stiffness_errors(record(TIGHT_BENDS, "ideal", 0, sensors=NO_NOISE), car, car)}


def _stiffness_errors(logs: list, start: VehicleParameters, car: VehicleParameters) -> dict:
    methods: dict[str, Callable[[], Identification]] = {
        "paper": lambda: identify_stiffness(logs, start),
        "prediction, linear": lambda: fit_stiffness(logs, start, "linear"),
        "prediction": lambda: fit_stiffness(logs, start),
        "prediction, drive force": lambda: fit_stiffness(logs, start, augment("nonlinear", KNOWN_EFFECTS)),
    }
    return {name: {axle: 100.0 * (result[key].value / getattr(car, key) - 1.0)
                   for axle, key in zip(("front, %", "rear, %"), STIFFNESSES, strict=True)}
            for name, result in ((name, method()) for name, method in methods.items())}


def score_realistic() -> dict:
    """Errors for the realistic car: stiffnesses [%] relative to the small-slip stiffness of its tyres at static load
    and to the vehicle file, and the other quantities."""
    car = leaf()
    logs = record_all("realistic", 0)
    true = with_stiffness(car, REALISTIC["front_stiffness_factor"] * car.cornering_stiffness_front,
                          REALISTIC["rear_stiffness_factor"] * car.cornering_stiffness_rear)
    offset = identify_steering_offset(logs["straight"], car)
    inertia = identify_yaw_inertia(logs["transient"], car)
    ins = identify_ins_mounting(logs["slow"], car)
    return {"stiffness against the tyres": _stiffness_errors(logs["bends"], car, true),
            "stiffness against the file": _stiffness_errors(logs["bends"], car, car),
            "offset error, deg": float(np.rad2deg(offset.estimates[0].value - car.steering_wheel_offset)),
            "offset error of the direct estimate, deg": float(
                np.rad2deg(offset.estimates[1].value - car.steering_wheel_offset)),
            "yaw inertia": _row(inertia["yaw_inertia"]), "steering_delay": _row(inertia["steering_delay"]),
            "ins": {e.parameter: _row(e) for e in ins.estimates}}


def _row(estimate) -> str:
    return f"{estimate.value:.5g} +/- {estimate.standard_uncertainty:.2g} {estimate.unit} ({estimate.status})"


def measure_speed() -> dict:
    """Processor and wall time [s] of the identification of stiffness from 10 runs of 60 s, after warm-up."""
    car = leaf()
    logs = record_all("ideal", 1)["bends"]
    start = replace(make_wrong_file(car), steering_wheel_offset=car.steering_wheel_offset, cg_to_ins_x=car.cg_to_ins_x)
    result = {}
    for name, call in (("regression (paper)", lambda: identify_stiffness(logs, start)),
                       ("prediction", lambda: fit_stiffness(logs, start))):
        call()
        cpu, wall = time.process_time(), time.perf_counter()
        call()
        result[name] = {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
    return result
