"""The parameter vector of a discovery, and the priors from the vehicle file.

The vector contains all parameters of all effects that apply to the base model, and the gain of the accelerometer due to
body roll. One model, compiled once, serves all vectors.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from ..augmented import AugmentedModel, augment, set_effects_to_null
from ..effects import find_applicable_effects, get_effect
from ..errors import ConfigurationError
from ..models import Model, get_model
from ..vehicle import DEFAULT_UNCERTAINTIES, FILE_QUANTITIES, VehicleParameters, value_of
from .settings import DiscoverySettings

DIFFERENCE_STEP = 0.02  # step of the difference quotients, as a fraction of the parameter scale
ACCELEROMETER_GAIN = "acceleration_gain"
TYPICAL_GAIN, GAIN_BOUNDS = 0.05, (-0.3, 0.5)  # typical: roll gradient of 5 mrad/(m/s^2), times g


class Space:
    """Parameters of all effects that apply to a base model. not_searched: effects of the model that the search ignores.
    library: names of the effects to choose from, by default all that apply. Raises ConfigurationError if a requested
    effect does not apply, or if no effect remains.

    hypotheses: names of the effects that the search may add. without_signal: names of effects that need a signal that
    no drive has. parameters: (effect name, parameter) of each component of the vector but the last, the accelerometer
    gain. null: (p,) vector of the base model. scale: (p,) typical deviations from the null > 0, the units of steps and
    distances. sign: (p,) sign of initial - null. low, high: (p,) bounds. payloads: names of the effects that add a load
    to the car. deviation: (p,) prior standard deviation of the loads [parameter scales]; inf for other parameters."""

    def __init__(self, base: str | Model, settings: DiscoverySettings, not_searched: Sequence[str] = (),
                 library: Collection[str] | None = None):
        base = get_model(base)
        equations = base.base if isinstance(base, AugmentedModel) else base
        available = tuple(n for n in find_applicable_effects(equations.name) if library is None or n in library)
        self.without_signal = tuple(n for n in available if get_effect(n).signals)
        usable = [n for n in available if n not in self.without_signal]
        for name in settings.effects or ():
            get_effect(name)
            if name not in available:
                raise ConfigurationError(f"effects: {name} does not apply to this base model; available are "
                                         f"{', '.join(available)}")
        self.hypotheses = tuple(n for n in usable if (settings.effects is None or n in settings.effects)
                                and set(get_effect(n).needs) <= set(settings.channels))
        if not self.hypotheses:
            raise ConfigurationError("effects: none is usable with this base model, these channels and recorded "
                                     "signals")
        values = {n: dict(v) for n, v in base.values.items()} if isinstance(base, AugmentedModel) else {}
        self.model = set_effects_to_null(augment(equations, [*usable, *not_searched])).with_values(values)
        self.null = np.append(self.model.vector, 0.0)
        self.parameters = self.model.free_parameters
        self.scale = np.array([*(typical_size(e, p.unit) for e, p in self.parameters), TYPICAL_GAIN])
        self.sign = np.array([*(1.0 if p.initial > p.null else -1.0 for _, p in self.parameters), 1.0])
        self.low, self.high = np.array([*(p.bounds for _, p in self.parameters), GAIN_BOUNDS]).T
        self.deviation = np.array([*(p.deviation for _, p in self.parameters), np.inf]) / self.scale
        self.payloads = tuple(n for n in self.hypotheses
                              if any(p.deviation < math.inf for p in get_effect(n).parameters))
        self.effect_names = np.array([*(e for e, _ in self.parameters), ACCELEROMETER_GAIN])
        self._indices = {name: np.flatnonzero(self.effect_names == name).tolist() for name in {*self.effect_names}}

    def __len__(self) -> int:
        return len(self.scale)

    def at(self, vector: np.ndarray) -> AugmentedModel:
        """The model with the values of a vector, limited to the bounds."""
        return self.model.with_vector(self.clip_to_bounds(vector)[:-1].tolist())

    def clip_to_bounds(self, vector: np.ndarray) -> np.ndarray:
        return np.clip(vector, self.low, self.high)

    def indices(self, *names: str) -> np.ndarray:
        """Ascending indices in the vector of the parameters of the effects `names`."""
        return np.array(sorted({i for name in names for i in self._indices.get(name, ())}), int)

    def values(self, name: str, vector: np.ndarray) -> dict[str, float]:
        """Values of an effect in a vector, by parameter."""
        return {self.parameters[i][1].name: float(vector[i]) for i in self.indices(name)}

    def overlaps(self, name: str, names: Sequence[str]) -> bool:
        """Whether an effect or one of its members is one of `names` or a member of one."""
        parts = {name, *get_effect(name).members}
        return any(parts & {other, *get_effect(other).members} for other in names)


def typical_size(effect: str, unit: str) -> float:
    """Scale of all parameters of an effect with this unit, such as two wind speeds: the largest |initial - null|."""
    return max(abs(p.initial - p.null) for p in get_effect(effect).parameters if p.fit and p.unit == unit)


@dataclass(frozen=True)
class FileQuantity:
    """A quantity of the vehicle file that a parameter of an effect changes."""

    key: str
    unit: str
    value: float  # in the file [SI]
    deviation: float  # its standard deviation, from the file or a default [SI]
    slope: float  # change of the quantity per unit of the parameter
    stated: bool  # whether the file states the deviation; otherwise it is the default for the quantity
    # Value in a model without the effect; 0 if the equations of the base model do not contain the quantity [SI].
    without_effect: float

    def at(self, change: float) -> float:
        """The quantity [SI] at a parameter that differs by `change` from its null value."""
        return self.without_effect + self.slope * change

    def z_score(self, change: float) -> float:
        """Distance of the quantity from the file's value, in standard deviations."""
        return abs(self.at(change) - self.value) / self.deviation


