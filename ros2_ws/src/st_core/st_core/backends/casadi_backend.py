"""Symbolic functions of a Model for optimisation, linearisation and export. Needs casadi.

`model.inputs`, `model.rhs` and `integrate.rk4_step` are called with symbols. Importing this module registers the number
types of CasADi in `st_core.ops`. Unlike with floats, `maximum` and `minimum` do not propagate NaN, as that would take
five times as many instructions. Checked by: test_casadi_backend.py.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi

from .. import ops
from ..augmented import AugmentedModel
from ..composition import compose
from ..effects import Effect
from ..errors import ConfigurationError
from ..integrate import rk4_step
from ..models import Model, get_model
from ..types import STATE_NAMES, STATE_UNITS
from ..vehicle import VehicleParameters

_FUNCTIONS: dict[str, Callable] = {
    "sin": casadi.sin, "cos": casadi.cos, "tan": casadi.tan, "atan": casadi.atan, "sqrt": casadi.sqrt,
    "sign": casadi.sign, "absolute": casadi.fabs, "maximum": casadi.fmax, "minimum": casadi.fmin}
for _kind in (casadi.SX, casadi.MX, casadi.DM):
    ops.register(_kind, _FUNCTIONS)


@dataclass(frozen=True)
class Variable:
    """One entry of x, u or p."""

    name: str
    unit: str
    lower: float = -math.inf  # limit of the valid range of x or u, or bound of a parameter [unit]
    upper: float = math.inf
    value: float = math.nan  # known value of a parameter; NaN if the caller must supply it


# Range of values in road driving, to guide a solver: 35 deg of steering, 1 g of braking or acceleration.
_BOUNDS = {"velocity_x": (0.5, 70.0), "velocity_y": (-10.0, 10.0), "yaw_rate": (-3.0, 3.0)}
INPUTS = (Variable("road_wheel_angle", "rad", -0.61, 0.61), Variable("velocity_x_dot", "m/s^2", -9.81, 9.81))


@dataclass(frozen=True)
class SymbolicModel:
    """A model as CasADi functions; x, u and p are columns in the order of `states`, `inputs` and `parameters`.

        dynamics(x, u) -> x_dot
        step(x, u, h) -> x_next             RK4 with constant u; h [s] in `substeps` equal parts
        dynamics_jacobian(x, u) -> A, B     d(x_dot)/dx and d(x_dot)/du
        step_jacobian(x, u, h) -> A, B      d(x_next)/dx and d(x_next)/du
        start(x_six, u) -> x                initial state: six states and extra states

    If `parameters` is not empty, each function has the last argument p: the free parameters, then the signals of the
    model. omitted_effects: effects of the model that act on recorded steering or on sensors, not in the equations.
    """

    name: str
    states: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    substeps: int
    omitted_effects: tuple[str, ...]
    dynamics: casadi.Function
    step: casadi.Function
    dynamics_jacobian: casadi.Function
    step_jacobian: casadi.Function
    start: casadi.Function

    @property
    def functions(self) -> tuple[casadi.Function, ...]:
        return self.dynamics, self.step, self.dynamics_jacobian, self.step_jacobian, self.start


def build(model: str | Model, vehicle: VehicleParameters, substeps: int = 1, free: Iterable[str] = ()) -> SymbolicModel:
    """The functions of a model for one car; the name of each begins with that of the model.

    substeps: RK4 steps within h. free: parameters that remain arguments, such as "road_bank.angle", of effects in the
    inputs or equations. Raises ConfigurationError for an unknown model or parameter, or substeps < 1.
    """
    model = get_model(model)
    if substeps < 1:
        raise ConfigurationError(f"substeps: {substeps} is below 1")
    p = model.parameters(vehicle)
    known, free = list_free_parameters(model), tuple(dict.fromkeys(free))
    for name in free:
        if name not in known:
            raise ConfigurationError(f"free: {name!r} is not a parameter of an effect in the equations of model "
                                     f"{model.name}; those are: {', '.join(known) or 'none'}")
    parameters = (*(known[name] for name in free), *(Variable(name, "") for name in model.signals))
    units = [unit for e in _find_composed_effects(model) for unit in (e.extra_units or ("",) * len(e.extra_states))]
    states = tuple(Variable(name, unit, *_BOUNDS.get(name, ())) for name, unit in zip(
        (*STATE_NAMES, *model.extra_states), (*STATE_UNITS, *units), strict=True))

    x, u, h = casadi.SX.sym("x", len(states)), casadi.SX.sym("u", len(INPUTS)), casadi.SX.sym("h")
    symbols = [casadi.SX.sym(v.name) for v in parameters]
    p_argument, p_name = ([casadi.vertcat(*symbols)], ["p"]) if symbols else ([], [])
    symbolic_p = _insert_symbols(model, p, dict(zip(free, symbols, strict=False))) if free else p
    w = model.inputs(*casadi.vertsplit(u), symbolic_p, *symbols[len(free):])

    rates = casadi.vertcat(*model.rhs(tuple(casadi.vertsplit(x)), w, symbolic_p))
    state = tuple(casadi.vertsplit(x))
    for _ in range(substeps):
        state = rk4_step(model.rhs, state, w, w, w, symbolic_p, h / substeps)
    next_state = casadi.vertcat(*state)
    six = casadi.SX.sym("x_six", len(STATE_NAMES))
    start = casadi.vertcat(*model.start_state(tuple(casadi.vertsplit(six)), w, symbolic_p))

    def make_function(name: str, arguments: dict[str, Any], results: dict[str, Any]) -> casadi.Function:
        return casadi.Function(f"{model.name}_{name}", [*arguments.values(), *p_argument], [*results.values()],
                               [*arguments, *p_name], [*results])

    def differentiate(expression: casadi.SX) -> dict[str, casadi.SX]:
        return {"A": casadi.jacobian(expression, x), "B": casadi.jacobian(expression, u)}

    state_arguments, step_arguments = {"x": x, "u": u}, {"x": x, "u": u, "h": h}
    return SymbolicModel(
        model.name, states, INPUTS, parameters, substeps,
        tuple(e.name for e in getattr(model, "effects", ()) if e.steering or e.observe),
        make_function("dynamics", state_arguments, {"x_dot": rates}),
        make_function("step", step_arguments, {"x_next": next_state}),
        make_function("dynamics_jacobian", state_arguments, differentiate(rates)),
        make_function("step_jacobian", step_arguments, differentiate(next_state)),
        make_function("start", {"x_six": six, "u": u}, {"x": start}))


def list_free_parameters(model: str | Model) -> dict[str, Variable]:
    """Parameters of a model that `build` can leave free, by name."""
    model = get_model(model)
    if not isinstance(model, AugmentedModel):
        return {}
    return {f"{e.name}.{q.name}": Variable(f"{e.name}.{q.name}", q.unit, *q.bounds, model.values[e.name][q.name])
            for e in _find_composed_effects(model) for q in e.parameters}


def _find_composed_effects(model: Model) -> tuple[type[Effect], ...]:
    """The effects that have parameters in p, in the order of p."""
    return compose(model.base, model.effects).effects if isinstance(model, AugmentedModel) else ()


def _insert_symbols(model: Model, p: Any, symbols: Mapping[str, casadi.SX]) -> Any:
    return p._replace(thetas=tuple(
        theta._replace(**{q.name: symbols[key] for q in e.parameters if (key := f"{e.name}.{q.name}") in symbols})
        for e, theta in zip(_find_composed_effects(model), p.thetas, strict=True)))
