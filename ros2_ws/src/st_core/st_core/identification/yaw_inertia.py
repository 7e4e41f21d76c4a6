"""Yaw inertia from transients: how fast the yaw rate follows the steering, at both axles' stiffnesses.

    I_z r_dot = l_f F_f cos(delta) - l_r F_r

In steady bends r_dot is zero and any inertia fits. Steering dynamics, a time stamp that is off, and the relaxation of
the tyres delay the response as inertia does; the dead time of the steering and the relaxation length are therefore
fitted beside it, and a strong correlation is said. Without the relaxation the inertia of a car that has 0.4 m of it
comes out 17 % too small. An angle may be as old as a sampling interval T when it is stamped, and how old changes
from drive to drive, which one dead time for N drives cannot follow: T / sqrt(12 N) of dead time is added to the
uncertainty, times what a second of it changes. Checked by: test_identification_driving.py.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..filtering import NANOSECOND
from ..log import DriveLog
from ..models import Model
from ..vehicle import VehicleParameters
from .coverage import coverage, require
from .free_parameters import DELAY, MISALIGNMENT, RELAXATION
from .prediction_error import Fit, PredictionError, PredictionErrorSettings
from .prediction_estimates import described, driving_coverage, identification
from .result import Estimate, Identification, contradiction
from .run_samples import prepared, run_samples

NAMES = ("yaw_inertia", "cornering_stiffness_front", "cornering_stiffness_rear", DELAY, RELAXATION,
         "steering_wheel_offset", MISALIGNMENT)
YAW_ACCELERATION_EDGES = np.array([-10.0, -0.3, -0.1, 0.1, 0.3, 10.0])  # rad/s^2, left +
SETTINGS = PredictionErrorSettings(points=(0.1, 0.2, 0.3, 0.4, 0.6, 0.8), interval=0.3)
RADIUS_OF_GYRATION = (0.35, 0.65)
"""Share of the wheelbase between which cars lie; outside, the value is none."""


def identify_yaw_inertia(logs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model = "nonlinear",
                         settings: PredictionErrorSettings = SETTINGS, *, bootstrap: int = 200,
                         seed: int = 0) -> Identification:
    """Yaw inertia with its uncertainty; stiffnesses and steering delay are reported beside.

    Raises IdentificationError without transients: half a second of r_dot above 0.3 rad/s^2 to either side.
    """
    logs, noticed = prepared(logs, vehicle)
    runs = [run_samples(log, vehicle, cutoff=5.0) for log in logs]
    interval = float(np.median(np.concatenate([np.diff(run.time) for run in runs])))
    fast = [run.yaw_acceleration[run.velocity_x >= settings.minimum_speed] for run in runs]
    covered = (*driving_coverage(logs, {"speed": (5.0, 1), "lateral acceleration": (1.0, 3)},
                                 settings.minimum_speed),
               coverage("yaw acceleration", "rad/s^2", YAW_ACCELERATION_EDGES, fast, interval, 0.5, 5))
    require(covered, "Steady bends do not show the yaw inertia: drive steps, lane changes or a sine sweep.")
    problem = PredictionError(logs, vehicle, NAMES, base, settings)
    method = f"multi-step prediction of transients, {described(base)}"
    fit = problem.fit()
    result = identification("yaw-inertia", problem, fit, method, NAMES[:4], covered, bootstrap, seed,
                            _timing(fit, logs, problem.starts))
    inertia = result["yaw_inertia"]
    warnings = [*noticed, *result.warnings]
    share = float(np.sqrt(inertia.value / vehicle.mass) / vehicle.wheelbase)
    if not RADIUS_OF_GYRATION[0] <= share <= RADIUS_OF_GYRATION[1]:
        words = (f"A radius of gyration of {share:.2f} wheelbases is no car's: the transients are too weak, or "
                 "steering or tyre dynamics pass for inertia.")
        warnings.append(words)
        inertia = replace(inertia, status="unidentifiable", verdict=f"{words} {inertia.verdict}")
    said = contradiction(inertia, vehicle.yaw_inertia, 0.1 * vehicle.yaw_inertia, "the vehicle file (as +/- 10 %)")
    estimates: tuple[Estimate, ...] = (inertia, *result.estimates[1:])
    return replace(result, estimates=estimates, warnings=(*warnings, said) if said else tuple(warnings))


def _timing(fit: Fit, logs: Sequence[DriveLog], starts: Mapping[str, int]) -> dict[str, float]:
    """Standard uncertainty of the dead time [s] and, through it, of the inertia; see the module."""
    interval = float(np.median(np.concatenate([np.diff(log.steering_time_ns) for log in logs]))) * NANOSECOND
    time = interval / np.sqrt(12.0 * sum(count > 0 for count in starts.values()))
    squares = fit.jacobian.T @ fit.jacobian
    delay = fit.names.index(DELAY)
    others = [i for i in range(len(fit.names)) if i != delay]
    change = dict(zip([fit.names[i] for i in others],
                      np.linalg.solve(squares[np.ix_(others, others)], squares[others, delay]), strict=True))
    return {DELAY: time, "yaw_inertia": abs(change["yaw_inertia"]) * time}
