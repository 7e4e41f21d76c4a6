"""Drives of the model itself with some effects and sensor noise, and synthetic fit problems.

bench/plants has independent plants, bench/discovery sealed cases.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from st_core.augmented import AugmentedModel, augment
from st_core.channels import CHANNELS
from st_core.discovery import DiscoverySettings
from st_core.discovery.fit import Fit, Problem
from st_core.discovery.loss import Loss
from st_core.discovery.next_manoeuvre import simulate_drive
from st_core.discovery.space import Space
from st_core.log import DriveLog
from st_core.manoeuvres import CATALOGUE
from st_core.relations import Candidate
from st_core.vehicle import VehicleParameters

NOISE = {"x": 0.01, "y": 0.01, "yaw": 1e-4, "velocity_x": 0.003, "velocity_y": 0.003, "yaw_rate": 0.002,
         "acceleration_y": 0.05}
"""Standard deviations of white noise, SI."""
COLUMNS = ("velocity_y", "yaw_rate", "acceleration_y", "yaw", "position_lateral", "position_longitudinal")
"""Columns of the synthetic problems, a fixed list so that their random numbers stay the same."""
DRIVEN = ("lane_change", "slalom", "circle")


def recorded(vehicle: VehicleParameters, effects: Mapping, seed: int, names: Sequence[str] = DRIVEN,
             base: str = "nonlinear", noise: float = 1.0) -> list[DriveLog]:
    """One log per named manoeuvre of the catalogue. effects: {name: {parameter: value}}."""
    rng, model, logs = np.random.default_rng(seed), augment(base, effects), []
    for k, name in enumerate(names):
        log = simulate_drive(next(m for m in CATALOGUE if m.name == name), model, vehicle)
        noisy = {key: getattr(log, key) + noise * size * rng.standard_normal(len(log.x)) for key, size in NOISE.items()}
        logs.append(replace(log, name=f"{name} {k + 1}", **noisy))
    return logs


def fit_splines(candidate: Candidate, formula: Callable[[np.ndarray], np.ndarray], points: int = 200) -> np.ndarray:
    """Spline coefficients of the curve of the candidate that approximates y = formula(u) over its range."""
    u = np.linspace(candidate.low, candidate.high, points)
    return np.linalg.lstsq(candidate.compute_splines(u).T, formula(u), rcond=1e-6)[0]


def relation(candidate: Candidate, formula: Callable[[np.ndarray], np.ndarray]) -> dict[str, dict[str, float]]:
    """Effects of a model with the relation y = formula(u): {name: {parameter: value}}."""
    coefficients = {f"c{k}": float(c) for k, c in enumerate(fit_splines(candidate, formula))}
    return {candidate.effect: coefficients | candidate.constants}


@dataclass(frozen=True, eq=False)
class Rows:
    """The attributes of windows that errors and horizon errors use."""

    count: int
    run: np.ndarray
    columns, channels = COLUMNS, tuple(CHANNELS.values())
    time = np.array([0.5, 1.25, 2.5, 5.0])

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"run {k + 1}" for k in range(int(self.run.max()) + 1))

    @cached_property
    def known(self) -> np.ndarray:
        return np.ones((self.count, len(self.time) * len(self.columns)), bool)


class LinearErrors:
    """Errors that are linear in the parameters: noise at `truth`, plus `signatures` (p, n, m) per typical size."""

    def __init__(self, space: Space, truth: np.ndarray, signatures: np.ndarray, noise: np.ndarray, runs: int):
        count = len(noise)
        self.space, self.truth, self.signatures, self.noise = space, truth, signatures, noise
        self.windows = Rows(count, np.arange(count) * runs // count)
        self.threads = 1

    def at(self, vector: np.ndarray) -> np.ndarray:
        return self.noise + np.tensordot((self.truth - vector) / self.space.scale, self.signatures, 1)

    def model_at(self, vector: np.ndarray) -> AugmentedModel:
        return self.space.at(vector)

    def at_all(self, vectors: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [self.at(v) for v in vectors]


def linear_problem(effects: Sequence[str], truth: Mapping[str, float], seed: int, count: int = 160, block: int = 8,
                   runs: int = 4, common: float = 0.5, size: float = 0.02, prior: np.ndarray | None = None) -> Problem:
    """A problem with linear errors. Signatures and noise are random; windows of a block share the fraction `common` of
    the variance of both. truth: effect -> deviation of its first parameter from null [typical sizes]."""
    rng = np.random.default_rng(seed)
    space = Space("nonlinear", DiscoverySettings(effects=tuple(effects)))
    shape = (count, len(Rows.time) * len(COLUMNS))
    selected = np.isin(space.effect_names, effects)
    blocks = np.arange(count) // block

    def draw() -> np.ndarray:
        return size * (np.sqrt(common) * rng.standard_normal((blocks.max() + 1, shape[1]))[blocks]
                       + np.sqrt(1.0 - common) * rng.standard_normal(shape))
    signatures = np.zeros((len(space), *shape))
    signatures[selected] = [draw() for _ in range(int(selected.sum()))]
    noise = draw()
    at = space.null.copy()
    for name, deviation in truth.items():
        first = space.indices(name)[0]
        at[first] += deviation * space.scale[first]
    errors = LinearErrors(space, at, signatures, noise, runs)
    return Problem(Loss(errors, space.null), space.null, blocks, prior)


def fit_problem(problem: Problem, *effects: str, iterations: int = 30) -> Fit:
    """Joint fit of the effects from the start of the problem."""
    return problem.fit(effects, problem.all_sensitivities(problem.start), iterations=iterations)
