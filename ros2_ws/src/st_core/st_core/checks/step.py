"""Is the integration step short enough for this car at the speeds of a run? See `stability`."""

from collections.abc import Sequence

import numpy as np

from ..filtering import NANOSECOND
from ..log import DriveLog
from ..models import Model, get_model
from ..stability import MOST_SUBSTEPS, growth, slip_speed_needed, stable
from ..vehicle import VehicleParameters
from .finding import Advice, Finding, Severity
from .motion import stretches

SPEEDS = 40
"""looked at, between the lowest and the highest of the run."""
SHORT = (1, 2, 4, 5, 8, 10, 16, 20, 25, 32, 40, 50, MOST_SUBSTEPS)
"""Parts of a step that keep it a plain number."""
TOGETHER = 1.0
"""s. Stretches closer than that are one."""


def step_too_long(models: Sequence[str | Model], vehicle: VehicleParameters, log: DriveLog,
                  step: float) -> Finding | None:
    """The finding `step_too_long`, for all of the models together; None where the step [s] is short enough.

    Its value is the minimum_slip_speed [m/s] that corrects it, as printed; where none does, the step [s].
    Checked by: test_checks_step.py.
    """
    chosen = [get_model(model) for model in models]
    speed = np.abs(log.velocity_x)
    if not len(speed):
        return None
    speeds = np.linspace(speed.min(), speed.max(), SPEEDS)
    factors = {model.name: np.array([growth(model, vehicle, v, step) for v in speeds]) for model in chosen}
    guilty = [name for name, factor in factors.items() if factor.max() > 1.0]
    if not guilty:
        return None
    unstable = np.interp(speed, speeds, np.max(list(factors.values()), axis=0)) > 1.0
    touched = speed[unstable] if unstable.any() else speed[:1]
    value, unit, advice = _advice(chosen, vehicle, speeds.tolist(), step)
    text = (f"integration steps of {1e3 * step:g} ms are too long for the {' and '.join(guilty)} model of "
            f"{vehicle.name} at {touched.min():.1f} to {touched.max():.1f} m/s: the lateral motion comes out wrong")
    return Finding("step_too_long", Severity.WARNING, ("velocity_x",), text, value, unit,
                   where=_stretches(log, unstable), advice=advice)


def _advice(models: Sequence[Model], vehicle: VehicleParameters, speeds: Sequence[float],
          step: float) -> tuple[float | None, str, Advice]:
    needed = slip_speed_needed(models, vehicle, speeds, step)
    if needed is not None:
        line = f'minimum_slip_speed: {{value: {needed:g}, unit: m/s, source: "stable with steps of {1e3 * step:g} ms"}}'
        return needed, "m/s", Advice("vehicle", line, {"minimum_slip_speed": needed})
    shorter = next((step / parts for parts in SHORT if stable(models, vehicle, speeds, step / parts)), None)
    if shorter is not None:
        return shorter, "s", Advice("option", f"--step {shorter:.9g}", {"step": shorter})
    return None, "s", Advice("look", f"no step down to {1e3 * step / MOST_SUBSTEPS:.2g} ms is short enough: look at "
                             "the vehicle's yaw_inertia, mass and stiffnesses, and at the effects of the model")


def _stretches(log: DriveLog, chosen: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Stretches selected by a mask over the INS samples, in s after the first of them; () for the whole run."""
    seconds = (log.ins_time_ns - log.ins_time_ns[0]) * NANOSECOND
    return () if chosen.all() else stretches(seconds[chosen], TOGETHER)
