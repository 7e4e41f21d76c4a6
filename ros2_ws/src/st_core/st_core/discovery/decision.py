"""All decisions of a discovery, as pure functions of evidence and limits. A named effect is reported as a cause."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ..channels import CHANNEL_OF_COLUMN, CHANNELS
from .evidence import Evidence, describe_position_reduction, relative_reduction
from .result import Outcome, Reason
from .settings import Limits

ACCEPTED, NAMED, MINOR = "accepted", "named", "minor"
NEGLIGIBLE, GAIN_INSIGNIFICANT, NULL = "too small", "gain not significant", "value not significant"
IRRELEVANT, BOUND, VARIES, IMPLAUSIBLE = "not relevant", "on a bound", "varies", "implausible"
SENSORS, FILE, FORCES = "refuted by the sensors", "refuted by the vehicle file", "refuted by the axle forces"
ALTERNATIVE, EXPLAINS_LESS = "alternative", "explains less"
PARTITION_NAMES = {"run": "runs", "site": "sites", "time": "times within a run", "place": "places",
                   "condition": "driving conditions"}


@dataclass(frozen=True)
class Rival:
    """An effect that could replace the effect `replaces` in the model."""

    name: str
    replaces: str
    gain_ratio: float  # its gain divided by the gain of the replaced effect [1]
    p_no_worse: float  # p-value of the hypothesis that it is as good [1]
    deficit: float  # gain of the replaced effect minus gain of the rival, per residual [1]
    evidence: Evidence  # of the rival in place of the replaced effect
    values: Mapping[str, float] = field(default_factory=dict)  # of the rival in place of the replaced effect
    with_effect: bool = False  # whether the model contains both; `evidence` is then that of the replaced effect
    added: float = 0.0  # gain of the rival in addition to the replaced effect, divided by the gain of that effect [1]


def judge(e: Evidence, limits: Limits) -> Reason:
    """Verdict on one effect of a set, by the same criteria for adding, keeping and exchanging it."""
    if not is_confirmed(e, limits):
        if rejection := _reject_insignificant(e, limits):
            return rejection
    elif not is_relevant(e, limits):
        return Reason(IRRELEVANT, e.name, _relevance_values(e, limits), "redundant sensors confirm it, but of the "
                      f"baseline errors above {limits.max_noise_ratio:g} times the noise, it reduces none by more than "
                      f"{100 * find_most_affected(e, limits)[1]:.1f} %, and it "
                      f"{describe_position_reduction(max_position_reduction(e))}")
    if e.sensors_p_value is not None and e.sensors_p_value < limits.undecided_p:
        return Reason(SENSORS, e.name, {"sensors_p_value": e.sensors_p_value, "undecided_p": limits.undecided_p},
                      f"its value contradicts the redundant sensors (p = {e.sensors_p_value:.2g})")
    quantity, change = e.file_comparison or (None, 0.0)
    if quantity is not None and (z_score := quantity.z_score(change)) > limits.max_file_deviation:
        value = _format_with_unit(quantity.at(change), quantity.unit)
        deviation = _format_with_unit(quantity.deviation, quantity.unit)
        return Reason(FILE, e.name, {"value": quantity.at(change), "file": quantity.value,
                                     "standard_deviation": quantity.deviation, "z_score": z_score,
                                     "max_file_deviation": limits.max_file_deviation},
                      f"the best fit has {quantity.key} {value}, the vehicle file {quantity.value:g} (standard "
                      f"deviation {deviation}): check the file; if it is correct, another cause has the same effect")
    if e.bound_distance < limits.at_bound:
        return Reason(BOUND, e.name, {"bound_distance": e.bound_distance, "at_bound": limits.at_bound},
                      "its value is at a bound, so the best fit is beyond the physical range")
    return _reject_varying(e, limits) or Reason(
        ACCEPTED, e.name, {"gain": e.gain, "p_value": e.p_value, "position": e.position_reduction},
        f"it reduces the errors by {100 * e.reduction:.1f} % and {describe_position_reduction(e.position_reduction)} "
        f"(p = {e.p_value:.2g}), and is consistent between parts of the drives")


def judge_correction(e: Evidence, limits: Limits) -> Reason:
    """Verdict on an effective correction, which must be consistent between parts of the drives."""
    return _reject_insignificant(e, limits) or _reject_varying(e, limits) or Reason(
        ACCEPTED, e.name, {"gain": e.gain, "p_value": e.p_value}, f"it reduces the errors by {100 * e.reduction:.1f} %")


def _reject_varying(e: Evidence, limits: Limits) -> Reason | None:
    """Reason to reject an effect that varies between parts of the drives and may be absent in new driving, or None."""
    partition = varying_partition(e, limits)
    if not partition:
        return None
    a = e.agreement[partition]
    return Reason(VARIES, e.name, {"p_equal": a.p_equal, "p_absent": a.p_absent, "undecided_p": limits.undecided_p,
                                   "false_alarm": limits.false_alarm},
                  f"it varies between {PARTITION_NAMES[partition]} (p = {a.p_equal:.1g} for a constant value); in "
                  f"new driving it is absent or of opposite sign with probability {a.p_absent:.2g}")


def _format_with_unit(number: float, unit: str) -> str:
    """A value to three significant digits, without an exponent if it is 100 or more, with its unit."""
    text = f"{float(f'{number:.3g}'):.0f}" if abs(number) >= 100.0 else f"{number:.3g}"
    return text if unit == "1" else f"{text} {unit}"


def _reject_insignificant(e: Evidence, limits: Limits) -> Reason | None:
    """Reason to reject an effect that is insignificant or too small; None otherwise."""
    if e.gain < limits.negligible:
        text = (f"it reduces the errors by {100 * e.reduction:.1f} %, less than the limit of "
                f"{100 * limits.negligible:.1f} %" if e.gain > 0.0 else "it does not reduce the errors")
        return Reason(NEGLIGIBLE, e.name, {"gain": e.gain, "negligible": limits.negligible}, text)
    if e.p_value > limits.false_alarm:
        return Reason(GAIN_INSIGNIFICANT, e.name, {"p_value": e.p_value, "false_alarm": limits.false_alarm},
                      f"it is not significant: p = {e.p_value:.2g}, corrected for the number of effects tested")
    if e.gain < e.gain_between_runs:
        return Reason(GAIN_INSIGNIFICANT, e.name, {"gain": e.gain, "gain_between_runs": e.gain_between_runs},
                      f"it reduces the errors by {100 * e.reduction:.1f} %; differences between drives of the healthy "
                      f"car alone give a reduction of {100 * relative_reduction(e.gain_between_runs):.1f} %")
    if e.null_p_value > limits.undecided_p:
        return Reason(NULL, e.name, {"null_p_value": e.null_p_value, "undecided_p": limits.undecided_p},
                      f"its values do not differ significantly from their null values: p = {e.null_p_value:.2g}")
    if e.gain < limits.relevant and max_position_reduction(e) < limits.relevant_position:
        return Reason(IRRELEVANT, e.name, {"gain": e.gain, "position": max_position_reduction(e),
                                           "relevant": limits.relevant, "relevant_position": limits.relevant_position},
                      f"it is significant, but reduces the errors by {100 * e.reduction:.1f} % and "
                      f"{describe_position_reduction(max_position_reduction(e))}; {100 * limits.relevant:.1f} % or "
                      f"{100 * limits.relevant_position:.0f} cm is required")
    return None


def is_confirmed(e: Evidence, limits: Limits) -> bool:
    """Whether redundant sensor measurements exclude the null value and agree with the fitted value."""
    return (e.sensors_p_value is not None and e.sensors_p_value >= limits.undecided_p
            and e.sensors_null_p_value is not None and e.sensors_null_p_value < limits.false_alarm)


def max_position_reduction(e: Evidence) -> float:
    """The larger of the reduction of the position error overall and its lower bound in one driving condition [m]."""
    return max(e.position_reduction, e.position_reduction_in_condition)


def is_relevant(e: Evidence, limits: Limits) -> bool:
    """Whether an effect is large enough to be reported: by its error reduction in the most affected channel or in
    position or, if redundant sensors confirm it, by its size."""
    return (find_most_affected(e, limits)[1] >= limits.relevant
            or max_position_reduction(e) >= limits.relevant_position
            or (is_confirmed(e, limits) and e.size >= limits.min_relative_size))


def find_most_affected(e: Evidence, limits: Limits) -> tuple[str, float]:
    """(name, reduction [1]) of the channel with the largest error reduction relative to its baseline error, among those
    with an error above `Limits.max_noise_ratio` times the noise; ("", 0) if there is none."""
    reduction, column = max(((reduction, column) for column, (reduction, noise_ratio) in e.reductions.items()
                             if noise_ratio > limits.max_noise_ratio), default=(0.0, ""))
    return (CHANNEL_OF_COLUMN[column].name if column else ""), reduction


def _relevance_values(e: Evidence, limits: Limits) -> dict[str, float]:
    return {"share": find_most_affected(e, limits)[1], "position": max_position_reduction(e),
            "relevant": limits.relevant, "relevant_position": limits.relevant_position}


def judge_reporting(e: Evidence, limits: Limits, excludes_null: bool = True, parameter_at_bound: str = "",
                    peak_force_ratio: float = 1.0, worse_axle: str = "", summands: Sequence[str] = (),
                    violation: str = "", depends_on: Sequence[str] = ()) -> Reason:
    """Verdict on whether an accepted effect is reported as a cause, or only kept to avoid a bias of other values.

    excludes_null: whether an interval excludes the null.
    parameter_at_bound: parameter with an interval that crosses its bound, or "".
    peak_force_ratio: largest force in the drives divided by the peak force [1], the larger ratio if the effect acts on
        both axles; 1 if it does not act on the peak, or with reference drives; NaN if the forces are unknown.
    worse_axle: axle on which the effect acts and where measured forces agree better with the vehicle file, or "".
    summands: other effects of the model that are identifiable only as a sum with this effect.
    violation: range that the car would violate with this effect (`handling.find_implausible_values`), or "".
    depends_on: refuted or implausible effects without which the value is outside its interval.
    """
    def demote(text: str, **figures: float) -> Reason:
        return Reason(MINOR, e.name, figures or {"gain": e.gain},
                      f"{text}: it stays in the model, but is not reported as a cause")

    confirmed_by_sensors = is_confirmed(e, limits)
    if worse_axle:
        return Reason(FORCES, e.name, {"gain": e.gain}, f"the measured forces of the {worse_axle} axle agree less well "
                      "with it than with the vehicle file: it improves predictions, but is not reported as a cause")
    if violation:
        return Reason(IMPLAUSIBLE, e.name, {"gain": e.gain}, f"with it the car is implausible: {violation}; "
                      "it improves predictions, but is not reported as a cause")
    if depends_on:
        return demote("its value is outside its interval in a model without "
                      f"{' and '.join(depends_on).replace('_', ' ')}")
    if summands:
        return demote(f"only its sum with {' and '.join(summands).replace('_', ' ')} is identifiable")
    if parameter_at_bound:
        return demote(f"the interval of its {parameter_at_bound.replace('_', ' ')} extends beyond the physical range")
    if not peak_force_ratio >= limits.min_peak_force:
        reached = f"the drives reach only {100 * peak_force_ratio:.1f} % of the peak force"
        return demote(reached if peak_force_ratio >= 0.0 else "the axle forces, and so their peaks, are unknown",
                      peak_force_share=peak_force_ratio, min_peak_force=limits.min_peak_force)
    if e.position_reduction < -limits.relevant_position and not confirmed_by_sensors:
        return demote(f"without it the held-out position error is {-100 * e.position_reduction:.1f} cm smaller",
                      position=e.position_reduction, relevant_position=limits.relevant_position)
    if e.noise_ratio > limits.max_noise_ratio and e.gain < limits.unexplained_share and not confirmed_by_sensors:
        return demote(f"it is significant, but reduces the errors by {100 * e.reduction:.1f} %, and one channel's "
                      f"error remains {e.noise_ratio:.1f} times the noise; {100 * limits.unexplained_share:.0f} % is "
                      "needed, as unmodelled effects may cause smaller reductions", gain=e.gain,
                      noise_ratio=e.noise_ratio, max_noise_ratio=limits.max_noise_ratio,
                      unexplained_share=limits.unexplained_share)
    if not excludes_null and not confirmed_by_sensors:
        return demote("it reduces the errors, but the interval of its value includes the null value")
    channel, reduction = find_most_affected(e, limits)
    clause = f"reduces the baseline {CHANNELS[channel].label} error by {100 * reduction:.1f} % and " if channel else ""
    scope = " in one driving condition" if max_position_reduction(e) > max(e.position_reduction, 0.0) else ""
    text = f"it {clause}{describe_position_reduction(max_position_reduction(e))}{scope}"
    if is_relevant(e, limits):
        return Reason(NAMED, e.name, _relevance_values(e, limits), text)
    return demote(f"it is significant, but {text}; {100 * limits.relevant:.1f} % or "
                  f"{100 * limits.relevant_position:.0f} cm is required", **_relevance_values(e, limits))


def varying_partition(e: Evidence, limits: Limits) -> str:
    """Partition (run, place, ...) over which an effect varies significantly and may be absent in a new part, or "". If
    there are several, the one with the largest probability of absence."""
    candidates = [partition for partition, a in e.agreement.items()
                  if a.p_equal < limits.false_alarm and a.p_absent > limits.undecided_p]
    return max(candidates, key=lambda partition: e.agreement[partition].p_absent, default="")


def varies_relevantly(e: Evidence, limits: Limits) -> bool:
    """Whether separate values of an effect in parts of the drives are significant and relevant enough to report."""
    is_significant = e.p_value < limits.false_alarm and e.gain > e.gain_between_runs
    return is_significant and e.gain > limits.relevant and is_relevant(e, limits)


def judge_alternative(rival: Rival, limits: Limits) -> Reason:
    """Verdict on a rival as an alternative to an effect of the final model."""
    figures = {"share": rival.gain_ratio, "added": rival.added, "p_no_worse": rival.p_no_worse,
               "deficit": rival.deficit, "min_rival_gain": limits.min_rival_gain, "undecided_p": limits.undecided_p,
               "unexplained_share": limits.unexplained_share}
    replaced_name = rival.replaces.replace("_", " ")
    gain = f"in place of {replaced_name} it achieves {100 * rival.gain_ratio:.0f} % of that effect's error reduction"
    gain += f", and in addition to it {100 * rival.added:.0f} %" if rival.added >= 0.005 else ""
    test_result = f"p = {rival.p_no_worse:.2g} for the hypothesis that it is as good"
    if rival.gain_ratio - rival.added < limits.min_rival_gain or explains_less(rival, limits):
        return Reason(EXPLAINS_LESS, rival.name, figures, f"{gain}; {test_result}")
    if rival.with_effect:
        gain = f"together with {replaced_name} it reduces the errors about as much as that effect alone"
    elif (verdict := judge(rival.evidence, limits)).rule not in (ACCEPTED, IRRELEVANT):
        return verdict
    if rival.p_no_worse < limits.undecided_p:
        test_result += (", but unmodelled effects may cause the difference of "
                        f"{100 * rival.deficit:.1f} % of the residual")
    return Reason(ALTERNATIVE, rival.name, figures, f"{gain}; {test_result}")


def explains_less(rival: Rival, limits: Limits) -> bool:
    """Whether errors are significantly larger with the rival, and by more than unmodelled effects may cause."""
    is_inconclusive = rival.evidence.noise_ratio > limits.max_noise_ratio and rival.deficit < limits.unexplained_share
    return rival.p_no_worse < limits.undecided_p and not is_inconclusive


def judge_necessity(rival: Rival, limits: Limits) -> Reason | None:
    """Verdict on an effect that the best set without it can replace; None if that set explains less."""
    if explains_less(rival, limits):
        return None
    instead = f", with {rival.name.replace('_', ' ')} instead," * bool(rival.name)
    return Reason(MINOR, rival.replaces, {"deficit": rival.deficit, "p_no_worse": rival.p_no_worse},
                  f"the best model without it{instead} changes the errors by only {100 * rival.deficit:+.1f} % (p = "
                  f"{rival.p_no_worse:.2g} for the hypothesis that it is as good): it is not reported as a cause")


def is_alternative(rival: Rival, limits: Limits) -> bool:
    return judge_alternative(rival, limits).rule == ALTERNATIVE


def list_alternatives(rivals: Sequence[Rival], limits: Limits) -> tuple[str, ...]:
    """Names of the rivals that are alternatives, best first."""
    return tuple(r.name for r in sorted(rivals, key=lambda r: -r.gain_ratio) if is_alternative(r, limits))


def decide(limits: Limits, named: Sequence[Evidence], rivals: Mapping[str, Sequence[Rival]],
           rejected: Sequence[Evidence], noise_ratio: float, detectable_share: float, n_varying: int = 0,
           combinations: Sequence[str] = (), n_effects: int = 0,
           base_noise_ratio: float = 1.0) -> tuple[Outcome, Reason]:
    """The outcome and its reason.

    named, rejected: evidence for the effects reported as causes, and for those that the search rejected.
    rivals: by name of the effect that they may replace.
    noise_ratio: ratio of the residual position error to the noise, NaN without positions [1].
    detectable_share: fraction of the library reported, or detectable at sizes up to one parameter scale [1].
    n_varying: number of effects that vary between parts of the drives.
    combinations: parameter combinations that differ from the vehicle file and that no named effect changes.
    n_effects: number of effects in the model.
    base_noise_ratio: noise_ratio without these effects [1].
    """
    def conclude(outcome: Outcome, text: str, **figures: float) -> tuple[Outcome, Reason]:
        return outcome, Reason(outcome, "outcome", figures, text)

    if len(named) > 1:
        return conclude("several", f"{len(named)} effects are significant, relevant and consistent between "
                        "parts of the drives", effects=len(named))
    if named:
        if (count := 1 + len(list_alternatives(rivals.get(named[0].name, ()), limits))) > 1:
            return conclude("ambiguous", f"{count} effects explain the errors equally well", names=count)
        return conclude("named", "one effect is significant, relevant and consistent between parts of the drives")
    if combinations:
        return conclude("ambiguous", f"{' and '.join(combinations)}: different from the vehicle file, but the "
                        "effects behind this difference cannot be separated", combinations=len(combinations))
    verdicts = [judge(e, limits) for e in rejected if is_relevant(e, limits)]
    if n_varying or any(v.rule == VARIES for v in verdicts):
        return conclude("varying", "a significant effect varies between parts of the drives")
    if any(v.rule in (BOUND, SENSORS, FILE) for v in verdicts):
        return conclude("unknown", "a significant effect is rejected, because its value is at a bound or contradicts "
                        "the sensors or the vehicle file")
    if noise_ratio > limits.max_noise_ratio:
        return conclude("unknown", f"the position error is {noise_ratio:.1f} times the noise, and no further effect "
                        "of the library reduces it significantly", noise_ratio=noise_ratio,
                        max_noise_ratio=limits.max_noise_ratio)
    if n_effects and not base_noise_ratio <= limits.max_noise_ratio:
        reduced = (f"position error from {base_noise_ratio:.1f} to {noise_ratio:.1f} times the noise"
                   if base_noise_ratio >= 0.0 else "errors")
        return conclude("ambiguous", f"the model reduces the {reduced}, but none of its effects is certain enough to "
                        "be reported as a cause", effects=n_effects, base_noise_ratio=base_noise_ratio,
                        max_noise_ratio=limits.max_noise_ratio)
    if detectable_share < limits.detection_power:
        return conclude("not_testable", f"only {100 * detectable_share:.0f} % of the library's effects would be "
                        "detectable in these drives at their typical size", detectable_share=detectable_share,
                        detection_power=limits.detection_power)
    return conclude("none", f"the position error is {noise_ratio:.1f} times the noise" if noise_ratio >= 0.0 else
                    "no effect reduces the errors significantly; there are no positions to compare with the noise",
                    noise_ratio=noise_ratio, max_noise_ratio=limits.max_noise_ratio)
