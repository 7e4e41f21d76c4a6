"""The numbers a discovery may change: all parameters of all effects of the library, and how much a roll of the body
adds to the accelerometer. One vector; one set of compiled functions for all its values."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from ..augmented import AugmentedModel, augment, neutral
from ..effects import EFFECTS, applicable, get_effect
from ..errors import ConfigurationError
from ..models import Model, get_model
from .settings import DiscoverySettings

GAIN = "acceleration_gain"
GAIN_USUAL, GAIN_BOUNDS = 0.05, (-0.3, 0.5)  # body roll of 5 mrad s^2/m, times g


@dataclass(frozen=True)
class Free:
    """One number. usual: a usual size of it as a discovery, the unit of all that follows; > 0."""

    effect: str
    parameter: str
    unit: str
    null: float
    usual: float
    bounds: tuple[float, float]
    sign: float
    theory: float | None


class Space:
    """base: the model discoveries are changes of. more: effects of the model that are not searched.
    library: names of the effects to choose from, all that apply if not given.
    hypotheses: names of the effects that take part. null: (p,) the vector of the base; scale, low, high: (p,) usual
    sizes and bounds."""

    def __init__(self, base: str | Model, settings: DiscoverySettings, more: Sequence[str] = (),
                 library: Collection[str] | None = None):
        base = get_model(base)
        kind = base.base if isinstance(base, AugmentedModel) else base
        known = tuple(n for n in applicable(kind.name) if library is None or n in library)
        self.without_signal = tuple(n for n in known if get_effect(n).signals)
        takes_part = [n for n in known if n not in self.without_signal]
        self.hypotheses = _chosen(takes_part, settings, known)
        everything = neutral(augment(kind, [*takes_part, *more]))
        values = {n: dict(v) for n, v in base.values.items()} if isinstance(base, AugmentedModel) else {}
        self.model = everything.with_values(values)
        self.null = np.append(self.model.vector, 0.0)
        self.free = tuple(Free(e, p.name, p.unit, float(null), usual_size(e, p.unit), p.bounds,
                               1.0 if p.initial > p.null else -1.0, p.theory)
                          for (e, p), null in zip(self.model.free, self.null[:-1], strict=True))
        self.effect_of = np.array([f.effect for f in self.free] + [GAIN])
        self._places = {name: np.flatnonzero(self.effect_of == name).tolist() for name in dict.fromkeys(self.effect_of)}
        self.scale = np.array([f.usual for f in self.free] + [GAIN_USUAL])
        self.sign = np.array([f.sign for f in self.free] + [1.0])
        self.low = np.array([f.bounds[0] for f in self.free] + [GAIN_BOUNDS[0]])
        self.high = np.array([f.bounds[1] for f in self.free] + [GAIN_BOUNDS[1]])

    def __len__(self) -> int:
        return len(self.scale)

    def at(self, vector: np.ndarray) -> AugmentedModel:
        """The model at a vector; what is out of bounds is taken back to them."""
        return self.model.with_vector(self.inside(vector)[:-1].tolist())

    def inside(self, vector: np.ndarray) -> np.ndarray:
        return np.clip(vector, self.low, self.high)

    def indices(self, *names: str) -> np.ndarray:
        """Where the parameters of effects are in the vector, rising."""
        return np.array(sorted({i for name in names for i in self._places.get(name, ())}), int)

    def values(self, name: str, vector: np.ndarray) -> dict[str, float]:
        """Of an effect in a vector, by parameter."""
        return {self.free[i].parameter: float(vector[i]) for i in self.indices(name)}

    def overlaps(self, name: str, names: Sequence[str]) -> bool:
        """Whether an effect is one of `names`, or made of one of them, or one of them of it."""
        own = {name, *get_effect(name).members}
        return any(own & {other, *get_effect(other).members} for other in names)


def usual_size(effect: str, unit: str) -> float:
    """The largest |initial - null| of the effect's parameters of a unit: wind comes from any side."""
    return max(abs(p.initial - p.null) for p in get_effect(effect).parameters if p.fit and p.unit == unit)


def _chosen(takes_part: Sequence[str], settings: DiscoverySettings, known: Sequence[str]) -> tuple[str, ...]:
    requested = settings.effects
    for name in requested or ():
        if name not in EFFECTS:
            get_effect(name)
        if name not in known:
            raise ConfigurationError(f"effects: {name} does not apply to this base; there are {', '.join(known)}")
    chosen = tuple(n for n in takes_part if (requested is None or n in requested)
                   and set(get_effect(n).needs) <= set(settings.channels))
    if not chosen:
        raise ConfigurationError("effects: none of those requested can be tried on this base with these channels")
    return chosen
