"""CasADi: the functions of a Model as symbolic ones, for optimisation, linearisation and export. Needs casadi.

The equations are not written again: `model.inputs` and `model.rhs` are called with symbols, and the step is
`integrate.rk4_step` as everywhere. Importing this module teaches `st_core.ops` the numbers of CasADi. Unlike on floats,
`maximum` and `minimum` let go of a NaN: one instruction instead of five, and smooth solvers never see one.
Checked by: test_casadi_backend.py.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import casadi

from .. import ops
from ..augmented import AugmentedModel
from ..composition import compose
from ..errors import ConfigurationError
from ..integrate import rk4_step
from ..models import Model, get_model
from ..types import STATE_NAMES, STATE_UNITS
from ..vehicle import VehicleParameters

_FUNCTIONS = {"sin": casadi.sin, "cos": casadi.cos, "tan": casadi.tan, "atan": casadi.atan, "sqrt": casadi.sqrt,
              "sign": casadi.sign, "absolute": casadi.fabs, "maximum": casadi.fmax, "minimum": casadi.fmin}
for _kind in (casadi.SX, casadi.MX, casadi.DM):
    ops.register(_kind, _FUNCTIONS)


@dataclass(frozen=True)
class Variable:
    """One entry of x, u or p. lower, upper: where the model is meant to hold [unit], infinite where nothing limits it.

    value: of a parameter, as the car and the model have it; NaN where the caller must give one.
    """

    name: str
    unit: str
    lower: float = -math.inf
    upper: float = math.inf
    value: float = math.nan


# Wide enough for any driving on a road, narrow enough that a solver starts at something like a car: a front axle steers
# 35 deg at most, tyres brake and drive at 1 g, and the models are for speeds at which a car rolls.
_BOUNDS = {"velocity_x": (0.5, 70.0), "velocity_y": (-10.0, 10.0), "yaw_rate": (-3.0, 3.0)}
INPUTS = (Variable("road_wheel_angle", "rad", -0.61, 0.61), Variable("velocity_x_dot", "m/s^2", -9.81, 9.81))


@dataclass(frozen=True)
class SymbolicModel:
    """A model as CasADi functions; x, u and p are columns in the order of `states`, `inputs` and `parameters`.

        dynamics(x, u) -> x_dot                 step(x, u, h) -> x_next, RK4 with u held, h [s] in `substeps` equal parts
        dynamics_jacobian(x, u) -> A, B         step_jacobian(x, u, h) -> A, B        derivatives by x and by u
        start(x_six, u) -> x                    the six states with the extra ones as they are at a start

    Where `parameters` is not empty, each function has one more argument, p, at the end: the parameters left free, then
    the signals the model asks for. left_out: effects of the model that are not in its equations, because they act on a
    recorded steering series or on the sensors.
    """

    name: str
    states: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    substeps: int
    left_out: tuple[str, ...]
    dynamics: casadi.Function
    step: casadi.Function
    dynamics_jacobian: casadi.Function
    step_jacobian: casadi.Function
    start: casadi.Function

    @property
    def functions(self) -> tuple[casadi.Function, ...]:
        return self.dynamics, self.step, self.dynamics_jacobian, self.step_jacobian, self.start


def build(model: str | Model, vehicle: VehicleParameters, substeps: int = 1,
          free: Iterable[str] = ()) -> SymbolicModel:
    """The functions of a model with the numbers of a car in them.

    substeps: RK4 steps within h. free: names of parameters that stay an argument, as `parameter_values` lists them.
    Functions are named <model>_dynamics and so on. Raises ConfigurationError for an unknown model or parameter.
    """
    model = get_model(model)
    if substeps < 1:
        raise ConfigurationError(f"substeps: {substeps} is below 1")
    p = model.parameters(vehicle)
    values, free = parameter_values(model, vehicle), tuple(dict.fromkeys(free))
    for name in free:
        if name not in values:
            raise ConfigurationError(f"parameter {name!r} is not in model {model.name}; there are {', '.join(values)}")
    parameters = (*(Variable(name, "", value=values[name]) for name in free), *(Variable(n, "") for n in model.signals))
    states = tuple(Variable(name, unit, *_BOUNDS.get(name, ()))
                   for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True))
    states += tuple(Variable(name, "") for name in model.extra_states)

    x, u, h = casadi.SX.sym("x", len(states)), casadi.SX.sym("u", len(INPUTS)), casadi.SX.sym("h")
    symbols = [casadi.SX.sym(v.name) for v in parameters]
    tail, tail_name = ([casadi.vertcat(*symbols)], ["p"]) if symbols else ([], [])
    chosen = _replaced(p, _names(model), dict(zip(free, symbols, strict=False)))
    w = model.inputs(*casadi.vertsplit(u), chosen, *symbols[len(free):])

    rates = casadi.vertcat(*model.rhs(tuple(casadi.vertsplit(x)), w, chosen))
    after = tuple(casadi.vertsplit(x))
    for _ in range(substeps):
        after = rk4_step(model.rhs, after, w, w, w, chosen, h / substeps)
    after = casadi.vertcat(*after)
    six = casadi.SX.sym("x_six", len(STATE_NAMES))
    begin = casadi.vertcat(*model.start_state(tuple(casadi.vertsplit(six)), w, chosen))

    def function(kind: str, arguments: dict[str, Any], results: dict[str, Any]) -> casadi.Function:
        return casadi.Function(f"{model.name}_{kind}", [*arguments.values(), *tail], [*results.values()],
                               [*arguments, *tail_name], [*results])

    def jacobian(of: casadi.SX) -> dict[str, casadi.SX]:
        return {"A": casadi.jacobian(of, x), "B": casadi.jacobian(of, u)}

    now, ahead = {"x": x, "u": u}, {"x": x, "u": u, "h": h}
    return SymbolicModel(
        model.name, states, INPUTS, parameters, substeps, _left_out(model),
        function("dynamics", now, {"x_dot": rates}), function("step", ahead, {"x_next": after}),
        function("dynamics_jacobian", now, jacobian(rates)), function("step_jacobian", ahead, jacobian(after)),
        function("start", {"x_six": six, "u": u}, {"x": begin}))


def parameter_values(model: str | Model, vehicle: VehicleParameters) -> dict[str, float]:
    """Every number in the equations by name: "mass", "tyre_front.p_dy1", "friction.factor", as the model has it."""
    model = get_model(model)
    return dict(_leaves(model.parameters(vehicle), _names(model)))


def _names(model: Model) -> Mapping[str, str]:
    """What stands in for the places of effects in p, by path."""
    names = {"base": ""}
    if isinstance(model, AugmentedModel):
        names |= {f"effects.{k}": e.name for k, e in enumerate(compose(model.base, model.effects).own)}
    return names


def _children(p: tuple) -> Iterable[tuple[str, Any]]:
    return zip(getattr(p, "_fields", map(str, range(len(p)))), p, strict=True)


def _leaves(p: Any, names: Mapping[str, str], path: str = "", name: str = "") -> Iterator[tuple[str, float]]:
    if not isinstance(p, tuple):
        yield name, p
        return
    for key, part in _children(p):
        below = f"{path}.{key}" if path else key
        yield from _leaves(part, names, below, names.get(below, f"{name}.{key}" if name else key))


def _replaced(p: Any, names: Mapping[str, str], symbols: Mapping[str, Any]) -> Any:
    """p with symbols in place of the named numbers."""
    leaves = iter([symbols.get(name, value) for name, value in _leaves(p, names)])

    def rebuilt(part: Any) -> Any:
        if not isinstance(part, tuple):
            return next(leaves)
        inner = [rebuilt(x) for x in part]
        return type(part)(*inner) if hasattr(part, "_fields") else tuple(inner)

    return rebuilt(p)


def _left_out(model: Model) -> tuple[str, ...]:
    return tuple(e.name for e in getattr(model, "effects", ()) if e.steering or e.observe)
