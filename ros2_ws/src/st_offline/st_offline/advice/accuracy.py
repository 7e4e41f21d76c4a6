"""Accuracy of each model and step by second ahead, and the cheapest that is accurate enough at each speed."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from st_core.bands import CONDITIONS, RunSamples, calibrate, highest_level
from st_core.bands.calibration import FEWEST_RUNS
from st_core.bands.file import times
from st_core.binning import SPEED
from st_core.log_evaluation import EvaluationSettings

from .cost import Cost

ACROSS = 1
"""Of along, across, yaw."""
LEVELS = (0.9, 0.5)
SHARE = 0.9
"""Of starts that a model which is good enough keeps within the tolerance."""
ENOUGH = 100
"""Minimum starts in a speed bin for a result: ten seconds of driving."""


@dataclass(frozen=True)
class Accuracy:
    """Of one model and step, in the model question. second: whole seconds ahead. rms: of the error across there [m].
    width: mean half-width across of the calibrated band of `level` there [m]; None with too few runs for one.
    within: by lower edge of speed [m/s], (seconds,), the error across that SHARE of the starts stay below up to that
    second [m], every run weighing the same."""

    second: tuple[int, ...]
    rms: tuple[float, ...]
    level: float | None
    width: tuple[float, ...] | None
    within: dict[float, tuple[float, ...]]


def model_accuracy(runs: Sequence[RunSamples], model: str, settings: EvaluationSettings) -> Accuracy:
    """Of errors of this model; at least one run. Raises StCoreError where no band can be fitted to them."""
    question = model, "hindsight"
    time = times(settings.prediction.horizon, settings.prediction.step)
    seconds = range(1, math.floor(time[-1] + 1e-9) + 1)
    at = [int(np.abs(time - second).argmin()) for second in seconds]
    across = [np.abs(run.errors[question][:, :, ACROSS].astype(float)) for run in runs]
    rms = np.sqrt(np.mean([np.square(one[:, at]).mean(axis=0) for one in across], axis=0))
    level = next((one for one in LEVELS if len(runs) >= FEWEST_RUNS and one <= highest_level(len(runs)) + 1e-9), None)
    width = None
    if level is not None:
        # Mean over all starts, also those under conditions that fewer runs had than a band is given for.
        band = calibrate(runs, question, time, (level,))
        width = tuple(np.mean([band.half_widths(run.conditions, level)[:, at, ACROSS].mean(axis=0) for run in runs],
                              axis=0).tolist())
    highest = [np.maximum.accumulate(one, axis=1)[:, at] for one in across]
    within = {}
    for low, high in zip(SPEED, (*SPEED[1:], math.inf), strict=True):
        speed = [run.conditions[:, CONDITIONS.index("speed")] for run in runs]
        parts = [one[(v >= low) & (v < high)] for one, v in zip(highest, speed, strict=True)]
        if sum(map(len, parts)) >= ENOUGH:
            spread = [np.quantile(part, np.linspace(0.0, 1.0, 201), axis=0) for part in parts if len(part)]
            within[low] = tuple(np.quantile(np.concatenate(spread), SHARE, axis=0).tolist())
    return Accuracy(tuple(seconds), tuple(rms.tolist()), level, width, within)



Key = tuple[str, float]
"""Model, step [s]."""


def processor_time(cost: Cost) -> float:
    """Processor time that counts in a choice [s]: one prediction, compiled where the model can be."""
    return cost.floats if cost.compiled is None else cost.compiled


def cheapest(costs: Mapping[Key, Cost], accuracies: Mapping[Key, Accuracy],
             tolerance: float) -> dict[float, tuple[Key | None, ...]]:
    """By lower edge of speed [m/s]: for each second ahead the cheapest with an error across within the tolerance
    [m] in SHARE of the starts; None where no model does.
    """
    order = sorted(accuracies, key=lambda key: processor_time(costs[key]))
    speeds = sorted({low for one in accuracies.values() for low in one.within})
    seconds = max((len(one.second) for one in accuracies.values()), default=0)
    return {low: tuple(next((key for key in order if low in accuracies[key].within
                             and accuracies[key].within[low][k] <= tolerance), None) for k in range(seconds))
            for low in speeds}


def speed_label(low: float) -> str:
    """Of a lower edge [m/s]."""
    high = dict(zip(SPEED, (*SPEED[1:], math.inf), strict=True))[low]
    return f"{low:g} to {high:g} m/s" if math.isfinite(high) else f"above {low:g} m/s"
