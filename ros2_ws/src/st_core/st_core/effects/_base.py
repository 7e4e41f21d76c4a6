"""Base class of effects, their parameters, and the registry."""

import math
import re
import sys
from collections import namedtuple
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from numbers import Real
from types import FunctionType
from typing import Any, ClassVar

from ..channels import CHANNELS
from ..errors import ConfigurationError
from ..models import MODELS, TYRE_MODELS
from ..yaml_text import suggest_key

DYNAMIC, ANY = frozenset(TYRE_MODELS), frozenset(MODELS)

EFFECT_KINDS = ("sensors", "vehicle parameters", "physics", "environment")
SLOTS = ("steering", "front axle", "rear axle", "both axles", "body",
         "position", "velocity", "heading", "yaw rate", "acceleration")
REAR_STEERING = "rear-wheel steering"  # outside the library; see `discovery.discover.describe_common_cause`
TOTAL_DELAY = "total delay of the steering"  # dead time plus lag; how a fit divides this sum depends on the model
COMBINATIONS = {"front cornering stiffness over axle load": "1/rad", "rear cornering stiffness over axle load": "1/rad",
                "stability factor K": "s^2/m^2", "steady-state yaw gain at 20 m/s": "1/s",
                TOTAL_DELAY: "s"}
"""Combinations of vehicle parameters that predictions depend on, with their units; the parameters in one combination
are not separable. Yaw inertia over mass is left out, because delays and relaxation have a similar influence: for cars
with other dynamics, four of six estimated intervals did not contain the true value."""
FORCE_COMBINATIONS = tuple(name for name in COMBINATIONS if name != TOTAL_DELAY)

