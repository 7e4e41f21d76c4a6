"""Correction of the steering clock of each run, estimated with the whole library of effects before the search.

The steering in a CAN log has its own clock, which is aligned to the INS in each run with an error of some milliseconds.
One delay for all runs cannot represent different errors; the fit would change yaw inertia or tyre relaxation instead.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..effects.steering_delay import SteeringDelay
from ..log import DriveLog
from ..timeseries import NANOSECOND
from ..vehicle import VehicleParameters
from .evidence import inverse
from .fit import Problem
from .loss import Errors, Loss
from .reference import fit_library, weak_prior
from .settings import DiscoverySettings
from .space import Space, find_file_quantities
from .windows import Windows

MAX_CLOCK_DEVIATION = 0.01  # s, largest standard deviation of a clock that counts as exact; a third of a typical delay
ITERATIONS = 3  # repetitions of the joint fit, each with the corrected time stamps


def estimate_clock_corrections(runs: Sequence[DriveLog], vehicle: VehicleParameters, space: Space,
                               settings: DiscoverySettings, deviations: Mapping[str, float], threads: int,
                               tick: Callable[[], None]) -> dict[str, float]:
    """Correction of the steering time stamps [s], > 0 if they were early, by run with an uncertain clock; empty for a
    single run, and for a base model without the effect `steering_delay`. deviations [s]: standard deviation of the
    steering clock by run, used as a prior; up to MAX_CLOCK_DEVIATION a clock counts as exact. The corrections are
    fitted together with all parameters of the library. An error common to all runs is attributed to `steering_delay`,
    which has a wider prior."""
    prior_deviation = np.array([deviations.get(run.name, 0.0) for run in runs])
    free = np.flatnonzero(prior_deviation > MAX_CLOCK_DEVIATION).tolist()
    if len(runs) < 2 or not free or not len(space.indices(SteeringDelay.name)):
        return {}
    k, correction = int(space.indices(SteeringDelay.name)[0]), np.zeros(len(free))
    scale, vector, quantities = space.scale[k], space.null, find_file_quantities(space, vehicle)
    for _ in range(ITERATIONS):
        by_run = {runs[i].name: float(c) for i, c in zip(free, correction, strict=True)}
        windows = Windows(apply_clock_corrections(runs, by_run), vehicle, settings)
        if not len(windows):  # the caller reports this error
            return {}
        loss = Loss(Errors(windows, space, threads), vector)
        vector, prior = fit_library(loss, windows, weak_prior(space), quantities, vector, tick)
        problem = Problem(loss, space.null, windows.block, prior)
        problem.update_design_effect(vector)
        q, member = problem.full_quadratic(vector), (windows.run == np.array(free)[:, None]).astype(float)
        cross = member @ q.hessian[:, :, k]
        clock_prior = 0.5 * problem.design_effect * np.square(scale / prior_deviation[free])
        h = np.block([[q.hessian.sum(axis=0) + prior, cross.T], [cross, np.diag(cross[:, k] + clock_prior)]])
        g = np.concatenate([q.gradient.sum(axis=0) - prior @ problem.distance(vector),
                            member @ q.gradient[:, k] - clock_prior * correction / scale])
        correction = correction + (inverse(h) @ g)[len(space):] * scale
    return {runs[i].name: float(c) for i, c in zip(free, correction, strict=True)}


def apply_clock_corrections(runs: Sequence[DriveLog], corrections: Mapping[str, float]) -> list[DriveLog]:
    """The runs with steering time stamps corrected by the result of `estimate_clock_corrections`."""
    return [replace(run, steering_time_ns=run.steering_time_ns + round(corrections[run.name] / NANOSECOND))
            if corrections.get(run.name) else run for run in runs]
