"""Offset of the steering wheel sensor from straight driving, by two methods.

Method of the paper: the offset with which the predicted yaw rate agrees best with the measured one. Direct method: the
mean reading in windows of nearly constant steering, corrected for the remaining curvature kappa,

    o = mean(delta_h) - i L kappa (1 + K v_x^2),    kappa = change of heading / distance,    K: stability factor

A crowned road, crosswind or worn tyres bias both results. Checked by: test_identification_driving.py.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..handling import stability_factor
from ..log import DriveLog
from ..regression import Spread, make_blocks
from ..timeseries import filtered_derivative
from ..vehicle import VehicleParameters
from .driving_fit import DrivingFitSettings, fit_driving
from .result import Identification, IdentificationError, ParameterEstimate, describe_contradiction
from .run_samples import MAXIMUM_GAP, RunSamples, prepare_drives, sample_run

PAPER_NAME, DIRECT_NAME = "steering_wheel_offset", "steering_wheel_offset_direct"
SETTINGS = DrivingFitSettings(horizon=2.0, maximum_acceleration=0.5, min_windows=40, channels=("yaw_rate",))
WINDOW = 2.0  # s; length of a window of the direct method
MIN_RADIUS = 500.0  # m; of the path in a window, for a full-size car
MAX_ANGLE_DEVIATION = np.deg2rad(3.0)  # standard deviation of the steering wheel angle in a window
MIN_WINDOWS = 10  # minimum number of windows
CUTOFF = 1.0  # Hz, low-pass on the measured yaw rate, forward and backward


def identify_steering_offset(logs: Sequence[DriveLog], vehicle: VehicleParameters) -> Identification:
    """Offset at the steering wheel by both methods [rad], left +, as parameters PAPER_NAME and DIRECT_NAME.

    vehicle: its offset is the start value of the fit. Raises IdentificationError for too little straight driving.
    """
    logs, notes = prepare_drives(logs, vehicle)
    runs = [sample_run(log, vehicle) for log in logs]
    settings, min_radius = SETTINGS.for_car(vehicle), MIN_RADIUS * vehicle.speed_scale**2
    windows = [_find_straight_windows(run, vehicle, settings.minimum_speed, min_radius) for run in runs]
    values = np.concatenate([w[:, 1] for w in windows])
    if len(values) < MIN_WINDOWS:
        raise IdentificationError(
            f"too little straight driving: {len(values)} windows of {WINDOW:g} s are straighter than R = "
            f"{min_radius:.3g} m and faster than {settings.minimum_speed:.3g} m/s, with constant steering; "
            f"{MIN_WINDOWS} are needed")
    # Without smoothing, road noise would still cause 0.02 deg of error at the steering wheel after four minutes.
    smoothed = [replace(log, yaw_rate=filtered_derivative(log.ins_time_ns, log.yaw_rate, CUTOFF, MAXIMUM_GAP,
                                                    "zero_phase")[0]) for log in logs]
    fit = fit_driving(smoothed, vehicle, (PAPER_NAME,), "linear", settings)
    predicted = tuple(name for name, (count, _) in fit.windows.items() if count)
    paper = _make_estimate(PAPER_NAME, fit.values[0], fit.spread, "predicted versus measured yaw rate (paper)",
                           predicted, f"{fit.prediction_count} predictions on straights")

    run_of = np.concatenate([np.full(len(w), i) for i, w in enumerate(windows)])
    times = np.concatenate([w[:, 0] for w in windows])
    _, spread, _ = make_blocks(run_of, times).fit_least_squares(np.ones((len(values), 1)), values)
    averaged = tuple(run.name for run, w in zip(runs, windows, strict=True) if len(w))
    direct = _make_estimate(DIRECT_NAME, float(values.mean()), spread, "mean reading on steady straights", averaged,
                            f"{len(values)} windows of {WINDOW:g} s")
    conflict = describe_contradiction(paper, direct.value, direct.standard_uncertainty,
                                      "the mean reading on steady straights")
    if conflict:
        paper = replace(paper, status="doubtful", verdict=f"{paper.verdict} {conflict}")
    names = tuple(run.name for run in runs)
    used = tuple(name for name in names if name in predicted or name in averaged)
    rejected = tuple((name, "no straight driving") for name in names if name not in used)
    figure = {"time": times, "run": run_of, "offset": values, "residual_yaw_rate": fit.residuals[:, 0]}
    return Identification("steering-offset", (paper, direct), used, rejected, None, (),
                          (*notes, *([conflict] if conflict else [])), figure)


def _find_straight_windows(run: RunSamples, vehicle: VehicleParameters, min_speed: float,
                           min_radius: float) -> np.ndarray:
    """(start time [s], offset [rad] at the steering wheel) of the steady straight windows of a run, (n, 2)."""
    understeer = stability_factor(vehicle)
    rows = []
    for start in np.arange(run.time[0], run.time[-1] - WINDOW, WINDOW):
        part = slice(*np.searchsorted(run.time, (start, start + WINDOW)))
        time, angle, speed = run.time[part], run.steering_wheel_angle[part], run.velocity_x[part]
        if len(time) < 10 or time[-1] - time[0] < 0.9 * WINDOW or speed.min() < min_speed:
            continue
        mean_speed = float(speed.mean())
        curvature = float(run.yaw[part][-1] - run.yaw[part][0]) / (mean_speed * float(time[-1] - time[0]))
        if abs(curvature) * min_radius > 1.0 or angle.std() > MAX_ANGLE_DEVIATION:
            continue
        road_wheel_angle = vehicle.wheelbase * curvature * (1.0 + understeer * mean_speed**2)
        rows.append((start, float(angle.mean()) - vehicle.steering_ratio * road_wheel_angle))
    return np.array(rows).reshape(-1, 2)


def _make_estimate(name: str, value: float, spread: Spread, method: str, runs: tuple[str, ...],
                   basis: str) -> ParameterEstimate:
    uncertainty = float(spread.deviations[0])
    degrees, deviation = np.rad2deg(value), np.rad2deg(uncertainty)
    verdict = (f"The steering wheel reads {degrees:.2f} +/- {deviation:.2f} deg when driving straight, from {basis} in "
               f"{spread.basis[0]}.")
    return ParameterEstimate(name, float(value), "rad", uncertainty, spread.interval(0, value), method, runs, verdict,
                             "identified" if deviation < 0.5 else "doubtful")
