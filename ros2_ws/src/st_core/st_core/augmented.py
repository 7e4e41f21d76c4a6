"""Models with effects, created by `augment(base, {effect: {parameter: value}})` and accepted by every backend."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from .composition import AugmentedParameters, change_inputs, compose
from .effects import Effect, Measured, Parameter, get_effect
from .errors import ConfigurationError
from .models import Model, get_model
from .vehicle import VehicleParameters

Values = Mapping[str, Mapping[str, float]]


@dataclass(frozen=True, eq=False)
class AugmentedModel(Model):
    """A base model with effects and the values of their parameters, created by `augment`.

    `effective_vehicle` applies the effects to the vehicle parameters, `steering` to a recorded road wheel angle;
    `observe` and `correct` convert true values to INS readings and back. Models that differ only in values share their
    compiled functions.
    """

    base: Model = field(kw_only=True)  # model without effects
    effects: tuple[type[Effect], ...] = field(kw_only=True)  # in the order in which they act
    values: Values = field(kw_only=True)  # by effect and parameter

    @cached_property
    def free_parameters(self) -> tuple[tuple[str, Parameter], ...]:
        """(effect name, parameter) of all parameters that a fit may change, in the order of `vector`."""
        return tuple((e.name, p) for e in self.effects for p in e.parameters if p.fit)

    @property
    def vector(self) -> np.ndarray:
        """Values of the `free_parameters`."""
        return np.array([self.values[effect][p.name] for effect, p in self.free_parameters])

    def with_vector(self, vector: Sequence[float]) -> "AugmentedModel":
        """The model with other values of the `free_parameters`. Raises ConfigurationError for a value out of bounds."""
        values: dict[str, dict[str, float]] = {}
        for (effect, parameter), value in zip(self.free_parameters, vector, strict=True):
            if value != self.values[effect][parameter.name]:
                values.setdefault(effect, {})[parameter.name] = value
        return self.with_values(values)

    def with_values(self, values: Values) -> "AugmentedModel":
        """The model with other values. Raises ConfigurationError for an unknown name or a value outside its bounds."""
        for name in set(values) - set(self.values):
            raise ConfigurationError(f"effect {name}: not in this model; it has {', '.join(self.values) or 'none'}")
        changed = [e for e in self.effects if e.name in values]
        merged = {e.name: {**self.values[e.name], **values[e.name]} for e in changed}
        return _compose(self.base, self.effects, {**self.values, **_check_all_values(changed, merged)})

    @property
    def has_tyres(self) -> bool:
        return self.base.has_tyres or any(effect.converts for effect in self.active_effects)

    @property
    def has_steering_dynamics(self) -> bool:
        """Whether `steering` changes a recording; the road wheel angle then depends on earlier steering."""
        return any(effect.steering for effect in self.active_effects)

    @property
    def has_sensor_effects(self) -> bool:
        """Whether `observe` and `correct` change readings."""
        return any(effect.observe for effect in self.active_effects)

    @property
    def correction_key(self) -> tuple:
        """Cache key of a corrected recording; equal for models with the same `steering` and `correct`."""
        return tuple((e.name, *self.values[e.name].values()) for e in self.active_effects if e.steering or e.observe)

    def effective_vehicle(self, vehicle: VehicleParameters) -> VehicleParameters:
        """The vehicle with the active effects applied. Raises ConfigurationError if a parameter leaves its limits."""
        cached = self._vehicles.get(id(vehicle))
        if cached is None or cached[0] is not vehicle:
            changed = vehicle
            for effect in self.active_effects:
                if effect.vehicle:
                    changed = effect.vehicle(changed, self._theta(effect))
            cached = self._vehicles[id(vehicle)] = vehicle, changed
        return cached[1]

    def without_costly_null_effects(self) -> "AugmentedModel":
        """The model without its inactive costly effects; its predictions are bit-identical."""
        return self.select_effects(e for e in self.effects if e in self.active_effects or not e.costly)

    def select_effects(self, effects: Iterable[type[Effect]]) -> "AugmentedModel":
        """The model restricted to some of its effects."""
        selected = tuple(effects)
        return self if len(selected) == len(self.effects) else _compose(self.base, selected, self.values)

    def steering(self, time: np.ndarray, angle: np.ndarray, is_start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Time [s] and road wheel angle [rad], with delay, play and lag applied to a steering recording.

        time: increasing, from any origin. is_start: True at the first sample and after gaps, where the effects restart.
        """
        for effect in self.active_effects:
            if effect.steering:
                time, angle = effect.steering(time, angle, is_start, self._theta(effect))
        return time, angle

    def effective_road_wheel_angle(self, angle: Any, vehicle: VehicleParameters) -> Any:
        """Road wheel angle [rad] that enters the equations at a recorded angle (float or array): with the effects of
        ratio, offset and map, but without the effects that need signals or act in `steering`."""
        effects = compose(self.base, self.effects).effects
        hooks = [(index, e.inputs, ()) for index, e in enumerate(effects) if e.inputs and not e.signals]
        return change_inputs(hooks, angle, 0.0 * angle, (), self.parameters(vehicle).thetas)[0] if hooks else angle

    def observe(self, measured: Measured) -> Measured:
        """INS readings of true values at the INS point."""
        for effect in self.active_effects:
            if effect.observe:
                measured = effect.observe(measured, self._theta(effect))
        return measured

    def correct(self, measured: Measured) -> Measured:
        """True values at the INS point from INS readings; the inverse of `observe`."""
        for effect in reversed(self.active_effects):
            if effect.correct:
                measured = effect.correct(measured, self._theta(effect))
        return measured

    @cached_property
    def _vehicles(self) -> dict[int, tuple[VehicleParameters, VehicleParameters]]:
        """Cache of `effective_vehicle`, which is called for every prediction."""
        return {}

    @cached_property
    def active_effects(self) -> tuple[type[Effect], ...]:
        """Effects with a free parameter that is not at its null value; others leave predictions bit-identical."""
        return tuple(e for e in self.effects
                     if any(p.fit and self.values[e.name][p.name] != p.null for p in e.parameters))

    def _theta(self, effect: type[Effect]) -> Any:
        return effect.Theta(**self.values[effect.name], constants=())


