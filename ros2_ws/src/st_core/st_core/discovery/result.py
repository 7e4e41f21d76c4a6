"""Result of a discovery. Plain data; `Discovery.document` is the body of discovery.json."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from typing import Any, Literal

import numpy as np
from scipy import stats

from ..augmented import AugmentedModel
from ..effects import EFFECT_KINDS
from .settings import Limits

Outcome = Literal["none", "named", "ambiguous", "several", "bound", "unknown", "not_testable"]
# A 95 % interval is widened by this to that of the limit `false_alarm`, for a normal distribution.
WIDENING = float(stats.norm.isf(0.5 * Limits().false_alarm) / stats.norm.isf(0.025))
OUTCOMES: tuple[Outcome, ...] = ("none", "named", "ambiguous", "several", "bound", "unknown", "not_testable")
EFFECTIVE = "effective corrections"
PARTS = (*EFFECT_KINDS, EFFECTIVE, "place or time", "unexplained")
"""Of the gap budget."""
Interval = tuple[float, float]
MODELS = ("base", "model", "named")
"""Fields of an answer that are models, and no part of discovery.json."""


@dataclass(frozen=True)
class FittedParameter:
    """value, null and 95 % interval [unit]; dependent windows and the spread between runs are in the interval."""

    value: float
    unit: str
    interval: Interval
    null: float


@dataclass(frozen=True)
class Change:
    """An error before and after, on driving the values were not fitted to. base, augmented [unit]; 95 % interval of
    base - augmented."""

    base: float
    augmented: float
    interval: Interval
    unit: str


@dataclass(frozen=True)
class Step:
    """One step of the waterfall. action: added, removed or exchanged (then `instead` is what went). parameters: of the
    effect after the step. position_5s: mean error after 5 s [m]; channels: root mean square at the end of the horizon;
    runs: mean position error after 5 s [m] of each run, before and after. All on held-out folds."""

    effect: str
    action: Literal["added", "removed", "exchanged"]
    kind: str
    parameters: Mapping[str, FittedParameter]
    position_5s: Change
    channels: Mapping[str, Change]
    runs: Mapping[str, tuple[float, float]]
    instead: str = ""


@dataclass(frozen=True)
class Value:
    """An effect as one run, site, time, place or condition shows it: share of the value stated (1: just that, 0: none
    of it) and its standard deviation."""

    where: str
    share: float
    deviation: float


@dataclass(frozen=True)
class FoundEffect:
    """One effect of the answer. kind: one of PARTS[:4]. alternatives: names the data cannot separate,
    best first.

    joint: other effects of the answer that it cancels, so that these values are known only together.
    position_5s [m]: by how much the mean error after 5 s grows without it (added last). agreement: by level (run,
    site, time, place, condition) what each part of the driving shows of it. channel, share [1]: the channel it reduces
    most, and by how much of the baseline error there; "" where no error is above the noise."""

    name: str
    kind: str
    parameters: Mapping[str, FittedParameter]
    alternatives: tuple[str, ...]
    position_5s: float
    agreement: Mapping[str, tuple[Value, ...]]
    joint: tuple[str, ...] = ()
    channel: str = ""
    share: float = 0.0


@dataclass(frozen=True)
class Assumed:
    """A quantity of the vehicle file that binds: its value and standard deviation [unit]. stated: whether the file has
    that deviation; otherwise it is the default of the quantity."""

    key: str
    unit: str
    value: float
    deviation: float
    stated: bool


@dataclass(frozen=True)
class Combination:
    """Quantities that act together [unit]: value, 95 % interval, and by the vehicle file. effects: names of what acts
    on it alike; single ones of them are known only as far as the vehicle file fixes the others."""

    name: str
    unit: str
    value: float
    interval: Interval
    file: float
    effects: tuple[str, ...]

    @property
    def differs(self) -> bool:
        """Whether the value of the vehicle file differs significantly, p < `Limits.false_alarm`."""
        edge = self.interval[0] if self.file < self.value else self.interval[1]
        return abs(self.file - self.value) > WIDENING * abs(edge - self.value)


@dataclass(frozen=True)
class ForceCurve:
    """Lateral force of an axle over the driven slip, opposing it: slip [rad], force, 90 % band low to high, and the
    file's [N]; density: share of the driving between two values of slip."""

    axle: str
    slip: tuple[float, ...]
    force: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    file: tuple[float, ...]
    density: tuple[float, ...]


