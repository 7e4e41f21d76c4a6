"""Estimates, verdicts and warnings of a fit of predictions to driving: what its experiments have in common."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..augmented import AugmentedModel
from ..log import DriveLog
from ..models import Model, get_model
from .coverage import ACCELERATION_EDGES, SPEED_EDGES, coverage
from .free_parameters import FREE
from .prediction_error import Fit, PredictionError
from .result import Coverage, Estimate, Identification, Status, correlation_of, strong_correlations

LARGEST_RELATIVE = 0.1
"""Standard uncertainty over value from which on a stiffness, ratio or inertia is doubtful; five times that: none."""


def identification(what: str, problem: PredictionError, fit: Fit, method: str, reported: Sequence[str],
                   covered: Sequence[Coverage], bootstrap: int, seed: int,
                   beside: Mapping[str, float] | None = None) -> Identification:
    """Result of a fit. reported: parameters to give as estimates, the others only help; correlation over `reported`.
    beside: standard uncertainties the drives cannot show, added to theirs.
    """
    drawn = fit.bootstrap(bootstrap, seed)
    covariance = drawn.covariance.copy()
    # Independent of the data drawn, so added to the variances alone.
    share = single_track_share(problem)
    beside = {n: share * v for n, v in zip(fit.names, fit.values, strict=True)
              if n.startswith("cornering_stiffness")} | dict(beside or {})
    covariance += np.diag([beside.get(name, 0.0) ** 2 for name in fit.names])
    chosen = [fit.names.index(name) for name in reported]
    covariance_chosen = covariance[np.ix_(chosen, chosen)]
    correlation_all = correlation_of(covariance)
    uncertainty = np.sqrt(np.diag(covariance))
    runs = tuple(name for name, starts in problem.starts.items() if starts)
    estimates = tuple(
        Estimate(fit.names[i], float(fit.values[i]), FREE[fit.names[i]].unit, float(uncertainty[i]),
                 drawn.interval(i, fit.values[i], uncertainty[i]), method,
                 runs, verdict(fit, i, uncertainty[i], f"{len(fit.residuals) // 2} residuals, resampling "
                               f"{drawn.words(i)}"),
                 status(fit, i, uncertainty[i])) for i in chosen)
    rejected = [(name, f"{problem.considered[name] - used} of {problem.considered[name]} starts slower than "
                 f"{problem.settings.minimum_speed:g} m/s, beyond {problem.settings.maximum_acceleration:g} m/s^2 or "
                 "with gaps") for name, used in problem.starts.items() if used < problem.considered[name]]
    others = [f"{n} = {fit.values[i]:.4g} +/- {uncertainty[i]:.2g} {FREE[n].unit} was fitted beside."
              for i, n in enumerate(fit.names) if n not in reported]
    warnings = [*strong_correlations(fit.names, correlation_all), *others]
    figure = {"residuals": fit.residuals.reshape(-1, 2) * fit.noise, "residual_run": fit.run_of[::2],
              "residual_time": fit.time[::2], "names": fit.names, "bootstrap": drawn.values, "noise": fit.noise}
    return Identification(what, estimates, runs, tuple(rejected), correlation_of(covariance_chosen),
                          tuple(covered), tuple(warnings), figure)


def status(fit: Fit, index: int, uncertainty: float) -> Status:
    name, value = fit.names[index], abs(fit.values[index])
    if name in fit.at_bound:
        return "unidentifiable"
    if not FREE[name].relative:
        return "identified" if uncertainty < FREE[name].scale else "doubtful"
    if uncertainty > 5.0 * LARGEST_RELATIVE * value:
        return "unidentifiable"
    return "doubtful" if uncertainty > LARGEST_RELATIVE * value else "identified"


def verdict(fit: Fit, index: int, uncertainty: float, basis: str) -> str:
    """Plain words: what the value is worth, and what it rests on."""
    name, value = fit.names[index], fit.values[index]
    if name in fit.at_bound:
        return f"Stopped at its bound {value:.4g}: the data do not fix it, or contradict the rest of the vehicle file."
    if FREE[name].relative:
        share = 100.0 * uncertainty / abs(value)
        words = {"identified": "Fixed", "doubtful": "Poorly fixed",
                 "unidentifiable": "The data cannot tell it: fixed only"}[status(fit, index, uncertainty)]
        return f"{words} to +/- {share:.1f} %, from {basis}."
    return f"{value:.4g} +/- {uncertainty:.2g} {FREE[name].unit}, from {basis}."


def single_track_share(problem: PredictionError) -> float:
    """Standard uncertainty of a stiffness for what one track leaves out, as a share of it: (0.8 L)^2 mean(curvature^2).

    Two wheels with Ackermann angles turn an axle's force into a yaw moment that one wheel does not have, by terms of
    (L / R)^2. On the virtual Leaf without noise: rear stiffness 4.6 m^2 / R^2 too small, 1.1 % at 20 m, 0.1 % at 60 m.
    All of it counts, as a car with full Ackermann angles has all of it.
    """
    return (0.8 * problem.vehicle.wheelbase) ** 2 * problem.curvature_square


def described(base: str | Model) -> str:
    """The model a fit predicts with, in words."""
    if isinstance(base, AugmentedModel):
        return f"{base.base.name} tyres with {', '.join(effect.name for effect in base.effects)}"
    return f"{get_model(base).name} tyres"


def driving_coverage(logs: Sequence[DriveLog], needs: Mapping[str, tuple[float, int]],
                     minimum_speed: float) -> tuple[Coverage, ...]:
    """Speed and lateral acceleration v_x r of all driving above a speed [m/s].

    needs: {"speed" | "lateral acceleration": (seconds a bin must hold, bins needed)}.
    """
    fast = [log.velocity_x >= minimum_speed for log in logs]
    intervals = [np.diff(log.ins_time_ns) for log in logs]
    interval = float(np.median(np.concatenate(intervals))) * 1e-9
    speeds = [log.velocity_x[m] for log, m in zip(logs, fast, strict=True)]
    across = [(log.velocity_x * log.yaw_rate)[m] for log, m in zip(logs, fast, strict=True)]
    return (coverage("speed", "m/s", SPEED_EDGES, speeds, interval, *needs["speed"]),
            coverage("lateral acceleration", "m/s^2", ACCELERATION_EDGES, across, interval,
                     *needs["lateral acceleration"]))
