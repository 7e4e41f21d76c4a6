"""Result of a discovery, as plain data; `Discovery.document` is the body of discovery.json."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal, get_args

import numpy as np
from scipy import stats

from ..augmented import AugmentedModel
from ..effects import EFFECT_KINDS, get_effect
from ..identification.axle_forces import ForceCurve
from .settings import Limits

Outcome = Literal["none", "named", "ambiguous", "several", "varying", "unknown", "not_testable"]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
# Ratio of the half-widths of intervals at significance levels `false_alarm` and 5 %, for a normal distribution.
FALSE_ALARM_WIDENING = float(stats.norm.isf(0.5 * Limits().false_alarm) / stats.norm.isf(0.025))
EFFECTIVE_CORRECTIONS = "effective corrections"
BUDGET_PARTS = (*EFFECT_KINDS, EFFECTIVE_CORRECTIONS, "place or time", "unexplained")
"""Kinds of cause to which the baseline error is attributed (`BudgetLine`)."""
Interval = tuple[float, float]
MODEL_FIELDS = ("base", "model", "named")  # fields of `Discovery` that are models and not part of discovery.json


@dataclass(frozen=True)
class FittedParameter:
    """Fitted value, its 95 % interval, and null, the value at which the effect changes nothing [unit]. The interval
    allows for dependent windows and differences between runs."""

    value: float
    unit: str
    interval: Interval
    null: float


@dataclass(frozen=True)
class Change:
    """A held-out error before a step (base) and after it (augmented) [unit]. interval: 95 %, of base - augmented."""

    base: float
    augmented: float
    interval: Interval
    unit: str


@dataclass(frozen=True)
class Step:
    """One step of the waterfall, which adds an effect. All errors are held out."""

    effect: str
    kind: str
    parameters: Mapping[str, FittedParameter]  # values of this effect after the step
    position_5s: Change  # mean position error after 5 s [m]
    channels: Mapping[str, Change]  # root mean square error at the end of the horizon, by channel
    # Mean position error after 5 s (before, after) the step, by run [m]. Without position among the channels,
    # position_5s is the first entry of channels, and runs are root mean square errors of that channel.
    runs: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class LocalEstimate:
    """Estimate of an effect in one run, site, time, place or condition."""

    subset: str
    # Change from the null relative to the overall change, possibly negative or above 1; in a `VaryingEffect` without a
    # common fit, relative to the largest local change [1].
    ratio: float
    deviation: float  # standard deviation of the ratio


@dataclass(frozen=True)
class FoundEffect:
    """One effect of the result."""

    name: str
    kind: str  # one of EFFECT_KINDS
    parameters: Mapping[str, FittedParameter]
    alternatives: tuple[str, ...]  # names of effects that the data do not separate from it, best first
    position_5s_increase: float  # increase of the mean position error after 5 s if it is removed [m]
    agreement: Mapping[str, tuple[LocalEstimate, ...]]  # by partition (run, site, time, place, condition)
    joint: tuple[str, ...] = ()  # effects of the result that cancel it, so that only their combination is identifiable
    channel: str = ""  # with the largest relative error reduction; "" if no error exceeds twice the noise
    share: float = 0.0  # relative error reduction in this channel [1]
    other_causes: str = ""  # causes outside the library that act in the same way; "" with reference drives


@dataclass(frozen=True)
class AssumedQuantity:
    """A quantity of the vehicle file used as a prior or for comparison: value and standard deviation [unit]."""

    key: str
    unit: str
    value: float
    deviation: float
    stated: bool  # whether the file states the standard deviation; otherwise it is the default for the quantity


@dataclass(frozen=True)
class Combination:
    """A combination of vehicle parameters that determines predictions."""

    name: str
    unit: str
    value: float
    interval: Interval  # 95 %
    file: float  # value of the vehicle file
    effects: tuple[str, ...]  # inseparable effects that change it; for a delay, also their alternatives

    @property
    def is_delay(self) -> bool:
        """Whether it is `TOTAL_DELAY`, which is 0 in a vehicle file."""
        return self.unit == "s"

    @property
    def differs(self) -> bool:
        """Whether the value of the vehicle file differs significantly, p < `Limits.false_alarm`."""
        end = self.interval[0] if self.file < self.value else self.interval[1]
        return abs(self.file - self.value) > FALSE_ALARM_WIDENING * abs(end - self.value)


@dataclass(frozen=True)
class VaryingEffect:
    """A significant effect that varies between parts of the drives."""

    resembles: str  # effect of the library that describes it best
    varies_with: str  # run, site, time, place or condition
    parameters: Mapping[str, FittedParameter]
    values: tuple[LocalEstimate, ...]  # estimate in each part
    position_5s_reduction: float  # reduction of the mean position error after 5 s [m]


@dataclass(frozen=True)
class Reason:
    """A decision and its reason."""

    rule: str  # the rule of `decision` that applied
    subject: str  # an effect, or "outcome"
    figures: Mapping[str, float]  # the compared numbers, by name of the quantity or limit
    text: str


@dataclass(frozen=True)
class CandidateEffect:
    """An effect of the library, tested in the final model, in addition to it, or in place of one of its effects."""

    name: str
    kind: str
    parameters: Mapping[str, float]
    gain: float  # relative reduction of the RMS error [1]
    verdict: str  # the rule of `decision` that applied; "included" if it overlaps an effect of the model
    reason: str  # of the verdict


@dataclass(frozen=True)
class BudgetLine:
    """Reduction of the error by one of BUDGET_PARTS, added last or first; for "unexplained", the remaining error."""

    part: str
    added_last: float  # reduction of the held-out mean position error after 5 s [m]
    added_first: float
    share_added_last: float  # the same divided by the baseline error [1]
    share_added_first: float
    loss_added_last: float  # the corresponding fraction of the baseline loss [1]
    loss_added_first: float


@dataclass(frozen=True)
class Power:
    """Probability [1] of detecting an effect of a given size [unit] in these drives."""

    effect: str
    parameter: str
    unit: str
    size: float
    probability: float
    simulated_drives: int  # number of drives simulated to estimate it; 0 if it is predicted without simulation
    position_5s: float = 0.0  # change of the position after 5 s by this size, mean [m]; 0 if not predicted


@dataclass(frozen=True)
class PowerAnalysis:
    """Power of the tests on these drives."""

    powers: tuple[Power, ...]  # for three sizes of each effect; predicted power: also for a detectable size
    alarms: int  # number of drives, simulated without an effect, in which an effect was reported
    simulated_drives: int  # number of drives simulated without an effect; 0 if not measured
    measured: bool  # on simulated drives (--simulate-power); False: predicted from the curvature of the loss


@dataclass(frozen=True)
class LargeErrorRegion:
    """A condition, time or place in which the error is larger than expected from the reference drives or the noise."""

    channel: str  # one of CHANNELS
    condition: str
    # Root mean square error divided by the expected one, with 95 % interval; for a time or place: this ratio for all
    # driving, multiplied by the ratio of the local errors to those in similar conditions [1].
    excess: float
    interval: Interval


@dataclass(frozen=True)
class ChannelError(Change):
    """Held-out error of a channel with the base model (base) and with effects (augmented) [unit]: root mean square at
    the end of the horizon, but mean for position_5s. interval: 95 %, of base - augmented."""

    floor: float  # error due to noise alone [unit]
    worst_run: str = ""  # run with the largest augmented error
    worst: float = 0.0  # this error [unit]
    worse_runs: tuple[str, ...] = ()  # runs in which the effects increase the error by more than the floor


@dataclass(frozen=True)
class UntestableEffect:
    """An effect that is not detectable in these drives."""

    name: str
    reason: str
    manoeuvre: str = ""  # name of a manoeuvre of the catalogue that excites it, or ""


@dataclass(frozen=True)
class NextManoeuvre:
    """The manoeuvre that best separates an effect from its alternatives."""

    name: str  # in the catalogue, also the name of the scenario of the virtual car
    separates: tuple[str, str]  # the pair of effects with the smallest separation
    strength: float  # separation of this pair expected after `repetitions` drives [standard deviations]
    options: Mapping[str, float]  # strength by manoeuvre
    repetitions: int
    duration: float  # of one drive [s]
    speed: float  # of one drive [m/s]
    reason: str


@dataclass(frozen=True)
class Separability:
    """Separability of two effects in these drives."""

    first: str
    second: str
    cosine: float  # cosine similarity of the error changes that they cause [1]
    strength: float  # part of the first effect that the other effects do not explain [standard deviations of the noise]


@dataclass(frozen=True)
class Run:
    """A drive of the discovery."""

    name: str
    role: Literal["suspect", "reference"]
    seconds: float  # duration with both INS and steering
    site: int  # index of its site; runs with overlapping tracks share one; 0 for a reference drive
    windows: int  # number of scored predictions; 0 for a reference drive


@dataclass(frozen=True, eq=False)
class Discovery:
    """The result of `discover`."""

    outcome: Outcome  # see `decision.decide`
    effects: tuple[FoundEffect, ...]
    minor: tuple[FoundEffect, ...]  # in the model to avoid a bias of the other values, but not reported as causes
    varying: tuple[VaryingEffect, ...]  # significant effects that vary between parts of the drives
    steps: tuple[Step, ...]  # from the base to all effects found
    errors: Mapping[str, ChannelError]  # of the base and the best model, by channel and for `channels.POSITION_5S`
    budget: tuple[BudgetLine, ...]
    reasons: tuple[Reason, ...]  # all decisions
    candidates: tuple[CandidateEffect, ...]
    large_error_regions: tuple[LargeErrorRegion, ...]
    not_testable: tuple[UntestableEffect, ...]
    next_manoeuvre: NextManoeuvre | None
    separability: tuple[Separability, ...]
    power_analysis: PowerAnalysis
    signature: tuple[str, ...]  # phrases that describe the residual
    runs: tuple[Run, ...]
    start: Literal["vehicle file", "reference"]  # origin of the values at the start of the search
    base: AugmentedModel  # the fit without the effects found, first model of `steps`
    model: AugmentedModel | None  # the model with all effects, which predicts best; None if no effect was found
    named: AugmentedModel | None = None  # the model with named and minor effects only, at the reported values
    effective: tuple[FoundEffect, ...] = ()  # in the model, but never in a vehicle file: not properties of the car
    named_errors: Mapping[str, ChannelError] = field(default_factory=dict)  # `errors` before effective corrections
    axle_curves: tuple[ForceCurve, ...] = ()
    combinations: tuple[Combination, ...] = ()
    assumed: tuple[AssumedQuantity, ...] = ()
    warnings: tuple[str, ...] = ()
    # Values of the effects, by the run left out of the fit.
    leave_one_out: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)
    clock_errors: Mapping[str, float] = field(default_factory=dict)  # correction of the steering stamps by run [s]
    acceleration_gain: float = 0.0  # relative excess of the measured lateral specific force, due to body roll [1]
    noise: Mapping[str, float] = field(default_factory=dict)  # remaining held-out error by channel [SI]

    @property
    def increases_error(self) -> bool:
        """Whether the model increases the held-out position error after 5 s significantly."""
        position = self.errors.get("position_5s")
        return self.model is not None and position is not None and position.interval[1] < 0.0

    @property
    def unseparated_combinations(self) -> tuple[Combination, ...]:
        return unseparated_combinations(self.combinations, self.effects)

    def document(self) -> dict[str, Any]:
        """The body of discovery.json: only dicts, lists, strings, numbers, booleans and None."""
        return {f.name: plain_data(getattr(self, f.name)) for f in fields(self) if f.name not in MODEL_FIELDS}


def unseparated_combinations(combinations: Sequence[Combination],
                             named: Sequence[FoundEffect]) -> tuple[Combination, ...]:
    """Combinations that differ significantly from the vehicle file and that no named effect or alternative changes. If
    a ratio of stiffness to axle load is among them, stability factor and yaw gain are left out; else only the first of
    these two is listed. The total delay may be listed in addition."""
    names = {part for e in named for name in (e.name, *e.alternatives) for part in (name, *get_effect(name).members)}
    unexplained = [c for c in combinations if c.differs and not names.intersection(c.effects)]
    others = [c for c in unexplained if not c.is_delay]
    return (*([c for c in others if "stiffness" in c.name] or others[:1]), *(c for c in unexplained if c.is_delay))


def plain_data(value: Any) -> Any:
    """The value with dataclasses, mappings, tuples and NumPy numbers converted to dicts, lists and numbers."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain_data(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(k): plain_data(v) for k, v in value.items()}
    if isinstance(value, (tuple, list)):
        return [plain_data(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value
