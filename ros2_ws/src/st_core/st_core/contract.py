"""Requirements for every effect, which `st effects check` applies to library and user-defined effects.

Each function in `REQUIREMENTS` examines a base model with the effect, and returns a description of the violation in one
line, or "" if there is none. Checked by: test_contract.py.
"""

import importlib.util
import sys
from collections.abc import Iterable, Mapping

import numpy as np

from .augmented import AugmentedModel, augment, set_effects_to_null
from .backends import get_backend, has_numba
from .effects import Effect, Measured
from .errors import StCoreError
from .integrate import growth_factor, lateral_modes, rk4_step
from .models import MODELS, Model
from .prediction import predict
from .types import InputSequence, VehicleState
from .vehicle import VehicleParameters

STEP, STEPS = 0.05, 40  # s; number of steps
SPEEDS = (4.0, 8.0, 15.0, 25.0)  # m/s
STANDSTILL_SPEEDS = (-1.0, 0.0, 1e-9, 0.5, 2.0)  # m/s
ROUNDING = 1e-9  # largest difference between backends, relative to max(1, |value|), and between mirror images
CORRECTION_RESIDUAL = 0.05  # largest residual after `correct`, as a fraction of the change by `observe`
MAX_GROWTH_RATE_INCREASE = 0.1  # 1/s; above the growth rate of the base model, or above 0 if that is stable
MIRROR_SIGNS = np.array([1.0, -1.0, 1.0, -1.0, -1.0, -1.0])  # signs of the states under left-right mirroring
ODD_READINGS = ("y", "yaw", "velocity_y", "yaw_rate", "acceleration_y", "yaw_acceleration")
READING = Measured(3.0, -2.0, 0.2, 12.0, 0.1, 0.25, 0.4, 2.9, 0.3)


def check_effect(effect: type[Effect], vehicle: VehicleParameters) -> dict[str, str]:
    """Description of the violation by requirement, "" if fulfilled; an exception counts as a violation."""
    docstring = effect.__doc__ or sys.modules[effect.__module__].__doc__ or ""
    problems = {"the effect or its file has a docstring":
                "" if docstring.strip() else "no docstring; write one with the equation, units and signs"}
    for text, find_violation in REQUIREMENTS.items():
        try:
            with np.errstate(all="ignore"):
                violations = (find_violation(effect, vehicle, base, augment(base, [effect.name]))
                              for base in MODELS.values() if base.name in effect.applies_to)
                problems[text] = next(filter(None, violations), "")
        except Exception as error:
            prefix = "" if isinstance(error, StCoreError) else f"{type(error).__name__}: "
            problems[text] = prefix + " ".join(str(error).split())
    return problems


def _check_null(effect: type[Effect], vehicle: VehicleParameters, base: Model, model: AugmentedModel) -> str:
    null = set_effects_to_null(model)
    change = float(np.abs(_predict_floats(null, vehicle) - _predict_floats(base, vehicle)).max())
    if np.isnan(change) or change > 0.0:
        return f"null values change a state of the {base.name} model by {change:.3g}; states must be bit-identical"
    readings = null.observe(READING), null.correct(READING)
    if readings != (READING, READING) or null.effective_vehicle(vehicle) != vehicle:
        return "null values change a reading or the vehicle parameters"
    return ""


def _check_change(effect: type[Effect], vehicle: VehicleParameters, base: Model, model: AugmentedModel) -> str:
    time, angle = np.arange(100) * 0.01, 0.1 * np.sin(np.arange(100) * 0.2)
    steering = [np.array(a) for a in model.steering(time, angle, np.arange(100) == 0)]
    changes = (np.abs(_predict_floats(model, vehicle) - _predict_floats(base, vehicle)).max(),
               np.abs(steering[0] - time).max(),
               np.abs(steering[1] - angle).max(), np.abs(np.subtract(model.observe(READING), READING)).max())
    if not max(changes) > 0.0 and model.effective_vehicle(vehicle) == vehicle and not effect.specific_force:
        return f"the initial values change nothing in the {base.name} model"
    return ""


