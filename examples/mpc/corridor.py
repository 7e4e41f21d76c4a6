"""Tightens a constraint of a controller by a calibrated band: cars that differ from its model pass through gates.

    ./st shell -- python examples/mpc/corridor.py              50 seeds, with and without tightening
    ./st shell -- python examples/mpc/corridor.py --seeds 5

The reference path is straight, with three gates. The controller deviates from it no more than the gates require, so the
car passes close to their posts, at 10 m/s. Each seed is another car with random mass, tyres, friction and steering
(DEVIATIONS). Bands of the controller's model over its horizon are calibrated on drives of other random cars through
other gates. With tightening, the controller keeps the lateral half-width of the band at each point of its horizon as a
distance from every post. A variant limits this distance to its value NEAR seconds ahead, because later decisions
correct the errors beyond it. Writes corridor.json; docs/manual/mpc.md explains the result.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import casadi
import numpy as np
from closed_loop import SAMPLING_TIME, ReferencePath
from controlled_car import ControlledCar
from controller import Controller, Tuning
from st_core.bands import (
    Band,
    CalibrationDomain,
    calibrate,
    compute_conditions,
    compute_error_samples,
    steering_activity,
)
from st_core.log import DriveLog
from st_core.log_evaluation import EvaluationSettings
from st_core.models import get_model
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters
from st_offline.model_export import make_half_width_function
from st_recordings.paths import config, new_folder
from st_sim.path import straight
from st_sim.scenarios import RoadPlan
from st_sim.settings import REALISTIC, Settings, read_vehicle

SPEED, DURATION, HORIZON = 10.0, 20.0, 2.5  # m/s, s, s
DEVIATIONS = {  # standard deviations of the plant settings; of the offset in rad
    "mass_factor": 0.04, "front_stiffness_factor": 0.08, "rear_stiffness_factor": 0.08, "friction_factor": 0.05,
    "steering_offset": 0.006, "steering_ratio_factor": 0.02}
CALIBRATION_CARS, LEVELS = 32, (0.9, 0.95)  # cars whose drives calibrate the bands; n cars allow levels up to n/(n + 1)
NEAR = 0.5  # s ahead, after five decisions
SETTINGS = EvaluationSettings(PredictionSettings(horizon=HORIZON))
GATE_STARTS = (50.0, 115.0, 180.0)  # m along the path
MIN_VIOLATION = 0.01  # m beyond a post; a smaller depth is not a violation


class Margin(NamedTuple):
    """Distance to keep from every post: the lateral half-width of the band, at most its value `until` [s] ahead.

    half_widths: function that `st export --bands` writes. domain: conditions for which the band is calibrated.
    """

    half_widths: casadi.Function
    domain: CalibrationDomain
    until: float


class Gate(NamedTuple):
    """From begin to end [m along the path], the CG must be at least `clearance` [m] left (side 1) or right (-1)."""

    begin: float
    end: float
    side: int
    clearance: float


class Outcome(NamedTuple):
    """Result of one drive."""

    depth: float  # largest distance beyond a post [m], <= 0 without contact
    error: float  # rms lateral deviation [m]
    cost: float  # mean of q_n n^2 + q_v (v - v_ref)^2 + r_d d_delta^2, as in the controller
    log: DriveLog  # the measurements


def make_gates(generator: np.random.Generator | None = None) -> list[Gate]:
    """Three random gates; without a generator, the gates of the comparison."""
    if generator is None:
        return [Gate(start, start + 6.0, side, 1.2) for start, side in zip(GATE_STARTS, (1, -1, 1), strict=True)]
    starts = np.array(GATE_STARTS) + generator.uniform(-6.0, 6.0, 3)
    return [Gate(start, start + 6.0, int(generator.choice([-1, 1])), generator.uniform(0.5, 1.5)) for start in starts]


def compute_limits(gates: Sequence[Gate], distances: np.ndarray, margin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(lower, upper) limits of the lateral deviation, left > 0, by distance along the path [m]. margin: to posts."""
    low, high = np.full(len(distances), -4.0), np.full(len(distances), 4.0)
    for gate in gates:
        at_gate = (distances >= gate.begin) & (distances <= gate.end)
        if gate.side > 0:
            low[at_gate] = gate.clearance + margin[at_gate]
        else:
            high[at_gate] = -gate.clearance - margin[at_gate]
    return low, high


def plant_settings(seed: int) -> Settings:
    """Random settings of the plant for a seed."""
    generator = np.random.default_rng([21, seed])
    values = dict(REALISTIC)
    for name, deviation in DEVIATIONS.items():
        values[name] += deviation * float(np.clip(generator.standard_normal(), -2.5, 2.5))
    return values


