"""How well the vehicle file fixes what an effect changes: standard deviations of its quantities, by parameter."""

from dataclasses import dataclass

import numpy as np

from ..effects import get_effect
from ..errors import ConfigurationError
from ..identification.apply import value_of
from ..identification.result import quantity
from ..vehicle import DEFAULT_UNCERTAINTIES, VehicleParameters
from .space import Space

NUDGE = 0.02  # of the usual size of an effect: step of the difference quotient


@dataclass(frozen=True)
class Known:
    """A quantity of the vehicle file that a parameter of an effect changes.

    key: of the file. unit: SI. value, deviation [SI]: as the file has it. slope: change of the quantity per unit of the
    parameter. stated: whether the file states the deviation; otherwise it is the default of the quantity. absent: value
    of the quantity in a model without the effect [SI]; another one than `value` where the base model leaves it out.
    """

    key: str
    unit: str
    value: float
    deviation: float
    slope: float
    stated: bool
    absent: float

    def at(self, change: float) -> float:
        """The quantity [SI] when the parameter differs by `change` from where nothing is changed."""
        return self.absent + self.slope * change

    def deviations(self, change: float) -> float:
        """Distance of that from the file's value, in standard deviations."""
        return abs(self.at(change) - self.value) / self.deviation


Quantities = tuple[Known | None, ...]


def known_quantities(space: Space, vehicle: VehicleParameters) -> Quantities:
    """(p,) for each number of the space, the quantity that the file fixes best of those it changes; None for none."""
    return (*(_known(space, vehicle, i) for i in range(len(space.free))), None)


def prior_deviations(known: Quantities, scale: np.ndarray) -> np.ndarray:
    """(p,) standard deviation of each number of a space about its null, in usual sizes `scale`; inf where it is free.
    """
    return np.array([np.inf if k is None or k.absent != k.value else k.deviation / abs(k.slope) / s
                     for k, s in zip(known, scale, strict=True)])


def _known(space: Space, vehicle: VehicleParameters, i: int) -> Known | None:
    free = space.free[i]
    effect = get_effect(free.effect)
    parameter = next(p for p in effect.parameters if p.name == free.parameter)
    if parameter.quantity:
        # A base model without the quantity in its equations lacks all of it.
        absent = value_of(vehicle, parameter.quantity) if space.model.base.name == "nonlinear" else 0.0
        return _of(vehicle, parameter.quantity, 1.0, absent)
    if effect.fold is None or effect.on_top:
        return None
    null = {p.name: p.null for p in effect.parameters} | space.values(free.effect, space.null)
    step = NUDGE * free.usual * free.sign
    for change in (step, -step):
        try:
            before, after = (effect.fold(vehicle, effect.Theta(**null | {free.parameter: value}, car=()))
                             for value in (free.null, free.null + change))
        except ConfigurationError:  # the vehicle file is at a limit of what one may hold
            continue
        found = []
        for key in dict.fromkeys((*DEFAULT_UNCERTAINTIES, *vehicle.provenance)):
            slope = (value_of(after, key) - value_of(before, key)) / change
            known = _of(vehicle, key, slope, value_of(vehicle, key)) if abs(slope) > 1e-9 else None
            found += [known] if known else []
        return max(found, key=lambda k: abs(k.slope) / k.deviation, default=None)
    return None


def _of(vehicle: VehicleParameters, key: str, slope: float, absent: float) -> Known | None:
    deviation = vehicle.uncertainty(key)
    stated = vehicle.provenance.get(key)
    known = quantity(key)
    return Known(key, known.si_unit if known else "1", value_of(vehicle, key), deviation, slope,
                 bool(stated and stated.uncertainty), absent) if deviation else None
