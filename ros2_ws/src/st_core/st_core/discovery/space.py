"""The numbers a discovery may change: all parameters of all effects of the library, and how much a roll of the body
adds to the accelerometer. One vector; one set of compiled functions for all its values."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..augmented import AugmentedModel, augment, neutral
from ..effects import EFFECTS, applicable, get_effect
from ..errors import ConfigurationError
from ..models import Model, get_model
from .settings import DiscoverySettings

GAIN = "acceleration_gain"
GAIN_USUAL, GAIN_SPREAD, GAIN_BOUNDS = 0.05, 0.05, (-0.3, 0.5)  # body roll 2 to 8 mrad s^2/m, times g
ALWAYS = {"steered_drive_force": {"share": 1.0}}  # of every car, missing in the models of the paper only
THEORY = {"lateral_load_transfer": {"share": 1.0}, "combined_slip": {"share": 1.0}}  # a real car has these
LIFTED = ("tyre_slip", "tyre_saturation")  # what turns one base into the next is never a nuisance


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


class Space:
    """base: the model discoveries are changes of. names: hypotheses, the effects that take part."""

    def __init__(self, base: str | Model, settings: DiscoverySettings):
        base = get_model(base)
        kind = base.base if isinstance(base, AugmentedModel) else base
        known = applicable(kind.name)
        self.without_signal = tuple(n for n in known if get_effect(n).signals)
        takes_part = [n for n in known if n not in self.without_signal]
        self.hypotheses = _chosen(takes_part, settings.effects, known)
        everything = neutral(augment(kind, takes_part))
        values = {n: dict(v) for n, v in base.values.items()} if isinstance(base, AugmentedModel) else {}
        for name, given in ALWAYS.items():
            if name in takes_part and name not in values:
                values[name] = given
        self.model = everything.with_values(values)
        self.free = tuple(Free(e, p.name, p.unit, p.null, usual_size(e, p.unit), p.bounds,
                               1.0 if p.initial > p.null else -1.0) for e, p in self.model.free)
        self.effect_of = np.array([f.effect for f in self.free] + [GAIN])
        self.scale = np.array([f.usual for f in self.free] + [GAIN_SPREAD])
        self.low = np.array([f.bounds[0] for f in self.free] + [GAIN_BOUNDS[0]])
        self.high = np.array([f.bounds[1] for f in self.free] + [GAIN_BOUNDS[1]])
        self.start = np.append(self.model.vector, GAIN_USUAL)
        real = {n: v for n, v in THEORY.items() if n in takes_part and n not in values}
        self.healthy = np.append(self.model.with_values(real).vector, GAIN_USUAL)

    @property
    def key(self) -> tuple:
        """The same for two spaces of the same numbers."""
        return self.model.base.name, tuple(self.effect_of), self.start.tobytes()

    def __len__(self) -> int:
        return len(self.scale)

    def at(self, vector: np.ndarray) -> AugmentedModel:
        """The model at a vector; what is out of bounds is taken back to them."""
        return self.model.with_vector(self.inside(vector)[:-1])

    def inside(self, vector: np.ndarray) -> np.ndarray:
        return np.clip(vector, self.low, self.high)

    def indices(self, *names: str) -> np.ndarray:
        """Where the parameters of effects are in the vector."""
        return np.flatnonzero(np.isin(self.effect_of, names))


def usual_size(effect: str, unit: str) -> float:
    """The largest |initial - null| of the effect's parameters of a unit: wind comes from any side."""
    return max(abs(p.initial - p.null) for p in get_effect(effect).parameters if p.fit and p.unit == unit)


def _chosen(takes_part: Sequence[str], wanted: Sequence[str] | None, known: Sequence[str]) -> tuple[str, ...]:
    for name in wanted or ():
        if name not in EFFECTS:
            get_effect(name)
        if name not in known:
            raise ConfigurationError(f"effects: {name} does not apply to this base; there are {', '.join(known)}")
    chosen = tuple(n for n in takes_part if (wanted is None or n in wanted) and n not in ALWAYS)
    if not chosen:
        raise ConfigurationError("effects: none of those wanted can be tried on this base")
    return chosen
