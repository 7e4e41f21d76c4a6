"""What a proposal says."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..augmented import AugmentedModel
from .next_drive import NextDrives
from .places import FACTORS, USUAL, Candidate
from .readings import Reading
from .scrutiny import Shares

HUGE = 3.0  # usual sizes


@dataclass(frozen=True, eq=False)
class Proposal:
    """A law that lowers the loss on driving it was not fitted to.

    candidate: where it acts, and on what it depends. coefficients: (8,) of the splines. at: (k,) values of the
    quantity; value, deviation: (k,) the curve there and its standard deviation [unit of the place]; density: (k,) share
    of the driving near each. gain [1]: held-out fall of the loss for each scored error. chance [1]: that any law gains
    as much where nothing is. position_5s [m]: (before, after) held out; runs: the same by run. model: everything else,
    at the values fitted beside the law. others: laws that do no worse, with the cosine of what both change [1].
    readings: the curve in words, best first. shares: how much of it each run shows. needless: effects of the answer
    that the law leaves too little to do, with the share of the size of the errors [1] that comes back without each.
    drives: what was hardly driven, and what to drive next.
    """

    candidate: Candidate
    coefficients: np.ndarray
    at: np.ndarray
    value: np.ndarray
    deviation: np.ndarray
    density: np.ndarray
    gain: float
    chance: float
    position_5s: tuple[float, float]
    runs: Mapping[str, tuple[float, float]]
    model: AugmentedModel
    others: Mapping[str, float] = field(default_factory=dict)
    readings: Sequence[Reading] = ()
    shares: Shares = field(default_factory=lambda: Shares({}, 1.0))
    needless: Mapping[str, float] = field(default_factory=dict)
    drives: NextDrives = field(default_factory=NextDrives)


@dataclass(frozen=True)
class Proposals:
    """proposal: None where no law is sure and worth it; why: the reason, or what it takes away, with figures. tried:
    held-out gain [1] and chance [1] of every law, best first. visible: size at the end of the range [unit of the curve]
    from which on a straight line would have been sure, by law."""

    proposal: Proposal | None
    why: str
    tried: Mapping[str, tuple[float, float]]
    visible: Mapping[str, float] = field(default_factory=dict)

    def unseen(self) -> list[str]:
        """Places of which these drives show too little: no law there would be sure below HUGE usual sizes."""
        size: dict[str, float] = {}
        for name, visible in self.visible.items():
            place, _, rest = name.partition(" over ")
            usual = USUAL[place] / FACTORS.get(rest.partition(" times ")[2], 1.0)
            size[place] = min(size.get(place, np.inf), visible / usual)
        return [place for place, least in size.items() if least > HUGE]