NO_HOOK: Any = None  # value of a hook that an effect does not define


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect. Raises ConfigurationError for an empty field, or fields that contradict each other."""

    name: str
    unit: str
    null: float  # value at which the effect has no influence
    initial: float  # start value of a fit, of typical magnitude
    bounds: tuple[float, float]  # physical limits, inclusive
    source: str  # origin of initial and bounds
    meaning: str  # short text, with the sign
    odd: bool = False  # whether it changes sign if left and right are exchanged
    fit: bool = True  # False: a constant of the car, which is `null` if no value is given
    identity: str = ""  # name of the estimate of the same quantity in `st_core.checks.check`, with equal unit and sign
    theory: float | None = None  # physical value, if it is the same for every car
    quantity: str = ""  # key of the vehicle file to which the value is added, if no hook `vehicle` or `fold` does so
    shape_bounds: tuple[float, ...] = ()  # those of `bounds` that only limit the shape of a curve; not physical
    # Standard deviation of the values that models with different equations give for one car (`bench/strangers`).
    model_error: float = 0.0
    # Standard deviation of a prior about null, for an addition to the car of the vehicle file, such as a load. For such
    # a parameter the uncertainties of the file are not used. inf: no such prior.
    deviation: float = math.inf

    def __post_init__(self):
        low, high = self.bounds
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ConfigurationError(f"parameter {self.name}: bounds {self.bounds} are not finite and increasing")
        for key in ("null", "initial", "theory"):
            value = getattr(self, key)
            if value is not None and not low <= value <= high:
                raise ConfigurationError(f"parameter {self.name}: {key} is outside the bounds")
        if self.fit and self.null == self.initial:
            raise ConfigurationError(f"parameter {self.name}: initial equals null; give a value of typical magnitude")
        for key in ("name", "unit", "source", "meaning"):
            if not str(getattr(self, key)).strip():
                raise ConfigurationError(f"parameter {self.name}: {key} is empty")

    @property
    def hard_bounds(self) -> tuple[float, ...]:
        """Bounds at which an estimate is invalid: `physical_bounds`; none for a parameter with `shape_bounds`."""
        return () if self.shape_bounds else self.physical_bounds

    @property
    def physical_bounds(self) -> tuple[float, ...]:
        """Bounds that the interval of a named effect must not reach: all but null, theory and `shape_bounds`."""
        return tuple(bound for bound in self.bounds if bound not in (self.null, self.theory, *self.shape_bounds))

    def check(self, value: float, key: str) -> float:
        """The value as a float. Raises ConfigurationError, naming the key, if it is not a number within the bounds."""
        low, high = self.bounds
        if isinstance(value, bool) or not isinstance(value, Real):
            raise ConfigurationError(f"{key}: {value!r} is not a number")
        if not low <= value <= high:  # NaN is outside too
            raise ConfigurationError(f"{key}: {value!r} is outside {low:g} to {high:g} {self.unit}".removesuffix(" 1"))
        return float(value)


Instant = namedtuple("Instant", ("x", "y", "velocity_x", "velocity_y", "yaw", "yaw_rate", "road_wheel_angle",
                                 "velocity_x_dot", "w", "p"))
Instant.__doc__ = """State at the CG, and inputs after the steering effects, at one instant; SI units. w, p: inputs and
parameters of the whole model, for `forces`."""
Measured = namedtuple("Measured", ("x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "acceleration_x",
                                   "acceleration_y", "yaw_acceleration"), defaults=(0.0,))
Measured.__doc__ = """Readings of the INS: position in the map frame [m], yaw [rad], velocity [m/s] and acceleration
[m/s^2] of the INS point in body axes, yaw rate [rad/s] and its derivative yaw_acceleration [rad/s^2]; 0 if unknown."""


class Effect:
    """One physical effect: its description, its parameters, and hooks, functions by which it changes a model.

    Every hook is an optional @staticmethod. `theta` has the parameters by name, and the result of `constants` as
    `theta.constants`. The hooks from `inputs` on are also called with arrays; `inputs` to `rates` are compiled, and
    called with symbols. They use only arithmetic and `st_core.ops`, do not branch on a value, and return tuples.
    `instant`: an Instant. `prepared`: the result of `prepare`, or the declared `signals` if there is no `prepare`.

        constants(vehicle) -> numbers of the car for the other hooks, as a NamedTuple (or one float)
        vehicle(vehicle, theta) -> changed VehicleParameters; called once for a set of values, without theta.constants
        fold(vehicle, theta) -> VehicleParameters that contain the effect exactly, for a vehicle file; default `vehicle`
        steering(time, angle, is_start, theta) -> changed (time [s], road wheel angle [rad]); arrays of a whole
            recording, for effects with memory; is_start: True at the start and after each gap, where memory is reset
        inputs(road_wheel_angle, velocity_x_dot, signals, theta) -> (angle, acceleration), changed; once per instant
        prepare(road_wheel_angle, velocity_x_dot, signals, theta) -> tuple named by `prepared`; called once per instant
        slip_angles(slip_front, slip_rear, extra, instant, prepared, theta) -> changed (slip_front, slip_rear)
        axle_forces(forces, slip_front, slip_rear, instant, prepared, theta) -> (front, rear) [N]
            forces(slip_front, slip_rear, instant) -> (front, rear) [N] without the effect
        acceleration(instant, prepared, theta) -> additional acceleration (x [m/s^2], y [m/s^2], yaw [rad/s^2])
        start(slips, instant, prepared, theta) -> initial values of `extra_states`; default 0
        rates(extra, slips, forces, instant, prepared, theta) -> time derivatives of `extra_states`; slips, forces:
            geometric slip angles [rad] and axle forces [N], (front, rear) each
        specific_force(instant, prepared, theta) -> (a_x, a_y) [m/s^2] that an accelerometer at the CG reads in
            addition to the acceleration of the car
        observe(measured, theta) -> the readings that result from true values; correct(measured, theta): the inverse,
            default `observe` with -value for parameters whose null is 0, and 1 / value for the others
    """

    name: ClassVar[str]  # unique; default: the name of its file
    parameter: ClassVar[Parameter]  # short for `parameters` with one entry
    physics: ClassVar[str]  # the equation in one line, with the sign
    excited_by: ClassVar[str]  # driving that makes it observable
    kind: ClassVar[str]  # one of EFFECT_KINDS
    slot: ClassVar[str]  # one of SLOTS, where it acts
    parameters: ClassVar[tuple[Parameter, ...]]
    # Effects that are hard to separate from this one, according to the sensitivities of the model in circle,
    # step, sweep and ramp_to_limit. It is enough that one of the two names the other.
    confounded_with: ClassVar[tuple[str, ...]] = ()
    needs: ClassVar[tuple[str, ...]] = ()  # channels required to observe the effect and separate it from others
    members: ClassVar[tuple[str, ...]] = ()  # effects that it combines
    combinations: ClassVar[tuple[str, ...]] = ()  # COMBINATIONS that the effect changes
    imitated_by: ClassVar[str] = ""  # causes outside the library that have the same influence
    ratio_to: ClassVar[tuple[str, ...]] = ()  # keys of the file; only ratios of its quantity to these are observable
    at_peak_force: ClassVar[bool] = False  # whether it is observable only near the peak force of an axle
    applies_to: ClassVar[frozenset[str]] = DYNAMIC  # base models that it can be added to
    converts: ClassVar[tuple[str, str] | None] = None  # (from, to) base model, if it turns one into another
    signals: ClassVar[tuple[str, ...]] = ()  # inputs that it requires in addition to steering angle and acceleration
    prepared: ClassVar[tuple[str, ...]] = ()  # names of the results of `prepare`
    extra_states: ClassVar[tuple[str, ...]] = ()  # names of its states
    extra_units: ClassVar[tuple[str, ...]] = ()  # units of its states
    costly: ClassVar[bool] = False  # whether it evaluates the tyre model again; left out at null values to save time
    # Whether the search adds it only in forward steps: in a joint fit of all effects it would absorb parts of others.
    forward_only: ClassVar[bool] = False
    order: ClassVar[int] = 50  # effects with the same hook act in ascending order
    Theta: ClassVar[Callable[..., Any]]

    constants = vehicle = fold = steering = inputs = prepare = slip_angles = axle_forces = NO_HOOK
    acceleration = start = rates = specific_force = observe = correct = NO_HOOK


def scale_entry(key):
    """The hook `vehicle` that multiplies an entry of the vehicle file by the parameter `factor`."""
    return staticmethod(lambda vehicle, theta: replace(vehicle, **{key: getattr(vehicle, key) * theta.factor}))


HOOKS = tuple(name for name, value in vars(Effect).items() if value is NO_HOOK and name != "converts")
EQUATION_HOOKS = ("slip_angles", "axle_forces", "acceleration", "rates", "specific_force")
EFFECTS: dict[str, type[Effect]] = {}  # the library, from which a search selects
UNLISTED_EFFECTS: dict[str, type[Effect]] = {}  # effects that a search does not select; only `get_effect` finds them


def register(effect: type[Effect], registry: dict[str, type[Effect]] = EFFECTS) -> type[Effect]:
    """Class decorator: checks an effect and adds it to the registry. Raises ConfigurationError naming the problem."""
    name = effect.__dict__.get("name", effect.__module__.rpartition(".")[2])
    if not issubclass(effect, Effect) or not isinstance(name, str) or not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise ConfigurationError(f"{effect.__qualname__}: must be a subclass of Effect with a name of a-z, 0-9 and _; "
                                 "the default name is that of its file")
    effect.name = name
    if effect.__dict__.get("kind") == "surroundings":  # the former name, still accepted
        effect.kind = "environment"
    if "parameter" in effect.__dict__:
        effect.parameters = (effect.parameter,)
    if existing := EFFECTS.get(name) or UNLISTED_EFFECTS.get(name):
        raise ConfigurationError(f"effect {name}: already registered by {find_source_file(existing)}")
    for problem in chain(_check_declarations(effect), _check_names(effect)):
        raise ConfigurationError(f"effect {name}: {problem}")
    names = [*(p.name for p in effect.parameters), "constants"]
    theta = namedtuple("Theta", names, module=effect.__module__)  # type: ignore[misc]  # names known at run time only
    theta.__qualname__ = f"{effect.__qualname__}.Theta"  # path by which the type is pickled, for the cache of kernels
    effect.Theta = theta
    if effect.fold is None and effect.vehicle:
        effect.fold = staticmethod(effect.vehicle)
    if effect.correct is None and effect.observe:
        effect.correct = staticmethod(_make_correction(effect))
    registry[name] = effect
    return effect


def _make_correction(effect: type[Effect]) -> Callable:
    def correct(measured, theta):
        values = {p.name: getattr(theta, p.name) for p in effect.parameters if p.fit}
        opposite = {p.name: 1.0 / values[p.name] if p.null else -values[p.name] for p in effect.parameters if p.fit}
        return effect.observe(measured, theta._replace(**opposite))
    return correct


def _check_declarations(effect: type[Effect]) -> Iterator[str]:
    for key, value in vars(effect).items():
        if key.startswith("_"):
            continue
        if key not in vars(Effect) and key not in Effect.__annotations__:
            suggestion = suggest_key(key, [*vars(Effect), *Effect.__annotations__])
            yield f"unknown attribute {key}{suggestion or ': remove it, or look for its new name in CHANGELOG.md'}"
        if key in HOOKS and not (isinstance(value, staticmethod) and isinstance(value.__func__, FunctionType)):
            yield f"{key} must be a @staticmethod"
    for key in ("physics", "excited_by"):
        if not str(getattr(effect, key, "")).strip():
            yield f"{key} is missing"
    for key, choices in (("kind", EFFECT_KINDS), ("slot", SLOTS)):
        if not hasattr(effect, key):
            yield f"{key} is missing; choose one of {', '.join(choices)}"
        elif getattr(effect, key) not in choices:
            yield f"{key} {getattr(effect, key)!r} is not one of {', '.join(choices)}"
    if isinstance(getattr(effect, "parameters", None), Parameter):
        yield "parameters must be a tuple; declare one parameter by parameter = Parameter(...)"
    elif not any(p.fit for p in getattr(effect, "parameters", ())):
        yield "it has no parameter that can be fitted"
    if not effect.converts and not any(getattr(effect, hook) for hook in HOOKS if hook not in ("constants", "fold")):
        yield "it has no hook, so it changes nothing"


def _check_names(effect: type[Effect]) -> Iterator[str]:
    if not effect.applies_to or not effect.applies_to <= ANY:
        yield f"applies_to must name one or more of {', '.join(MODELS)}"
    for key in ("confounded_with", "needs", "members", "combinations"):
        if not isinstance(getattr(effect, key), tuple):
            yield f"{key} must be a tuple of names, even for one name: (\"name\",)"
    for key, choices in (("needs", CHANNELS), ("combinations", COMBINATIONS)):
        if not set(getattr(effect, key)) <= set(choices):
            yield f"{key} may only name {', '.join(choices)}"
    if effect.members and (len(set(effect.members)) < 2 or effect.name in effect.members):
        yield "members must name two or more other effects"
    names = [p.name for p in effect.parameters]
    if len(set(names)) != len(names) or "constants" in names:
        yield f"parameters {', '.join(names)}: a name is used twice, or the reserved name constants is used"
    if bool(effect.extra_states) != (effect.rates is not None):
        yield "extra_states and rates must be declared together"
    if effect.extra_units and len(effect.extra_units) != len(effect.extra_states):
        yield "extra_units and extra_states differ in length"
    if bool(effect.prepared) != (effect.prepare is not None):
        yield "prepare and prepared, the names of its results, must be declared together"
    if effect.correct and not effect.observe:
        yield "correct is the inverse of observe, which is missing"


def find_source_file(effect: type[Effect]) -> str:
    """Path of the file that defines an effect; compiled functions are outdated when it changes."""
    return str(getattr(sys.modules.get(effect.__module__), "__file__", effect.__module__))


def get_effect(name: str) -> type[Effect]:
    """The effect with this name; raises ConfigurationError, with a similar name if there is one."""
    if name in UNLISTED_EFFECTS:
        return UNLISTED_EFFECTS[name]
    if name not in EFFECTS:
        raise ConfigurationError(f"unknown effect {name!r}{suggest_key(name, EFFECTS)}; if it is your own, give the "
                                 f"folder of its file with --effects; known effects: {', '.join(sorted(EFFECTS))}")
    return EFFECTS[name]


def find_confounded_effects(name: str) -> set[str]:
    """Names of the effects in `confounded_with` of this effect, and of those that name it in theirs."""
    others = {other for other, effect in EFFECTS.items() if name in effect.confounded_with}
    return others.union(get_effect(name).confounded_with)


def find_applicable_effects(model: str) -> tuple[str, ...]:
    """Names of the effects that apply to a base model, sorted."""
    return tuple(sorted(name for name, effect in EFFECTS.items() if model in effect.applies_to))
