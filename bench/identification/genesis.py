"""Identifies the Genesis from four of its drives, and evaluates the position errors on the others."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from st_core.augmented import augment
from st_core.batch import LogBatch
from st_core.identification.axle_forces import identify_stiffness
from st_core.identification.driving_fit import MISALIGNMENT
from st_core.identification.driving_prediction import fit_stiffness, identify_yaw_inertia
from st_core.identification.ins_mounting import identify_ins_mounting
from st_core.identification.result import Identification, IdentificationError
from st_core.identification.steering import identify_steering_offset
from st_core.log import DriveLog, LogSignals
from st_core.log_evaluation import regular_starts, usable_starts
from st_core.regression import make_blocks
from st_core.vehicle import VehicleParameters

from .._drives import SOUND_DRIVES, read_runs, rotate_ins
from .._drives import genesis as genesis_vehicle
from .drives import apply_estimates

TRAINING_DRIVES = ("cpg_lap_slow", "cpg_lap_fast", "cpg_lap_medium", "cpg_low_speed_a")
STEERING = ("steering_ratio", "steering_wheel_offset")
PREDICTION_TIME = 5  # s


def identify_genesis() -> dict:
    """Estimates from the TRAINING_DRIVES, and position errors with them on all drives."""
    car = genesis_vehicle()
    logs = read_runs(SOUND_DRIVES, car)
    # The recordings contain the road wheel angle; it is converted to the steering wheel angle, so that the ratio can
    # be changed.
    logs = {name: replace(log, steering_wheel_angle=car.steering_wheel_angle(log.road_wheel_angle))
            for name, log in logs.items()}
    training = [logs[name] for name in TRAINING_DRIVES]
    others = [log for name, log in logs.items() if name not in TRAINING_DRIVES]
    full_fit = fit_stiffness(training, car, "linear", additional=(*STEERING, "cg_to_ins_x", MISALIGNMENT))
    partial_fit = fit_stiffness(training, car, "linear", additional=(*STEERING, MISALIGNMENT))
    ins = identify_ins_mounting(training, car)
    results = {"prediction": full_fit, "prediction, lever arm as published": partial_fit, "slow driving": ins,
               "paper, published steering": identify_stiffness(training, car),
               "paper, steering and INS as identified": identify_stiffness(
                   [correct_mounting(log, full_fit[MISALIGNMENT].value) for log in training],
                   with_estimates(car, full_fit, (*STEERING, "cg_to_ins_x")))}
    result = {"identified from": ", ".join(TRAINING_DRIVES),
              "estimates": {name: _format_estimates(estimates) for name, estimates in results.items()}}
    result["by drive"] = {name: _identify_single(log, car) for name, log in logs.items()}
    result["yaw inertia"] = _describe_estimates(lambda: identify_yaw_inertia(training, car))
    result["offset on straights"] = _describe_estimates(lambda: identify_steering_offset(training, car))
    steps = {
        "published": (car, 0.0),
        "steering ratio, offset": (with_estimates(car, partial_fit, STEERING), 0.0),
        "and misalignment": (with_estimates(car, partial_fit, STEERING), partial_fit[MISALIGNMENT].value),
        "and stiffnesses": (with_estimates(car, partial_fit), partial_fit[MISALIGNMENT].value),
        "and lever arm": (with_estimates(car, full_fit), full_fit[MISALIGNMENT].value),
    }
    for title, chosen in (("evaluated on the other drives", others), ("evaluated on the drives used", training)):
        result[title] = {name: position_errors(chosen, *step) for name, step in steps.items()}
    return result


def with_estimates(car: VehicleParameters, found: Identification, names=None) -> VehicleParameters:
    """The car with the estimates of `names`, or with all estimates."""
    chosen = [e for e in found.estimates if names is None or e.parameter in names]
    return apply_estimates(car, chosen)


def correct_mounting(log: DriveLog, angle: float) -> DriveLog:
    """The drive corrected for an INS that is rotated to the left by `angle` [rad]; accelerations are left out."""
    return replace(rotate_ins(log, -angle), acceleration_x=None, acceleration_y=None)


def position_errors(logs: list[DriveLog], car: VehicleParameters, misalignment: float) -> dict:
    """RMS position error after PREDICTION_TIME in hindsight [m], with its 95 % interval, and for each drive."""
    result = {}
    for base in ("kinematic", "linear"):
        model = augment(base, {"heading_misalignment": {"angle": misalignment}})
        columns = []
        for number, log in enumerate(logs):
            own = log.with_steering(car)
            starts, _ = usable_starts(LogSignals(own, 0.1, 5.0), car, regular_starts(own, 0.1), 0.5)
            # Integration steps small enough for these stiffnesses at the lowest speed.
            batch = LogBatch(own, starts, points=(PREDICTION_TIME,), substeps="auto")
            errors = batch.errors(model, car)[:, 0, :2]
            finite = np.isfinite(errors).all(axis=1)
            columns.append(np.column_stack((np.full(finite.sum(), number), (starts[finite] - log.start_ns) * 1e-9,
                                            errors[finite])))
        run_index, time, along, across = np.concatenate(columns).T
        result[base] = {"position": _rms(np.hypot(along, across), run_index, time),
                        "lateral": _rms(across, run_index, time),
                        **{log.name: float(np.sqrt(np.mean((along**2 + across**2)[run_index == number])))
                           for number, log in enumerate(logs)}}
    return result


def _rms(values: np.ndarray, run_index: np.ndarray, time: np.ndarray) -> str:
    """Root mean square and its 95 % interval, from a bootstrap of blocks of the runs."""
    group = make_blocks(run_index, time)
    totals = group.sum_by_block(np.stack([np.ones_like(values), values**2], axis=1))
    weights = np.random.default_rng(0).multinomial(len(group), np.full(len(group), 1.0 / len(group)), size=500)
    drawn = np.sqrt((weights @ totals[:, 1]) / (weights @ totals[:, 0]))
    low, high = np.percentile(drawn, (2.5, 97.5))
    return f"{np.sqrt(np.mean(values**2)):.2f} ({low:.2f} to {high:.2f})"


def _format_estimates(found: Identification) -> dict:
    return {e.parameter: f"{e.value:.5g} +/- {e.standard_uncertainty:.2g}, {e.interval95[0]:.5g} to "
                         f"{e.interval95[1]:.5g} {e.unit}, {e.status}" for e in found.estimates}


def _identify_single(log: DriveLog, car: VehicleParameters) -> dict | str:
    try:
        return _format_estimates(fit_stiffness([log], car, "linear", additional=(*STEERING, MISALIGNMENT)))
    except IdentificationError as error:
        return str(error)


def _describe_estimates(call: Callable[[], Identification]) -> dict | str:
    """Estimates and warnings, or the reason why the identification failed."""
    try:
        found = call()
        return {**_format_estimates(found), "warnings": " ".join(found.warnings)}
    except IdentificationError as error:
        return str(error)
