"""Composition of a base model with effects: nested plain functions, the same for floats, arrays, compilers and CasADi.

The functions are created once per base and set of effects; values are only in their parameters p, so that a fit never
creates, traces or compiles them again. Layout of a composed model:

    p     = AugmentedParameters(base, effects): of the base model, and theta of each effect that acts in the equations
    w     = (road_wheel_angle, velocity_x_dot, what each effect prepared ..., w of the base model)
    state = the six, then the extra states of each effect

Effects at null change nothing, to the last bit: they add 0, multiply by 1, or blend with weight 0.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

from .effects import Effect, Instant
from .effects._base import EQUATION_HOOKS
from .models import Model, linear_tyre

STATES = 6


class AugmentedParameters(NamedTuple):
    """p of an augmented model. effects: one theta each, a tuple."""

    base: Any
    effects: tuple


@dataclass(frozen=True)
class Composed:
    """Functions of an augmented model. own: effects with a theta in p; without any, p is that of the base."""

    own: tuple[type[Effect], ...]
    inputs: Callable[..., tuple]
    rhs: Callable[[tuple, tuple, Any], tuple]
    start: Callable[[tuple, tuple, Any], tuple] | None = None
    specific_force: Callable[[tuple, tuple, Any], tuple] | None = None
    extra_states: tuple[str, ...] = ()
    signals: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Place:
    """Position of an effect: index of its theta in p, and (begin, end) of its entries in w and in the state."""

    effect: type[Effect]
    index: int
    given: tuple[int, int]
    extra: tuple[int, int]


@cache
def compose(base: Model, effects: tuple[type[Effect], ...]) -> Composed:
    """The functions of a base model with effects, in order of action; the same objects at every call."""
    own = tuple(e for e in effects if e.lifts or any(getattr(e, hook) for hook in ("inputs", *EQUATION_HOOKS)))
    if not own:
        return Composed((), base.inputs, base.rhs)
    signals = tuple(dict.fromkeys(name for effect in own for name in effect.signals))
    places = _places(own)
    changed = _changed_inputs(places, signals)
    if not any(e.lifts or getattr(e, hook) for e in own for hook in EQUATION_HOOKS):
        return Composed(own, _inputs_of_base(base.inputs, changed), _rhs_of_base(base.rhs), signals=signals)
    tail = places[-1].given[1]
    slips_of, forces_of, motion = _dynamics(base, places, tail)
    rhs = _rhs(slips_of, _slips(places), _forces(places, forces_of), motion, _acceleration(places), _rates(places))
    if base.axles is None:
        rhs = _blended(base.rhs, rhs, tail, _lift(places).index)
    extra = tuple(f"{e.name}.{name}" for e in own for name in e.extra_states)
    return Composed(own, _inputs(base.inputs, changed, _given(places, signals)), rhs,
                    _start(places, slips_of) if extra else None, _specific_force(places), extra, signals)


def _places(own: tuple[type[Effect], ...]) -> list[_Place]:
    places, w, state = [], 2, STATES
    for index, effect in enumerate(own):
        given = (w, w + len(effect.prepared or effect.signals))
        extra = (state, state + len(effect.extra_states))
        w, state = given[1], extra[1]
        places.append(_Place(effect, index, given, extra))
    return places


def _lift(places: list[_Place]) -> _Place:
    """Position of the effect that adds dynamics to a kinematic base."""
    return next(place for place in places if place.effect.lifts and place.effect.lifts[0] == "kinematic")


# Each function below returns a closure over plain functions and integers, which compilers can inline.

def _instant(state, w, p):
    return Instant(state[0], state[1], state[2], state[3], state[4], state[5], w[0], w[1], w, p)


def _dynamics(base: Model, places: list[_Place], tail: int):
    """Functions slips(at), forces(slip_front, slip_rear, at), motion(force_front, force_rear, at) of the dynamics."""
    if base.axles is None:
        lift, axles = _lift(places), linear_tyre.AXLES
        index, (begin, end) = lift.index, lift.given

        def own(at):
            return at.w[begin:end], at.p.effects[index].car
    else:
        axles = base.axles

        def own(at):
            return at.w[tail:], at.p.base

    slip_angles, axle_forces, axle_motion = axles.slip_angles, axles.forces, axles.motion

    def slips(at):
        w, p = own(at)
        state = at.x, at.y, at.velocity_x, at.velocity_y, at.yaw, at.yaw_rate
        return slip_angles(state, w, p)

    def forces(slip_front, slip_rear, at):
        w, p = own(at)
        return axle_forces(slip_front, slip_rear, w, p)

    def motion(force_front, force_rear, at):
        w, p = own(at)
        state = at.x, at.y, at.velocity_x, at.velocity_y, at.yaw, at.yaw_rate
        return axle_motion(state, force_front, force_rear, w, p)

    return slips, forces, motion


def _rhs(slips_of, slips, forces, motion, acceleration, rates):
    def rhs(state, w, p):
        at = _instant(state, w, p)
        geometric = slips_of(at)
        slip_front, slip_rear = slips(geometric[0], geometric[1], state, at)
        acting = forces(slip_front, slip_rear, at)
        x, y, velocity_x, velocity_y, yaw, yaw_rate = motion(acting[0], acting[1], at)
        a_x, a_y, a_yaw = acceleration(at)
        return x, y, velocity_x + a_x, velocity_y + a_y, yaw, yaw_rate + a_yaw, *rates(state, geometric, acting, at)
    return rhs


def _blended(kinematic, dynamic, tail, index):
    def rhs(state, w, p):
        share = p.effects[index].share
        remainder = 1.0 - share
        k = kinematic(state[:STATES], w[tail:], p.base)
        d = dynamic(state, w, p)
        return (remainder * k[0] + share * d[0], remainder * k[1] + share * d[1], remainder * k[2] + share * d[2],
                remainder * k[3] + share * d[3], remainder * k[4] + share * d[4], remainder * k[5] + share * d[5],
                *d[STATES:])
    return rhs


def _rhs_of_base(base_rhs):
    def rhs(state, w, p):
        return base_rhs(state, w, p.base)
    return rhs


def _inputs_of_base(base_inputs, changed):
    def inputs(road_wheel_angle, velocity_x_dot, p, *signals):
        angle, acceleration = changed(road_wheel_angle, velocity_x_dot, p, signals)
        return base_inputs(angle, acceleration, p.base)
    return inputs


def _inputs(base_inputs, changed, given):
    def inputs(road_wheel_angle, velocity_x_dot, p, *signals):
        angle, acceleration = changed(road_wheel_angle, velocity_x_dot, p, signals)
        own = given(angle, acceleration, p, signals)
        return angle, acceleration, *own, *base_inputs(angle, acceleration, p.base)
    return inputs


def _pick(signals: tuple[str, ...], selected: tuple[str, ...]):
    """Function from the values of all signals to those of the selected ones."""
    def nothing(values):
        return ()

    def after(inner, index):
        def pick(values):
            return *inner(values), values[index]
        return pick

    pick = nothing
    for name in selected:
        pick = after(pick, signals.index(name))
    return pick


def _changed_inputs(places: list[_Place], signals: tuple[str, ...]):
    def unchanged(angle, acceleration, p, values):
        return angle, acceleration

    def after(inner, hook, index, pick):
        def changed(angle, acceleration, p, values):
            angle, acceleration = inner(angle, acceleration, p, values)
            return hook(angle, acceleration, pick(values), p.effects[index])
        return changed

    changed = unchanged
    for place in places:
        if place.effect.inputs:
            changed = after(changed, place.effect.inputs, place.index, _pick(signals, place.effect.signals))
    return changed


def _given(places: list[_Place], signals: tuple[str, ...]):
    def nothing(angle, acceleration, p, values):
        return ()

    def after(inner, hook, index, pick):
        def given(angle, acceleration, p, values):
            before = inner(angle, acceleration, p, values)
            return *before, *hook(angle, acceleration, pick(values), p.effects[index])
        return given

    def pass_on(angle, acceleration, values, theta):
        return values

    given = nothing
    for place in places:
        if place.effect.prepare or place.effect.signals:
            pick = _pick(signals, place.effect.signals)
            given = after(given, place.effect.prepare or pass_on, place.index, pick)
    return given


def _chained(chain, after, places: list[_Place], hook: str, *own: str):
    """The chain extended by `after` for every effect with the hook; own: attributes of its position to pass on."""
    for place in places:
        if function := getattr(place.effect, hook):
            chain = after(chain, function, place.index, *(getattr(place, name) for name in own))
    return chain


def _slips(places: list[_Place]):
    def geometric(slip_front, slip_rear, state, at):
        return slip_front, slip_rear

    def after(inner, hook, index, given, extra):
        (begin, end), (first, last) = given, extra

        def slips(slip_front, slip_rear, state, at):
            front, rear = inner(slip_front, slip_rear, state, at)
            return hook(front, rear, state[first:last], at, at.w[begin:end], at.p.effects[index])
        return slips

    return _chained(geometric, after, places, "slip_angles", "given", "extra")


def _forces(places: list[_Place], forces_of):
    def after(inner, hook, index, given):
        begin, end = given

        def forces(slip_front, slip_rear, at):
            return hook(inner, slip_front, slip_rear, at, at.w[begin:end], at.p.effects[index])
        return forces

    return _chained(forces_of, after, places, "axle_forces", "given")


def _acceleration(places: list[_Place]):
    def none(at):
        zero = 0.0 * at.velocity_x
        return zero, zero, zero

    def after(inner, hook, index, given):
        begin, end = given

        def acceleration(at):
            x, y, yaw = inner(at)
            a_x, a_y, a_yaw = hook(at, at.w[begin:end], at.p.effects[index])
            return x + a_x, y + a_y, yaw + a_yaw
        return acceleration

    return _chained(none, after, places, "acceleration", "given")


def _rates(places: list[_Place]):
    def none(state, slips, forces, at):
        return ()

    def after(inner, hook, index, given, extra):
        (begin, end), (first, last) = given, extra

        def rates(state, slips, forces, at):
            own = hook(state[first:last], slips, forces, at, at.w[begin:end], at.p.effects[index])
            return *inner(state, slips, forces, at), *own
        return rates

    return _chained(none, after, places, "rates", "given", "extra")


def _start(places: list[_Place], slips_of):
    def none(slips, at):
        return ()

    def after(inner, hook, index, given):
        begin, end = given

        def start(slips, at):
            return *inner(slips, at), *hook(slips, at, at.w[begin:end], at.p.effects[index])
        return start

    def zeros(count):
        def hook(slips, at, given, theta):
            zero = 0.0 * at.velocity_x
            return (zero,) * count
        return hook

    chain = none
    for place in places:
        if place.effect.extra_states:
            hook = place.effect.start or zeros(len(place.effect.extra_states))
            chain = after(chain, hook, place.index, place.given)

    def start(state, w, p):
        at = _instant(state, w, p)
        return chain(slips_of(at), at)
    return start


def _specific_force(places: list[_Place]):
    def none(at):
        zero = 0.0 * at.velocity_x
        return zero, zero

    def after(inner, hook, index, given):
        begin, end = given

        def specific_force(at):
            x, y = inner(at)
            a_x, a_y = hook(at, at.w[begin:end], at.p.effects[index])
            return x + a_x, y + a_y
        return specific_force

    chain = _chained(none, after, places, "specific_force", "given")

    def specific_force(state, w, p):
        return chain(_instant(state, w, p))
    return None if chain is none else specific_force