@dataclass(frozen=True)
class BoundEffect:
    """Something sure that is not the same everywhere. resembles: the effect of the library that describes it best.

    to: run, site, time, place or condition. values: what each part shows. position_5s [m]: what it takes away."""

    resembles: str
    to: str
    parameters: Mapping[str, FittedParameter]
    values: tuple[Value, ...]
    position_5s: float


@dataclass(frozen=True)
class Reason:
    """One rule of `decision` as it was applied. subject: an effect, or "answer". figures: what it looked at."""

    rule: str
    subject: str
    figures: Mapping[str, float]
    text: str


@dataclass(frozen=True)
class Candidate:
    """One effect of the library on top of the answer (or as part of it). gain: share of the size of the errors it
    takes away. verdict: stated, alternative, bound, or the rule that refused it. why: in a sentence, with figures."""

    name: str
    kind: str
    parameters: Mapping[str, float]
    gain: float
    verdict: str
    why: str


@dataclass(frozen=True)
class BudgetLine:
    """One part of the gap (PARTS). last, first [m]: of the held-out mean position error after 5 s, when this part is
    added last, and first. share_last, share_first: of that error of the base; loss_last, loss_first: of the loss."""

    part: str
    last: float
    first: float
    share_last: float
    share_first: float
    loss_last: float
    loss_first: float


@dataclass(frozen=True)
class Power:
    """An effect put into the user's own drives. size [unit] of it; found times out of `of`, as itself or in a set."""

    effect: str
    parameter: str
    unit: str
    size: float
    found: float
    of: int


@dataclass(frozen=True)
class Certificate:
    """What these drives can show. powers: three sizes of each effect. alarms of `of`: statements on the same inputs
    re-simulated with noise and without any effect. driven: whether the whole search ran on each case (--certify), or
    the power was predicted from the curvature of the loss (short form; then `of` is 0)."""

    powers: tuple[Power, ...]
    alarms: int
    of: int
    driven: bool


@dataclass(frozen=True)
class WhereStatement:
    """Where the model misses more than the floor. channel: one of CHANNELS. condition: in words. excess: error
    over the floor's, root mean square [1]; interval: 95 %."""

    channel: str
    condition: str
    excess: float
    interval: Interval


@dataclass(frozen=True)
class Gap:
    """Error of a channel on held-out driving, before and after. base, augmented [unit]: root mean square at the end of
    the horizon; of position_5s the mean. interval: 95 % of base - augmented. floor: what noise alone leaves [unit].
    worst_run, worst: the run with the largest error after. worse_runs: on which it grew by more than the floor."""

    base: float
    augmented: float
    interval: Interval
    unit: str
    floor: float
    worst_run: str = ""
    worst: float = 0.0
    worse_runs: tuple[str, ...] = ()


@dataclass(frozen=True)
class NotTestable:
    """An effect these data cannot show. reason: one sentence. manoeuvre: of the catalogue, that would show it; ""."""

    name: str
    reason: str
    manoeuvre: str = ""


@dataclass(frozen=True)
class NextManoeuvre:
    """The drive that would separate most. name: in the catalogue and of the virtual car's scenario. separates: the pair
    least well separated by it. strength: of that pair, in standard deviations, once it has been driven `times` times
    and added to the runs. options: strength of every manoeuvre tried."""

    name: str
    separates: tuple[str, str]
    strength: float
    options: Mapping[str, float]
    times: int
    duration: float
    speed: float
    reason: str


@dataclass(frozen=True)
class Separability:
    """Two effects in these data. cosine: between their signatures, 1 = the same. strength: of what one leaves of the
    other, in standard deviations."""

    first: str
    second: str
    cosine: float
    strength: float