Quantities = tuple[FileQuantity | None, ...]


def find_file_quantities(space: Space, vehicle: VehicleParameters) -> Quantities:
    """(p,) quantity of the vehicle file that each parameter changes most, in standard deviations, or None."""
    return (*(_find_changed_quantity(space, vehicle, i) for i in range(len(space.parameters))), None)


def prior_deviations(quantities: Quantities, scale: np.ndarray) -> np.ndarray:
    """(p,) prior standard deviation of each parameter [`scale`]; inf if the base model contains no such quantity."""
    return np.array([np.inf if q is None or q.without_effect != q.value else q.deviation / abs(q.slope) / s
                     for q, s in zip(quantities, scale, strict=True)])


def _find_changed_quantity(space: Space, vehicle: VehicleParameters, i: int) -> FileQuantity | None:
    """Quantity that parameter i changes: the declared one, or the one that the `fold` of its effect changes most."""
    (name, parameter), at_null = space.parameters[i], float(space.null[i])
    effect = get_effect(name)
    if parameter.quantity:
        # Equations that do not contain the quantity treat it as 0.
        without_effect = value_of(vehicle, parameter.quantity) if space.model.base.name == "nonlinear" else 0.0
        return _make_quantity(vehicle, parameter.quantity, 1.0, without_effect)
    if effect.fold is None or parameter.deviation < math.inf:
        return None
    null = {p.name: p.null for p in effect.parameters} | space.values(name, space.null)
    step = float(DIFFERENCE_STEP * space.scale[i] * space.sign[i])
    for change in (step, -step):
        try:
            before, after = (effect.fold(vehicle, effect.Theta(**null | {parameter.name: value}, constants=()))
                             for value in (at_null, at_null + change))
        except ConfigurationError:  # outside the limits of a vehicle file
            continue
        sensitivities = {key: (value_of(after, key) - value_of(before, key)) / change
                         for key in dict.fromkeys((*DEFAULT_UNCERTAINTIES, *vehicle.provenance))}
        changes = [_make_quantity(vehicle, key, slope, value_of(vehicle, key)) for key, slope in sensitivities.items()
                   if abs(slope) > 1e-9]
        return max(filter(None, changes), key=lambda q: abs(q.slope) / q.deviation, default=None)
    return None


def _make_quantity(vehicle: VehicleParameters, key: str, slope: float, without_effect: float) -> FileQuantity | None:
    """The `FileQuantity` of a key of the vehicle file; None if it has no standard deviation."""
    deviation, entry, quantity = vehicle.uncertainty(key), vehicle.provenance.get(key), FILE_QUANTITIES.get(key)
    return FileQuantity(key, quantity.si_unit if quantity else "1", value_of(vehicle, key), deviation, slope,
                        bool(entry and entry.uncertainty), without_effect) if deviation else None
