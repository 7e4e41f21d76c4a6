"""What a discovery says: outcome, names, values, where. Plain data; `Discovery.document` is discovery.json."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from ..augmented import AugmentedModel

Outcome = Literal["none", "named", "ambiguous", "several", "unknown", "not_testable"]
Interval = tuple[float, float]

OUTCOMES: tuple[Outcome, ...] = ("none", "named", "ambiguous", "several", "unknown", "not_testable")


@dataclass(frozen=True)
class FittedParameter:
    """value and interval [unit]: 95 %, what the base model gets wrong by itself included."""

    value: float
    unit: str
    interval: Interval


@dataclass(frozen=True)
class FoundEffect:
    """One effect of the answer. alternatives: names the data cannot tell from it, best first. probability: 0 to 1, of
    the name among itself and its alternatives."""

    name: str
    parameters: Mapping[str, FittedParameter]
    alternatives: tuple[str, ...]
    probability: float


@dataclass(frozen=True)
class WhereStatement:
    """Where the base model misses more than the floor.

    channel: one of settings.CHANNELS. condition: in words, as "steering rate above 0.2 rad/s, both directions".
    excess: error over the floor's, root mean square [1]; interval: 95 %.
    """

    channel: str
    condition: str
    excess: float
    interval: Interval


@dataclass(frozen=True)
class Gap:
    """Error on runs that served nothing else, root mean square, before and after.

    base, augmented [unit]. interval: 95 % of base - augmented [unit], above zero where it surely shrank. floor: what
    the base leaves on reference drives [unit]; None without reference. worst_run, worst: the run with the largest
    augmented error and that error. worse_runs: runs on which the error grew by more than a tenth of the floor.
    """

    base: float
    augmented: float
    interval: Interval
    unit: str
    floor: float | None = None
    worst_run: str = ""
    worst: float = 0.0
    worse_runs: tuple[str, ...] = ()


@dataclass(frozen=True)
class NotTestable:
    """An effect these data cannot show. reason: one sentence."""

    name: str
    reason: str


@dataclass(frozen=True)
class NextManoeuvre:
    """The drive that would tell most. name: as in the catalogue. scenario: what st_sim calls it.

    separates: the pair least well told apart by it. strength: of that pair, in standard deviations, once it has
    been driven so many times and added to the runs. options: strength of every manoeuvre tried, by name.
    """

    name: str
    scenario: str
    separates: tuple[str, str]
    strength: float
    options: Mapping[str, float]
    times: int
    duration: float
    speed: float
    reason: str


@dataclass(frozen=True)
class Separability:
    """Two effects in these data. cosine: between their signatures, 1 = the same. strength: of what one leaves
    unexplained of the other, in standard deviations; below 3 they cannot be told apart."""

    first: str
    second: str
    cosine: float
    strength: float


@dataclass(frozen=True)
class Candidate:
    """One hypothesis as it was tried alone. gain: share of the base's squared error on the selection data it takes
    away. p: that healthy data let any effect gain as much. verdict: chosen, alternative or why not."""

    name: str
    parameters: Mapping[str, float]
    gain: float
    p: float
    verdict: str


@dataclass(frozen=True)
class Split:
    """Which run, or which part of it, served what; "name 0-30 s" for a part. note: in words."""

    fit: tuple[str, ...]
    select: tuple[str, ...]
    report: tuple[str, ...]
    note: str


@dataclass(frozen=True, eq=False)
class Discovery:
    """The answer of `discover`.

    outcome: none = nothing beyond what healthy drives show; named = one effect; ambiguous = one effect, several names;
    several = more than one effect; unknown = a gap no effect explains; not_testable = the data show too little.
    base: the model errors are counted from, steered drive force and what the reference taught included. model: base
    with the effects found; None without any. signature: of an unknown effect, in words. acceleration_gain: what the
    accelerometer shows more than the motion, as the body rolls [1]. noise: by channel, root mean square at the end of
    the horizon that a healthy car leaves [SI].
    """

    outcome: Outcome
    effects: tuple[FoundEffect, ...]
    where: tuple[WhereStatement, ...]
    gap: Mapping[str, Gap]
    not_testable: tuple[NotTestable, ...]
    next_manoeuvre: NextManoeuvre | None
    separability: tuple[Separability, ...]
    signature: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    base: AugmentedModel
    model: AugmentedModel | None
    split: Split
    p: float
    warnings: tuple[str, ...] = ()
    acceleration_gain: float = 0.0
    noise: Mapping[str, float] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """The body of discovery.json: dicts, lists, texts and numbers only."""
        return {
            "outcome": self.outcome,
            "p": self.p,
            "effects": [{"name": e.name,
                         "parameters": {n: {"value": p.value, "unit": p.unit, "interval": list(p.interval)}
                                        for n, p in e.parameters.items()},
                         "alternatives": list(e.alternatives), "probability": e.probability} for e in self.effects],
            "where": [{"channel": w.channel, "condition": w.condition, "excess": w.excess,
                       "interval": list(w.interval)} for w in self.where],
            "gap": {name: {"base": g.base, "augmented": g.augmented, "interval": list(g.interval), "unit": g.unit,
                           "floor": g.floor, "worst_run": g.worst_run, "worst": g.worst,
                           "worse_runs": list(g.worse_runs)} for name, g in self.gap.items()},
            "not_testable": [{"name": n.name, "reason": n.reason} for n in self.not_testable],
            "next_manoeuvre": None if self.next_manoeuvre is None else {
                "name": self.next_manoeuvre.name, "scenario": self.next_manoeuvre.scenario,
                "separates": list(self.next_manoeuvre.separates), "strength": self.next_manoeuvre.strength,
                "options": dict(self.next_manoeuvre.options), "times": self.next_manoeuvre.times,
                "duration": self.next_manoeuvre.duration, "speed": self.next_manoeuvre.speed,
                "reason": self.next_manoeuvre.reason},
            "separability": [{"first": s.first, "second": s.second, "cosine": s.cosine, "strength": s.strength}
                             for s in self.separability],
            "signature": list(self.signature),
            "candidates": [{"name": c.name, "parameters": dict(c.parameters), "gain": c.gain, "p": c.p,
                            "verdict": c.verdict} for c in self.candidates],
            "split": {"fit": list(self.split.fit), "select": list(self.split.select),
                      "report": list(self.split.report), "note": self.split.note},
            "warnings": list(self.warnings),
        }