@dataclass(frozen=True)
class Run:
    """A drive of the discovery. role: suspect or reference. site: number of the place; runs near each other share it.
    windows: predictions looked at."""

    name: str
    role: Literal["suspect", "reference"]
    seconds: float
    site: int
    windows: int


@dataclass(frozen=True, eq=False)
class Discovery:
    """The answer of `discover`.

    outcome: none = what is left is near the noise, or nothing of it is significant; named = one effect; ambiguous =
    one, by several names, or a combination (`known_together`); several = more than one effect; bound = significant, but
    tied to run, place, time or condition; unknown = a significant gap that no effect of the library explains;
    not_testable = the drives show too little. start: what the
    search began from, "vehicle file" or "reference". minor: sure, but too small to be named; part of the model, so that
    they do not bend the values of what is. effective: corrections that help to predict, not properties of the car
    whatever their names; part of the model, never of a vehicle file. base: the model of the start; model: what
    predicts best, with all effects, None without any; named: with what is named or minor alone, at the values stated.
    steps: from base to what is named. gap: by channel, and position_5s; gap_named:
    without the effective corrections. budget: PARTS. reasons: every rule that decided. left_out: values of what is
    named or minor, by run, as fitted without that run. acceleration_gain: what the accelerometer shows more than the
    motion, as the body rolls [1]. noise: by channel, at the end of the horizon [SI]. signature: of what is unexplained,
    in words.
    """

    outcome: Outcome
    effects: tuple[FoundEffect, ...]
    minor: tuple[FoundEffect, ...]
    bound: tuple[BoundEffect, ...]
    steps: tuple[Step, ...]
    gap: Mapping[str, Gap]
    budget: tuple[BudgetLine, ...]
    reasons: tuple[Reason, ...]
    candidates: tuple[Candidate, ...]
    where: tuple[WhereStatement, ...]
    not_testable: tuple[NotTestable, ...]
    next_manoeuvre: NextManoeuvre | None
    separability: tuple[Separability, ...]
    certificate: Certificate
    signature: tuple[str, ...]
    runs: tuple[Run, ...]
    start: Literal["vehicle file", "reference"]
    base: AugmentedModel
    model: AugmentedModel | None
    named: AugmentedModel | None = None
    effective: tuple[FoundEffect, ...] = ()
    gap_named: Mapping[str, Gap] = field(default_factory=dict)
    axle_curves: tuple[ForceCurve, ...] = ()
    combinations: tuple[Combination, ...] = ()
    assumed: tuple[Assumed, ...] = ()
    warnings: tuple[str, ...] = ()
    left_out: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)
    acceleration_gain: float = 0.0
    noise: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.effective:  # then both models are one
            object.__setattr__(self, "named", self.named or self.model)
            object.__setattr__(self, "gap_named", self.gap_named or self.gap)

    @property
    def known_together(self) -> tuple[Combination, ...]:
        return known_together(self.combinations, self.effects)

    def document(self) -> dict[str, Any]:
        """The body of discovery.json: dicts, lists, texts and numbers only."""
        return {name: plain(getattr(self, name)) for name in self.__dataclass_fields__ if name not in MODELS}


def known_together(combinations: Sequence[Combination], named: Sequence[FoundEffect]) -> tuple[Combination, ...]:
    """Axle stiffnesses over the mass that differ from the vehicle file although no effect that changes them is named;
    without one, the understeer gradient or yaw gain of which this is true. The inertia over the mass is left out: its
    intervals do not hold on cars with other dynamics (docs/measurements/discovery_limits.md)."""
    names = {name for e in named for name in (e.name, *e.alternatives)}
    found = [c for c in combinations if c.differs and c.file > 0.0 and not names.intersection(c.effects)]
    stiffness = tuple(c for c in found if "stiffness" in c.name)
    return stiffness or tuple(c for c in found if "inertia" not in c.name)[:1]


def plain(value: Any) -> Any:
    """Dataclasses, mappings, tuples and NumPy numbers as dicts, lists and numbers."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (tuple, list)):
        return [plain(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value