def _check_finite(effect: type[Effect], vehicle: VehicleParameters, base: Model, model: AugmentedModel) -> str:
    for p in (p for p in effect.parameters if p.fit):
        for value in p.bounds:
            changed_model = model.with_values({effect.name: {p.name: value}})
            for speed in STANDSTILL_SPEEDS:
                if not np.isfinite(_predict_floats(changed_model, vehicle, speed, acceleration=0.0)).all():
                    return f"{p.name} = {value:g}, {base.name}: not finite when started at {speed:g} m/s"
            parameters = changed_model.parameters(vehicle)
            w = changed_model.inputs(0.05, 0.8, parameters, *(row[0] for row in _make_signals(changed_model).values()))
            rates = changed_model.rhs(changed_model.start_state(_make_start(SPEEDS[-1]), w, parameters), w, parameters)
            if not np.isfinite([*rates, *changed_model.observe(READING)]).all():
                return f"{p.name} = {value:g}, {base.name}: not finite at {SPEEDS[-1]:g} m/s"
    return ""


def _check_backends(effect: type[Effect], vehicle: VehicleParameters, base: Model, model: AugmentedModel) -> str:
    floats = np.stack([_predict_floats(model, vehicle, speed) for speed in SPEEDS])
    backends = ("numpy", "lanes") if has_numba() else ("numpy",)
    paths = {name: _predict_backend(model, vehicle, name) for name in backends}
    if importlib.util.find_spec("casadi"):
        paths["CasADi"] = _predict_casadi(model, vehicle)
    for name, path in paths.items():
        reference = floats if path.shape == floats.shape else floats[:, -1]
        difference = np.abs(path - reference) / np.maximum(1.0, np.abs(reference))
        if not (difference < ROUNDING).all():
            return f"{base.name}: backend {name} and Python floats differ by {float(difference.max()):.2g}"
    return ""


def _check_mirror(effect: type[Effect], vehicle: VehicleParameters, base: Model, model: AugmentedModel) -> str:
    if effect.kind == "environment":
        return ""  # wind and slope depend on the map and are not symmetric
    opposite_values = {p.name: -p.initial for p in effect.parameters if p.odd}
    mirror_model = model.with_values({effect.name: opposite_values}) if opposite_values else model
    differences = (_predict_floats(mirror_model, vehicle, side=-1.0) - MIRROR_SIGNS * _predict_floats(model, vehicle),
                   np.subtract(mirror_model.observe(_mirror(READING)), _mirror(model.observe(READING))))
    difference = float(max(np.abs(values).max() for values in differences))
    if not difference < ROUNDING:
        return (f"{base.name}: a left turn and the mirror image of a right turn differ by {difference:.2g}; "
                "if a parameter changes sign in the mirror image, set odd=True for it")
    return ""


def _check_stability(effect: type[Effect], vehicle: VehicleParameters, base: Model, model: AugmentedModel) -> str:
    problem = describe_instability(base, model, vehicle, SPEEDS)
    return f"with initial values, {base.name}: {problem}" if problem else ""


def describe_instability(base: Model, model: Model, vehicle: VehicleParameters, speeds: Iterable[float]) -> str:
    """Description of an instability in straight driving that the base does not have, "" if there is none."""
    for speed in speeds:
        if base.name != "kinematic":
            before, after = (float(lateral_modes(m, vehicle, speed).real.max()) for m in (base, model))
            if not after <= max(before, 0.0) + MAX_GROWTH_RATE_INCREASE:
                return f"a lateral mode has a growth rate of {after:.2g} instead of {before:.2g} 1/s at {speed:.3g} m/s"
        factor = growth_factor(model, vehicle, speed, STEP)
        if factor > max(1.0, growth_factor(base, vehicle, speed, STEP)):
            return (f"a mode is too fast for steps of {1e3 * STEP:g} ms at {speed:.3g} m/s: it grows by a factor of "
                    f"{factor:.2g} per step")
    return ""


def _check_correction(effect: type[Effect], vehicle: VehicleParameters, base: Model, model: AugmentedModel) -> str:
    if effect.observe is None:
        return ""
    readings = np.array(model.observe(READING), float)
    restored = np.array(model.correct(Measured(*readings)), float)
    error, change = np.abs(restored - READING).max(), np.abs(readings - READING).max()
    if error <= CORRECTION_RESIDUAL * change:
        return ""
    return f"observe() changes a reading by {change:.3g}; after correct() an error of {error:.3g} remains"