def augment(base: str | Model, effects: Values | Iterable[str]) -> AugmentedModel:
    """The base model with additional effects.

    effects: values by effect and parameter; or one or more names, which then have their initial values. Parameters with
    fit=False are optional, and null by default. Raises ConfigurationError, naming effect, parameter and limit, for a
    missing value or one out of bounds, an unknown parameter, and an effect that is unknown, repeated or does not apply.
    """
    base = get_model(base)
    if not isinstance(effects, Mapping):
        names = [effects] if isinstance(effects, str) else list(effects)
        if len(set(names)) != len(names):
            raise ConfigurationError(f"effects {', '.join(names)}: duplicate name; give each effect once")
        effects = {n: {p.name: p.initial for p in get_effect(n).parameters} for n in names}
    if isinstance(base, AugmentedModel):
        for name in effects:
            if name in base.values:
                raise ConfigurationError(f"effect {name}: already in the model; change its values instead")
        effects = {**base.values, **effects}
        base = base.base
    ordered = sorted((get_effect(name) for name in effects), key=lambda effect: (effect.order, effect.name))
    models = {base.name}
    # A conversion may depend on the result of another, so one pass per conversion is needed.
    conversions = [effect.converts for effect in ordered if effect.converts]
    for _ in conversions:
        models |= {to for start, to in conversions if start in models}
    for effect in ordered:
        if not effect.applies_to & models:
            allowed = " or ".join(sorted(effect.applies_to))
            raise ConfigurationError(f"effect {effect.name}: does not apply to a {base.name} model, only to {allowed}")
    return _compose(base, tuple(ordered), _check_all_values(ordered, effects))


def _compose(base: Model, effects: tuple[type[Effect], ...], values: Values) -> AugmentedModel:
    """Combine a base model and effects. values: already checked; those of other effects are ignored."""
    values = MappingProxyType({e.name: values[e.name] for e in effects})
    composed = compose(base, effects)

    def parameters(vehicle: VehicleParameters) -> Any:
        vehicle = model.effective_vehicle(vehicle)
        base_parameters = base.parameters(vehicle)
        if not composed.effects:
            return base_parameters
        return AugmentedParameters(base_parameters, tuple(
            e.Theta(**values[e.name], constants=e.constants(vehicle) if e.constants else ()) for e in composed.effects))

    model = AugmentedModel("augmented", parameters, composed.inputs, composed.rhs, composed.extra_states,
                           composed.start, composed.signals, base=base, effects=effects, values=values)
    return model


def _check_all_values(effects: Iterable[type[Effect]], values: Values) -> Values:
    checked = {}
    for effect in effects:
        given, result = values[effect.name], {}
        known = [parameter.name for parameter in effect.parameters]
        if unknown := [name for name in given if name not in known]:
            raise ConfigurationError(f"effect {effect.name}: {unknown[0]}: unknown parameter; it has "
                                     f"{', '.join(known)}")
        for parameter in effect.parameters:
            key = f"effect {effect.name}: {parameter.name}"
            if parameter.name not in given and parameter.fit:
                raise ConfigurationError(f"{key}: no value given; add one")
            result[parameter.name] = parameter.check(given.get(parameter.name, parameter.null), key)
        checked[effect.name] = MappingProxyType(result)
    return checked


def fold_effects(vehicle: VehicleParameters, effects: Iterable[type[Effect]], values: Values) -> VehicleParameters:
    """The vehicle with effects folded into its parameters, so that predictions are the same without the effects.

    Each effect must define `fold`. If steering ratio or offset change, the road wheel angle must be recomputed
    (`DriveLog.with_steering`), and the play of steering_backlash divided by the factor of steering_ratio. Raises
    ConfigurationError for a value outside the limits of a vehicle file.
    """
    for effect in effects:
        assert effect.fold is not None
        vehicle = effect.fold(vehicle, effect.Theta(**values[effect.name], constants=()))
    return vehicle


def set_effects_to_null(model: AugmentedModel, effects: Iterable[type[Effect]] | None = None) -> AugmentedModel:
    """The model with null values for the parameters of the given effects, by default of all."""
    effects = model.effects if effects is None else effects
    return model.with_values({e.name: {p.name: p.null for p in e.parameters} for e in effects})
