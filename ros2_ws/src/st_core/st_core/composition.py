"""Composes a base model with effects into plain functions, usable with floats, arrays, compilers and CasADi.

The functions are created once per base model and set of effects. Values occur only in the parameters p, so the
functions are not created or compiled again in a fit. Layout of a composed model:

    p     = AugmentedParameters: parameters of the base model, theta of each effect that changes inputs or equations;
            p of the base model alone without such effects
    w     = (road_wheel_angle, velocity_x_dot, prepared quantities of each effect ..., w of the base model);
            w of the base model alone if no effect changes the equations
    state = the six states of the base model, then the extra states of each effect

Effects at their null values leave the result bit-identical: they add 0, multiply by 1, or blend with weight 0.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from typing import Any, NamedTuple

from .effects import Effect, Instant
from .effects._base import EQUATION_HOOKS
from .models import Model, linear_tyre, motion, slip_angles

N_STATES = 6  # number of states of every base model


class AugmentedParameters(NamedTuple):
    """Parameters p of an augmented model. thetas: theta of each effect in `Composition.effects`."""

    base: Any
    thetas: tuple


@dataclass(frozen=True)
class Composition:
    """Functions of an augmented model."""

    effects: tuple[type[Effect], ...]  # effects with a theta in p, in its order
    inputs: Callable[..., tuple]
    rhs: Callable[[tuple, tuple, Any], tuple]
    start: Callable[[tuple, tuple, Any], tuple] | None = None  # initial extra states
    specific_force: Callable[[tuple, tuple, Any], tuple] | None = None  # (a_x, a_y) added by the effects
    extra_states: tuple[str, ...] = ()
    signals: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Layout:
    """Indices of an effect in p, in w and in the state."""

    effect: type[Effect]
    index: int  # of its theta in p
    prepared: tuple[int, int]  # (begin, end) in w
    extra: tuple[int, int]  # (begin, end) of its extra states in the state


@cache
def compose(base: Model, effects: tuple[type[Effect], ...]) -> Composition:
    """The functions of a base model with effects; cached. effects: in the order in which they act."""
    effects = tuple(e for e in effects if e.converts or any(getattr(e, hook) for hook in ("inputs", *EQUATION_HOOKS)))
    if not effects:
        return Composition((), base.inputs, base.rhs)
    layouts: list[_Layout] = []
    w, state = 2, N_STATES
    for index, effect in enumerate(effects):
        layout = _Layout(effect, index, (w, w + len(effect.prepared or effect.signals)),
                         (state, state + len(effect.extra_states)))
        w, state = layout.prepared[1], layout.extra[1]
        layouts.append(layout)
    signals = tuple(dict.fromkeys(name for effect in effects for name in effect.signals))
    only_inputs = not any(e.converts or getattr(e, hook) for e in effects for hook in EQUATION_HOOKS)
    inputs, base_rhs = _make_inputs(base.inputs, effects, signals, only_inputs), base.rhs
    if only_inputs:
        return Composition(effects, inputs, lambda state, w, p: base_rhs(state, w, p.base), signals=signals)
    base_begin = layouts[-1].prepared[1]
    geometric_slips, base_forces, base_rates = _make_dynamics(base, layouts, base_begin)
    slips = _chain(lambda front, rear, state, instant: (front, rear), _add_slip_angles, layouts, "slip_angles")
    rhs = _make_rhs(geometric_slips, slips, _chain(base_forces, _add_axle_forces, layouts, "axle_forces"), base_rates,
                    _chain(_no_acceleration, _add_acceleration, layouts, "acceleration"),
                    _chain(lambda *_: (), _add_rates, layouts, "rates"))
    if base.axle_forces is None:
        rhs = _blend(base_rhs, rhs, base_begin, _conversion_layout(layouts).index)
    extra_states = tuple(f"{e.name}.{name}" for e in effects for name in e.extra_states)
    with_states, with_force = ([layout for layout in layouts if getattr(layout.effect, attribute)]
                               for attribute in ("extra_states", "specific_force"))
    return Composition(effects, inputs, rhs, _make_start(with_states, geometric_slips) if with_states else None,
                       _make_specific_force(with_force) if with_force else None, extra_states, signals)


def change_inputs(hooks: Iterable[tuple[int, Callable, Sequence[int]]], angle: Any, acceleration: Any,
                  values: Sequence[Any], thetas: Sequence[Any]) -> tuple[Any, Any]:
    """Road wheel angle [rad] and velocity_x_dot [m/s^2], changed by effects in turn.

    hooks: index of an effect in `thetas`, its hook `inputs`, and the indices of its signals in `values`.
    """
    for index, change, rows in hooks:
        angle, acceleration = change(angle, acceleration, tuple([values[row] for row in rows]), thetas[index])
    return angle, acceleration


def _make_inputs(base_inputs: Callable[..., tuple], effects: tuple[type[Effect], ...], signals: tuple[str, ...],
                 only_inputs: bool) -> Callable[..., tuple]:
    """inputs(road_wheel_angle, velocity_x_dot, p, *signal values) -> w. only_inputs: w is that of the base model."""
    hooks = [(index, effect.inputs, effect.prepare, [signals.index(name) for name in effect.signals])
             for index, effect in enumerate(effects)]
    input_hooks = [(index, change, rows) for index, change, _, rows in hooks if change]
    prepare_hooks = [(index, prepare, rows) for index, _, prepare, rows in hooks if prepare or rows]

    def inputs(angle, acceleration, p, *values):
        if input_hooks:
            angle, acceleration = change_inputs(input_hooks, angle, acceleration, values, p.thetas)
        if only_inputs:
            return base_inputs(angle, acceleration, p.base)
        prepared: list[Any] = []
        for index, prepare, rows in prepare_hooks:
            signal_values = tuple([values[row] for row in rows])
            prepared += prepare(angle, acceleration, signal_values, p.thetas[index]) if prepare else signal_values
        return angle, acceleration, *prepared, *base_inputs(angle, acceleration, p.base)
    return inputs


def _make_start(layouts: list[_Layout], geometric_slips):
    def start(state, w, p):
        instant, values = _make_instant(state, w, p), list[Any]()
        slips = geometric_slips(instant)
        for layout in layouts:
            hook, (begin, end) = layout.effect.start, layout.prepared
            values += (hook(slips, instant, w[begin:end], p.thetas[layout.index]) if hook else
                       [0.0 * instant.velocity_x] * len(layout.effect.extra_states))
        return tuple(values)
    return start


def _make_specific_force(layouts: list[_Layout]):
    def specific_force(state, w, p):
        instant = _make_instant(state, w, p)
        a_x = a_y = 0.0 * instant.velocity_x
        for layout in layouts:
            begin, end = layout.prepared
            added_x, added_y = layout.effect.specific_force(instant, w[begin:end], p.thetas[layout.index])
            a_x, a_y = a_x + added_x, a_y + added_y
        return a_x, a_y
    return specific_force


def _chain(function, add, layouts: list[_Layout], attribute: str):
    """The function, wrapped by `add(function, layout)` for each effect that has the attribute."""
    return reduce(add, (layout for layout in layouts if getattr(layout.effect, attribute)), function)


def _conversion_layout(layouts: list[_Layout]) -> _Layout:
    """Layout of the effect that turns a kinematic base into a dynamic model."""
    return next(layout for layout in layouts if layout.effect.converts and layout.effect.converts[0] == "kinematic")


# Equations. The functions below return functions that refer only to plain functions and integers, so that compilers can
# inline them. Each _add_ function wraps a function of the model, `previous`, and adds one effect to it.

def _make_instant(state, w, p):
    return Instant(state[0], state[1], state[2], state[3], state[4], state[5], w[0], w[1], w, p)


def _get_state(instant):
    return instant.x, instant.y, instant.velocity_x, instant.velocity_y, instant.yaw, instant.yaw_rate


def _make_dynamics(base: Model, layouts: list[_Layout], base_begin: int):
    """Functions slips(instant), forces(slip_front, slip_rear, instant), rates(force_front, force_rear, instant)."""
    axle_forces = base.axle_forces or linear_tyre.axle_forces
    if base.axle_forces is None:
        conversion = _conversion_layout(layouts)
        index, (begin, end) = conversion.index, conversion.prepared

        def select_w_and_p(instant):
            return instant.w[begin:end], instant.p.thetas[index].constants
    else:
        def select_w_and_p(instant):
            return instant.w[base_begin:], instant.p.base

    def slips(instant):
        w, p = select_w_and_p(instant)
        return slip_angles(_get_state(instant), w, p)

    def forces(slip_front, slip_rear, instant):
        w, p = select_w_and_p(instant)
        return axle_forces(slip_front, slip_rear, w, p)

    def rates(force_front, force_rear, instant):
        w, p = select_w_and_p(instant)
        return motion(_get_state(instant), force_front, force_rear, w, p)

    return slips, forces, rates


def _make_rhs(geometric_slips, changed_slips, forces, base_rates, acceleration, rates):
    def rhs(state, w, p):
        instant = _make_instant(state, w, p)
        geometric = geometric_slips(instant)
        slip_front, slip_rear = changed_slips(geometric[0], geometric[1], state, instant)
        axle = forces(slip_front, slip_rear, instant)
        dx, dy, dv_x, dv_y, dyaw, dyaw_rate = base_rates(axle[0], axle[1], instant)
        a_x, a_y, a_yaw = acceleration(instant)
        return dx, dy, dv_x + a_x, dv_y + a_y, dyaw, dyaw_rate + a_yaw, *rates(state, geometric, axle, instant)
    return rhs


def _blend(kinematic, dynamic, base_begin, index):
    def rhs(state, w, p):
        weight = p.thetas[index].share
        remainder = 1.0 - weight
        k = kinematic(state[:N_STATES], w[base_begin:], p.base)
        d = dynamic(state, w, p)
        return (remainder * k[0] + weight * d[0], remainder * k[1] + weight * d[1], remainder * k[2] + weight * d[2],
                remainder * k[3] + weight * d[3], remainder * k[4] + weight * d[4], remainder * k[5] + weight * d[5],
                *d[N_STATES:])
    return rhs


def _add_slip_angles(previous, layout):
    hook, index, (begin, end), (first, last) = layout.effect.slip_angles, layout.index, layout.prepared, layout.extra

    def slips(slip_front, slip_rear, state, instant):
        front, rear = previous(slip_front, slip_rear, state, instant)
        return hook(front, rear, state[first:last], instant, instant.w[begin:end], instant.p.thetas[index])
    return slips


def _add_axle_forces(previous, layout):
    hook, index, (begin, end) = layout.effect.axle_forces, layout.index, layout.prepared

    def forces(slip_front, slip_rear, instant):
        return hook(previous, slip_front, slip_rear, instant, instant.w[begin:end], instant.p.thetas[index])
    return forces


def _no_acceleration(instant):
    zero = 0.0 * instant.velocity_x
    return zero, zero, zero


def _add_acceleration(previous, layout):
    hook, index, (begin, end) = layout.effect.acceleration, layout.index, layout.prepared

    def acceleration(instant):
        x, y, yaw = previous(instant)
        a_x, a_y, a_yaw = hook(instant, instant.w[begin:end], instant.p.thetas[index])
        return x + a_x, y + a_y, yaw + a_yaw
    return acceleration


def _add_rates(previous, layout):
    hook, index, (begin, end), (first, last) = layout.effect.rates, layout.index, layout.prepared, layout.extra

    def rates(state, slips, forces, instant):
        own_rates = hook(state[first:last], slips, forces, instant, instant.w[begin:end], instant.p.thetas[index])
        return *previous(state, slips, forces, instant), *own_rates
    return rates