REQUIREMENTS = {
    "null values leave predictions bit-identical": _check_null,
    "initial values change a prediction or a reading": _check_change,
    "predictions are finite at the bounds and at standstill": _check_finite,
    "results are equal with Python floats, in batches, compiled and in CasADi": _check_backends,
    "left and right are mirror images, except for the environment and parameters with odd=True": _check_mirror,
    "it does not make the car unstable": _check_stability,
    "correct() inverts observe()": _check_correction,
}
"""For each requirement, the function of effect, vehicle, base and model that describes a violation."""


def _make_driver_inputs(side: float, acceleration: float) -> tuple[np.ndarray, np.ndarray]:
    time = np.linspace(0.0, STEP * STEPS, 2 * STEPS + 1)
    return side * 0.05 * np.sin(4.0 * time), acceleration * np.cos(2.0 * time)


def _make_signals(model: Model, side: float = 1.0) -> Mapping[str, np.ndarray]:
    return {name: side * 0.02 * np.ones(2 * STEPS + 1) for name in model.signals}


def _make_start(speed: float, side: float = 1.0) -> tuple[float, ...]:
    return 3.0, -2.0 * side, speed, 0.1 * side, 0.3 * side, 0.1 * side


def _predict_floats(model: Model, vehicle: VehicleParameters, speed: float = 12.0, side: float = 1.0,
                    acceleration: float = 0.8) -> np.ndarray:
    """States (STEPS + 1, 6) computed with floats."""
    inputs = InputSequence(*_make_driver_inputs(side, acceleration), signals=_make_signals(model, side))
    return predict(model, vehicle, VehicleState(*_make_start(speed, side)), inputs, STEP * STEPS, STEP).states


def _predict_backend(model: Model, vehicle: VehicleParameters, backend: str) -> np.ndarray:
    """States (speeds, STEPS + 1, 6) computed by a backend."""
    module, p = get_backend(backend), model.parameters(vehicle)
    speeds = np.pad(SPEEDS, (0, -len(SPEEDS) % module.LANES), mode="edge")
    columns = len(speeds)
    angle, acceleration = (np.repeat(row, columns) for row in _make_driver_inputs(1.0, 0.8))
    signals = [np.repeat(row, columns) for row in _make_signals(model).values()]
    w = np.array([np.broadcast_to(f, angle.shape) for f in model.inputs(angle, acceleration, p, *signals)])
    state = model.start_state(tuple(np.array([_make_start(v) for v in speeds]).T), tuple(w[:, :columns]), p)
    begin = np.array([np.broadcast_to(row, columns) for row in state])
    offsets, points = np.arange(2 * STEPS + 1) * columns, np.arange(STEPS + 1)
    return module.advance(model, p, begin, w, offsets, STEP, points).transpose(2, 0, 1)[:len(SPEEDS)]


def _predict_casadi(model: Model, vehicle: VehicleParameters) -> np.ndarray:
    """Last states (speeds, 6), by integration of `dynamics`; `step` would hold the inputs over a step."""
    from .backends.casadi_backend import build  # imported here because casadi is optional

    equations = build(model, vehicle)
    signals = [[row[0] for row in _make_signals(model).values()]] if model.signals else []
    grid = list(zip(*_make_driver_inputs(1.0, 0.8), strict=True))

    def rates(state: tuple, u: tuple, _: None) -> tuple:
        return tuple(np.asarray(equations.dynamics(list(state), list(u), *signals)).ravel().tolist())

    last_states = []
    for speed in SPEEDS:
        state = tuple(np.asarray(equations.start(list(_make_start(speed)), list(grid[0]), *signals)).ravel().tolist())
        for k in range(STEPS):
            begin, middle, end = grid[2 * k:2 * k + 3]
            state = rk4_step(rates, state, begin, middle, end, None, STEP)
        last_states.append(state[:6])
    return np.array(last_states)


def _mirror(m: Measured) -> Measured:
    return m._replace(**{name: -getattr(m, name) for name in ODD_READINGS})