def drive(controller: Controller, vehicle: VehicleParameters, gates: Sequence[Gate], seed: int,
          tightening: Margin | None = None) -> Outcome:
    """Drive the car of a seed through the gates. tightening: None for constraints without a margin."""
    controller.reset()
    plan = RoadPlan(straight(400.0, SPEED))
    path, plant = ReferencePath(plan), ControlledCar(vehicle, plant_settings(seed), seed)
    step = controller.tuning.step
    plant.place(0.0, 0.0, 0.0, SPEED)
    rows, angles, depth, acceleration = [], [0.0] * 12, -np.inf, 0.0
    margin = np.zeros(controller.steps)
    while plant.time < DURATION - 1e-9:
        path.track(*plant.state[:2])
        reference = path.make_reference(controller.steps, step)
        if tightening is not None:
            # Outside the calibrated conditions the last margin is kept.
            current = _compute_margin(tightening, plant.state, angles, acceleration, step)
            margin = margin if current is None else current
        along = path.distance + step * SPEED * np.arange(1, controller.steps + 1)
        angle, acceleration = controller.control(plant.state, reference, compute_limits(gates, along, margin)).inputs
        angles.append(angle)
        for _ in range(round(step / SAMPLING_TIME)):
            rows.append((plant.time, *plant.state, angle))
            plant.advance(SAMPLING_TIME, angle, acceleration)
            offset = path.track(*plant.state[:2])
            low, high = compute_limits(gates, np.array([path.distance]), np.zeros(1))
            depth = max(depth, float(low[0]) - offset, offset - float(high[0]))
    table, tuning = np.array(rows), controller.tuning
    cost = (tuning.across * np.mean(table[:, 2] ** 2) + tuning.speed * np.mean((table[:, 3] - SPEED) ** 2)
            + tuning.steering_change * np.mean(np.diff(angles) ** 2))
    return Outcome(depth, float(np.sqrt(np.mean(table[:, 2] ** 2))), float(cost), _make_log(table, vehicle, seed))


def _compute_margin(tightening: Margin, state: Sequence[float], angles: Sequence[float], acceleration: float,
                    step: float) -> np.ndarray | None:
    """Distance to keep from posts at the end of each step [m]; None outside the calibrated conditions."""
    last_second = np.interp(np.arange(-1.0, 0.01, 0.05), step * np.arange(-10, 1), angles[-11:])
    activity = float(steering_activity(last_second))
    condition = compute_conditions(state[2], state[5], acceleration, activity)[None]
    if not tightening.domain.contains(condition)[0]:
        return None
    stride = round(step / SETTINGS.prediction.step)
    widths = np.asarray(tightening.half_widths(state[:6], (angles[-1], acceleration), activity))
    across = widths[stride - 1::stride, 1]
    return np.minimum(across, across[round(tightening.until / step) - 1])


def _make_log(table: np.ndarray, vehicle: VehicleParameters, seed: int) -> DriveLog:
    """The drive as an INS without noise would record it, with the commanded steering."""
    time, x, y, forward, across, yaw, rate, angle = table.T
    time_ns = np.round(time * 1e9).astype(np.int64)
    d_x, d_y = vehicle.cg_to_ins_x, vehicle.cg_to_ins_y
    return DriveLog(f"car {seed}", time_ns, x + np.cos(yaw) * d_x - np.sin(yaw) * d_y,
                    y + np.sin(yaw) * d_x + np.cos(yaw) * d_y, yaw, forward - rate * d_y, across + rate * d_x, rate,
                    time_ns, angle, vehicle.steering_wheel_angle(angle))


def calibrate_band(controller: Controller, vehicle: VehicleParameters, model: str) -> tuple[Band, CalibrationDomain]:
    """Band and domain of hindsight predictions, since the controller also knows the future inputs."""
    runs = []
    for seed in range(CALIBRATION_CARS):
        log = drive(controller, vehicle, make_gates(np.random.default_rng([22, seed])), 1000 + seed).log
        runs.append(compute_error_samples([get_model(model)], vehicle, SETTINGS.signals(log), SETTINGS))
    time = SETTINGS.prediction.step * np.arange(1, SETTINGS.prediction.steps + 1)
    band = calibrate(runs, (model, "hindsight"), time, LEVELS)
    return band, CalibrationDomain.from_runs([run.conditions for run in runs])


def compare(seeds: int, model: str) -> dict[str, dict[str, float]]:
    """Summary of the drives of all seeds, by variant of the constraint."""
    vehicle, tuning = read_vehicle(config("vehicle/leaf.yaml")), Tuning()
    controller = Controller(get_model(model), vehicle, round(HORIZON / tuning.step), tuning, "rti", corridor=True)
    (band, domain), summaries = calibrate_band(controller, vehicle, model), {}
    narrow, wide = (make_half_width_function(band, level, vehicle) for level in LEVELS)
    variants = {"unchanged": None, "tightened": Margin(narrow, domain, HORIZON),
                f"tightened, at most as {NEAR:g} s ahead": Margin(narrow, domain, NEAR),
                f"{LEVELS[1]:.0%} band, at most as {NEAR:g} s ahead": Margin(wide, domain, NEAR)}
    for name, margin in variants.items():
        summaries[name] = summarise([drive(controller, vehicle, make_gates(), seed, margin)
                                     for seed in range(seeds)])
        print(name, summaries[name], flush=True)
    return summaries


def summarise(outcomes: Sequence[Outcome]) -> dict[str, float]:
    """Number of violations; largest and median depth [m], mean error [m] and mean cost over all cars."""
    depths, errors, costs = np.array([(outcome.depth, outcome.error, outcome.cost) for outcome in outcomes]).T
    return {"seeds": len(outcomes), "violations": int((depths > MIN_VIOLATION).sum()), "deepest": float(depths.max()),
            "depth_median": float(np.median(depths)), "error_rms": float(np.mean(errors)),
            "cost": float(np.mean(costs))}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--model", default="linear", choices=["kinematic", "linear", "nonlinear"])
    parser.add_argument("--output", type=Path, help="folder; default runs/corridor-<time>")
    options = parser.parse_args()
    folder = new_folder(options.output, "corridor")
    summaries = compare(options.seeds, options.model)
    (folder / "corridor.json").write_text(json.dumps(summaries, indent=1) + "\n", encoding="utf-8")
    print(folder)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
