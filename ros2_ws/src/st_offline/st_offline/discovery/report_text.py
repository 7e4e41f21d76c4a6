"""Writes the sentences and table rows that report a discovery, for the terminal and the page."""

import math
from collections.abc import Mapping, Sequence

from st_core.channels import LABELS
from st_core.checks import Finding, Severity
from st_core.discovery import result
from st_core.discovery.decision import FILE, FORCES, IMPLAUSIBLE, MINOR, PARTITION_NAMES
from st_core.discovery.next_manoeuvre import MIN_SEPARATION
from st_core.discovery.result import BUDGET_PARTS, Discovery
from st_core.discovery.settings import Limits
from st_core.effects import EFFECTS, get_effect
from st_core.regression import Z95
from st_core.vehicle import FILE_QUANTITIES

from ..checking.check_report import describe_effect, format_estimate, get_unit_symbol, group_findings
from ..terminal import format_count
from . import quantities
from .quantities import format_briefly, format_fitted, format_metres, label_channel, to_words
from .vehicle_update import SLIP_SPEED_KEY, VehicleUpdate

MAX_PARTS = 6  # local estimates of a varying effect listed in a sentence
MAX_UNDETECTABLE = 8  # effects listed in a sentence; the table contains all
MAX_MINOR = 3  # minor effects that change the vehicle file, listed in the summary; the details contain all
MAX_KEYS = 3  # keys of a vehicle file listed in a sentence; the table contains all
MAX_SEPARATION = 10.0  # standard deviations; larger separations are outside the linear range of the prediction
MAX_RATIO = 1000.0  # of an error to the expected error; above it, predictions have diverged
LIMITS = Limits()
OTHER_CAUSE = " or a cause outside the library with the same effect"
SLIP_CAUTION = "; use it only up to the slip angles of these drives, which do not determine the peak tyre force"
EFFECT_HEAD = ("effect", "value (95 % interval)", "5 s position error without it", "largest reduction",
               "significant in")
EFFECT_NOTE = ("Errors are those of the complete model on held-out driving; \"without it\" means that this effect is "
               "removed and the others are refitted. An effect is reported as a cause only if it is significant and "
               f"reduces the error of a channel by at least {100 * LIMITS.relevant:g} %, or the 5 s position error, "
               f"over all driving or in one condition, by at least {LIMITS.relevant_position:g} m. A sensor error that "
               f"redundant sensors confirm is also reported, if it is at least {LIMITS.min_relative_size:g} times its "
               "typical size")
PAIR_HEAD = ("effect", "alternative", "cosine", "separation, σ of the noise")


def name_with_alternatives(discovery: Discovery, effect: result.FoundEffect, first: str = "") -> str:
    """An effect and its alternatives with their values. first: text for the effect itself; default: its name and value.
    The value of an alternative with a prior, such as an added load, is reported as an upper limit."""
    fitted = {c.name: c.parameters for c in discovery.candidates}
    texts = [first or f"{to_words(effect.name)} {format_briefly(effect.name, effect.parameters)}"]
    for name in effect.alternatives:
        limit = "up to " if any(p.deviation < math.inf for p in get_effect(name).parameters) else ""
        texts.append(f"{to_words(name)} {limit}{format_fitted(name, fitted.get(name, {}))}".strip())
    return " or ".join(texts)


def sort_by_size(effects: Sequence[result.FoundEffect]) -> list[result.FoundEffect]:
    """Effects sorted by how much the position error increases without them, largest first."""
    return sorted(effects, key=lambda e: -e.position_5s_increase)


def list_effect_rows(discovery: Discovery) -> list[tuple[str, str, str, str, str]]:
    """Table row of each reported effect, with the columns of EFFECT_HEAD."""
    return [(name_with_alternatives(discovery, e, to_words(e.name)),
             "; ".join(quantities.format_parameters(e.name, e.parameters)), format_metres(e.position_5s_increase, "+"),
             f"{label_channel(e.channel)} error by {100 * e.share:.0f} %" if e.channel and e.share >= 0.005 else "-",
             describe_agreement(e)) for e in sort_by_size(discovery.effects)]


def format_title(discovery: Discovery) -> str:
    """The result in one line."""
    if discovery.outcome == "not_testable":
        return "These drives have too little excitation for a result"
    largest = sort_by_size((*discovery.effects, *discovery.minor))[:1] if discovery.effects else []
    uncertain = [f"the largest reduction is by {name_with_alternatives(discovery, e)}, which is not certain enough to "
                 "be reported as a cause" for e in largest if e not in discovery.effects]
    effects = [name_with_alternatives(discovery, e) + (OTHER_CAUSE if e.other_causes else "")
               for e in sort_by_size(discovery.effects)]
    # A cause outside the library that acts like a named effect may change the combinations as well.
    other_cause = OTHER_CAUSE if any(e.other_causes for e in discovery.effects) else ""
    combinations = [format_combination(c) + other_cause for c in discovery.unseparated_combinations]
    position = discovery.errors.get("position_5s")
    one_dominates = position is None or any(e.position_5s_increase > 0.5 * (position.base - position.augmented)
                                            for e in discovery.effects)
    named = "; ".join((*effects, *combinations) if one_dominates else (*combinations, *effects))
    unexplained = [f"a residual remains that no effect of the library explains: {text}"
                   for text in discovery.signature[:1]]
    clauses = ["no significant model error"]
    if discovery.outcome == "unknown":
        addition = [f"in addition {named}"] if named else []
        clauses = ["a significant error that no effect of the library explains", *addition]
    elif named:
        clauses = [named, *uncertain, *unexplained]
    elif discovery.outcome == "varying":
        varying = [f"an effect that resembles {to_words(v.resembles)} ({format_metres(v.position_5s_reduction)}) but "
                   f"varies between {PARTITION_NAMES[v.varies_with]}" for v in discovery.varying]
        clauses = [*unexplained, *varying, "no effect is reported as a cause"]
    elif discovery.outcome == "ambiguous":
        clauses = ["no effect is certain enough to be reported as a cause"]
    return f"{_describe_errors(discovery)}: {'; '.join(clauses)}"


def _describe_errors(discovery: Discovery) -> str:
    """Clause on the position error after 5 s or, without it, on the error of one channel."""
    position = discovery.errors.get("position_5s")
    if position is None:
        name = next(n for n in LABELS if n in discovery.errors)
        error = discovery.errors[name]
        before, after = (quantities.format_value(value, error.unit) for value in (error.base, error.augmented))
        return f"{label_channel(name)} error {before} to {after} ({100 * (error.augmented / error.base - 1.0):+.0f} %)"
    named = discovery.named_errors["position_5s"].augmented if discovery.effective else position.augmented
    corrections_help = named - position.augmented > LIMITS.relevant_position
    after = "" if discovery.model is None else f" → {format_metres(named if corrections_help else position.augmented)}"
    after += f", {format_metres(position.augmented)} with effective corrections" if corrections_help else ""
    more = len(discovery.minor) + (0 if corrections_help else len(discovery.effective)) if discovery.effects else 0
    others = f", with {format_count(more, 'more effect')} not reported as {'a cause' if more == 1 else 'causes'}"
    return f"5 s position error {format_metres(position.base)}{after} (held-out{others if more else ''})"


def summarise(discovery: Discovery, update: VehicleUpdate | None,
              findings: Mapping[str, Sequence[Finding]]) -> list[tuple[str, str]]:
    """(heading, text) of each paragraph: combinations; residual, and effects that are not separable or detectable;
    recordings; recommendations. findings: findings of the checks, by recording."""
    inseparable = [" or ".join(map(to_words, (e.name, *e.alternatives))) for e in discovery.effects if e.alternatives]
    inseparable += [f"{to_words(e.name)} with {', '.join(map(to_words, e.joint))} (they compensate for each other)"
                    for e in discovery.effects if e.joint]
    unresolved = (describe_residual(discovery), f"not separable: {'; '.join(inseparable)}" if inseparable else "",
                  describe_undetectable(discovery))
    combinations = [f"{format_combination(c)}: {', '.join(map(to_words, c.effects[:-1]))} or "
                    f"{to_words(c.effects[-1])}, which these drives do not separate"
                    for c in discovery.unseparated_combinations]
    contradictions = {r.subject: f"{to_words(r.subject)}: {r.text}" for r in discovery.reasons if r.rule == FILE}
    advice = [*contradictions.values(), recommend(discovery, update)[0], describe_next_drive(discovery)]
    minor = [text for e, text in describe_minor(discovery) if get_effect(e.name).fold][:MAX_MINOR]
    pairs = [("only the combination is identifiable", "; ".join(combinations)),
             *(("possible cause", text) for text in minor),
             ("unresolved", "; ".join(filter(None, unresolved))), ("recordings", _describe_findings(findings)),
             ("to do", "; ".join(filter(None, advice)))]
    return [(key, text) for key, text in pairs if text]


def _describe_findings(findings: Mapping[str, Sequence[Finding]]) -> str:
    """Sentences on the most serious error or warning of the recordings; "" if there is none."""
    serious = [(finding, names) for finding, names in group_findings(findings) if finding.severity is not Severity.NOTE]
    if not serious:
        return ""
    finding, names = serious[0]
    more = f" and {format_count(len(serious) - 1, 'more finding')}" if len(serious) > 1 else ""
    source = " as st check proposes" if finding.advice else ""
    correction = (f"Advice: {finding.advice.line}" if finding.advice and finding.advice.kind == "text" else
                  f"The recordings contain faults: correct them{source}, and run st discover again")
    details = "; ".join(filter(None, (", ".join(names), describe_effect(finding))))
    return f"{finding.text} ({details}){more}. {correction}"


def describe_minor(discovery: Discovery) -> list[tuple[result.FoundEffect, str]]:
    """Each minor effect with its values, their intervals, its alternatives, and why it is not reported as a cause."""
    reasons = {r.subject: r.text for r in discovery.reasons if r.rule in (MINOR, FORCES, IMPLAUSIBLE)}
    lines = []
    for e in (e for e in sort_by_size(discovery.minor) if e.name in reasons):
        values = "; ".join(quantities.format_parameters(e.name, e.parameters))
        names = name_with_alternatives(discovery, e, f"{to_words(e.name)} {values}")
        lines.append((e, f"{names}: without it or another in its place the 5 s position error changes by "
                      f"{format_metres(e.position_5s_increase, '+')}; {reasons[e.name]}"))
    return lines


def describe_drives(discovery: Discovery) -> list[tuple[str, str]]:
    """(role, text) for suspect and reference runs; the text lists their names and durations."""
    lines = []
    for role in ("suspect", "reference"):
        runs = [run for run in discovery.runs if run.role == role]
        names = ", ".join(f"{run.name} {run.seconds:.0f} s" for run in runs)
        sites = len({run.site for run in runs})
        locations = f" at {sites} sites (overlapping tracks are one site)" if sites > 1 else ""
        lines.append((role, f"{format_count(len(runs), 'run')}, {sum(r.seconds for r in runs):.0f} s"
                      f"{locations}: {names}" if runs else "none; the search starts from the vehicle file"))
    return lines


def explain_effects(discovery: Discovery) -> list[str]:
    """Equation and signs of each effect, with the quantities and effects on which its value depends."""
    lines = []
    for effect in sort_by_size(discovery.effects):
        definition = get_effect(effect.name)
        priors = [f"{a.key} {a.value:.4g} {a.unit} (standard deviation {a.deviation:.2g})"
                  for a in discovery.assumed if a.key in definition.ratio_to]
        signs = [f"{to_words(p.name)}: {p.meaning}" for p in definition.parameters if p.fit and p.meaning]
        parts = (definition.physics, *signs,
                 f"with the {' and '.join(priors)} of the vehicle file" if priors else "",
                 f"identifiable only together with {', '.join(map(to_words, effect.joint))}: they compensate for each "
                 "other" if effect.joint else "")
        lines.append(f"{to_words(effect.name)}: {'; '.join(filter(None, parts))}")
    if discovery.outcome == "unknown" or discovery.signature:
        lines.append("; ".join(("an effect that is not in the library", *discovery.signature)))
    return lines


def describe_varying(effect: result.VaryingEffect) -> str:
    """Sentence on an effect that varies between parts of the drives, with its most significant local values."""
    ranked = sorted(effect.values, key=lambda v: -abs(v.ratio) / max(v.deviation, 1e-9))[:MAX_PARTS]
    ratios = "; ".join(f"{v.subset}: {v.ratio:.2f} ± {Z95 * v.deviation:.2f}" for v in effect.values if v in ranked)
    more = f" and {len(effect.values) - len(ranked)} more" if len(effect.values) > len(ranked) else ""
    name = f"{to_words(effect.resembles)} {format_briefly(effect.resembles, effect.parameters)}"
    return (f"an effect that resembles {name} reduces the error by {format_metres(effect.position_5s_reduction)}, but "
            f"varies between {PARTITION_NAMES[effect.varies_with]}, so it is not a property of the car; local values "
            f"divided by this overall value: {ratios}{more}")


def describe_agreement(effect: result.FoundEffect) -> str:
    """Numbers of runs (or parts of runs) and sites with a significant estimate of the same sign as the overall one."""
    counts = []
    for partition in ("run", "site"):
        parts = effect.agreement.get(partition, ())
        noun = "parts of runs" if any(", part " in v.subset for v in parts) else f"{partition}s"
        significant = sum(v.ratio - Z95 * v.deviation > 0.0 for v in parts)
        counts += [f"{significant} of {len(parts)} {noun}"] if parts else []
    return ", ".join(counts) or "-"


def describe_residual(discovery: Discovery) -> str:
    """Sentence on residual position error, noise level and runs with large errors; "" without position errors."""
    position = discovery.errors.get("position_5s")
    if position is None:
        return ""
    after, noise = format_metres(position.augmented), format_metres(position.floor)
    text = f"residual 5 s position error {after}; noise level {noise}"
    if position.worst_run:
        text += f"; the run with the largest error is {position.worst_run} ({format_metres(position.worst)})"
    if position.worse_runs and discovery.model:
        text += f"; the error is larger than without the effects in {', '.join(position.worse_runs)}"
    return text


def format_combination(combination: result.Combination) -> str:
    """Name and value of a combination with 95 % interval, relative to the value of the vehicle file. Absolute values
    are reported for a delay, and for a stability factor, which may be 0 or negative in the file."""
    low, high = combination.interval
    if combination.unit == "s^2/m^2":
        return (f"{combination.name} {combination.value:.2g} s²/m² ({low:.2g} to {high:.2g}; vehicle file "
                f"{combination.file:.2g})")
    if combination.is_delay:
        others = [to_words(n) for n in combination.effects if combination.name not in get_effect(n).combinations]
        return " or ".join((f"{combination.name} {combination.value:.3f} s ({low:.3f} to {high:.3f})", *others))
    ratio, low, high = (value / combination.file for value in (combination.value, low, high))
    return f"{combination.name} {ratio:.2f} ({low:.2f} to {high:.2f}) times the vehicle file value"


def list_pair_rows(discovery: Discovery) -> list[tuple[str, ...]]:
    """Table row of each inseparable pair of effects, with the columns of PAIR_HEAD; smallest separation first."""
    return [(to_words(pair.first), to_words(pair.second), f"{pair.cosine:.3f}", format_separation(pair.strength))
            for pair in sorted(discovery.separability, key=lambda p: p.strength)]


def list_undetectable(discovery: Discovery) -> list[tuple[str, str, str, str]]:
    """Table row of each effect that is not detectable in these drives: effect; typical size, with the change of the
    position that it causes and the detectable size; reason; manoeuvre. Entries of the vehicle file first, then by this
    change, largest first."""
    typical = {p.effect: p for p in discovery.power_analysis.powers if p.probability < LIMITS.detection_power}
    sizes = {}
    for name, p in typical.items():
        details = [f"{format_metres(p.position_5s)} after 5 s"] if p.position_5s else []
        details += [f"detectable from about {quantities.format_deviation(float(f'{larger.size:.2g}'), p.unit)}"
                    for larger in discovery.power_analysis.powers if larger.effect == name and larger.size > p.size]
        sizes[name] = quantities.format_deviation(p.size, p.unit) + f" ({', '.join(details)})" * bool(details)
    ranked = sorted(discovery.not_testable, key=lambda n: (
        rank_by_kind(n.name), -typical[n.name].position_5s if n.name in typical else 0.0))
    return [(to_words(n.name), sizes.get(n.name, ""), n.reason, n.manoeuvre) for n in ranked]


def describe_undetectable(discovery: Discovery) -> str:
    """Effects that are not detectable in these drives, in the order of `list_undetectable`."""
    # The combination of these effects is detectable.
    combined = {to_words(name) for c in discovery.unseparated_combinations for name in c.effects}
    texts = [f"{name} of {size}" if size else name for name, size, *_ in list_undetectable(discovery)
             if name not in combined]
    more = f" and {len(texts) - MAX_UNDETECTABLE} more" if len(texts) > MAX_UNDETECTABLE else ""
    return f"not detectable in these drives: {', '.join(texts[:MAX_UNDETECTABLE])}{more}" if texts else ""


def format_separation(strength: float) -> str:
    """Text of a separation [standard deviations of the noise]."""
    return f"{strength:.1f}" if strength < MAX_SEPARATION else f"more than {MAX_SEPARATION:g}"


def describe_detectable(discovery: Discovery) -> str:
    """The smallest detectable size of each effect in these drives, vehicle parameters first."""
    undetectable = {n.name for n in discovery.not_testable}
    smallest: dict[str, result.Power] = {}
    for power in sorted(discovery.power_analysis.powers, key=lambda p: abs(p.size)):
        if power.probability >= LIMITS.detection_power and power.effect not in undetectable:
            smallest.setdefault(power.effect, power)
    ranked = sorted(smallest.values(), key=lambda p: rank_by_kind(p.effect))
    sizes = [f"{to_words(p.effect)} of {quantities.format_deviation(p.size, p.unit)}" for p in ranked]
    return f"detectable, one at a time: {', '.join(sizes)}" if sizes else ""


def rank_by_kind(name: str) -> tuple[bool, int]:
    """Sort key of an effect: entries of the vehicle file first, then in the order of BUDGET_PARTS."""
    effect = EFFECTS.get(name)
    return not (effect and effect.fold), BUDGET_PARTS.index(effect.kind) if effect else len(BUDGET_PARTS)


def describe_next_drive(discovery: Discovery) -> str:
    """The recommended next drive; "" for none."""
    drive = discovery.next_manoeuvre
    if drive is None:
        return ""
    first, second = map(to_words, drive.separates)
    current = next((p.strength for p in discovery.separability if {p.first, p.second} == set(drive.separates)), 0.0)
    return (f"next drive: {drive.name}, {drive.repetitions} times {drive.duration:.0f} s at {drive.speed:.1f} m/s, to "
            f"separate {first} and {second} by {format_separation(drive.strength)} σ of the noise (these drives: "
            f"{format_separation(current)} σ; required: {MIN_SEPARATION:g} σ)")


def describe_effective_corrections(discovery: Discovery) -> str:
    """Sentence on the effective corrections of the model; "" without any."""
    names = ", ".join(f"{to_words(e.name)} {format_briefly(e.name, e.parameters)} (5 s position error without it "
                      f"{format_metres(e.position_5s_increase, '+')})" for e in discovery.effective)
    return (f"{names}: each is marked effective in model.yaml: it improves predictions but is not a property of the car"
            if names and not discovery.increases_error else "")


def _list_vehicle_recommendations(discovery: Discovery, update: VehicleUpdate | None) -> list[str]:
    lines = []
    if update is not None and not update.text and not update.is_not_worse:
        before, after = update.error
        worse = ", ".join(update.worse_drives)
        increase = f", with a significant increase in {worse}" if worse else ""
        drives = "held-out drives" if discovery.leave_one_out else "these drives"
        reason = (f"values fitted without {worse} are outside the limits of a vehicle file" if math.isinf(after) else
                  f"alone it would change the position error after 5 s from {format_metres(before)} to "
                  f"{format_metres(after)} on {drives}{increase}")
        lines.append(f"vehicle.yaml is not written: {reason}{'' if discovery.increases_error else '; use model.yaml'}")
    if update is not None and update.required_slip_speed and not discovery.increases_error:
        lines.append(f"model.yaml needs minimum_slip_speed = {update.required_slip_speed:g} m/s for stable steps of "
                     "50 ms: set it in the vehicle file and run st discover again")
    lines += update.implausible_values if update is not None else ()
    lines += [f"{to_words(e.name)} is negative ({format_briefly(e.name, {name: p})}), which is not causal: a clock or "
              "a configured latency is wrong; check the clocks (st check, st align) before using it"
              for e in discovery.effects for name, p in e.parameters.items() if p.unit == "s" and p.interval[1] < 0.0]
    if update is not None and update.folded:
        changes = dict(update.changes)
        slip = changes.pop(SLIP_SPEED_KEY, None)
        entries = format_changes(changes) if len(changes) <= MAX_KEYS else f"{len(changes)} entries are corrected"
        stable = f"; {format_changes({SLIP_SPEED_KEY: slip})}, for stable steps of 50 ms" if slip else ""
        alone = ("; vehicle.yaml alone reduces the position error at the end of the horizon by "
                 f"{100 * (1.0 - update.error[1] / update.error[0]):.0f} %"
                 if (discovery.minor or discovery.effective) and update.error[0] > 0.0 else "")
        effects = ", ".join(map(to_words, update.folded))
        lines.append(f"use the new vehicle.yaml: {entries}, for {effects}{stable}{alone}")
        weak = {p.first for p in discovery.separability if p.strength < MIN_SEPARATION}
        lines += [f"vehicle.yaml contains the first of {name_with_alternatives(discovery, e)}; "
                  f"{'these drives do not' if e.name in weak else 'the model is not accurate enough to'} separate "
                  "them: measure one of them on the car"
                  for e in discovery.effects if e.name in update.folded and e.alternatives]
    return lines


def recommend(discovery: Discovery, update: VehicleUpdate | None) -> list[str]:
    """Recommendations, the most important first; ["nothing"] if there are none."""
    lines = _list_vehicle_recommendations(discovery, update)
    lines += [f"measure {to_words(e.name)} on the car, and check causes that have the same effect but are not in the "
              f"library: {e.other_causes}" for e in discovery.effects if e.other_causes]
    is_written = discovery.model is not None and not discovery.increases_error
    if discovery.increases_error:
        position = discovery.errors["position_5s"]
        lines.append("model.yaml is not written: with it, the position error after 5 s would increase significantly, "
                     f"from {format_metres(position.base)} to {format_metres(position.augmented)} on held-out driving")
    for name, changes in (update.not_folded if update is not None and is_written else {}).items():
        lines.append(f"{to_words(name)} is in model.yaml, because no entry of the vehicle file can correct it: these "
                     "recordings contain the road-wheel angle, or the model applies steering play before the ratio; "
                     f"for recordings of the steering-wheel angle, set {format_changes(changes)}")
    not_in_file = [e for e in discovery.effects if is_written and (update is None or e.name not in update.folded)]
    if sensors := [to_words(e.name) for e in not_in_file if e.kind == "sensors"]:
        lines.append(f"{', '.join(sensors)}: either use model.yaml, or correct the sensors or the recordings "
                     "(run.yaml) and run st discover again; doing both corrects the error twice")
    if not_in_file:
        lines.append(f"predict with model.yaml, which adds {', '.join(to_words(e.name) for e in not_in_file)}")
    if discovery.signature and discovery.effects:
        lines.append("the reported effects do not explain the whole error, and the residual may have biased their "
                     "values: compare them with known data of the car")
    if discovery.outcome == "unknown" or discovery.signature:
        lines.append("check in which conditions the model has large errors; you can add an effect of your own "
                     "(docs/manual/effects.md)")
    if discovery.outcome == "not_testable":
        manoeuvres = ", ".join(dict.fromkeys(n.manoeuvre for n in discovery.not_testable if n.manoeuvre))
        lines.append(f"record more driving{f' ({manoeuvres})' if manoeuvres else ''} and add it to the runs")
    if discovery.outcome == "ambiguous" and discovery.next_manoeuvre:
        lines.append("record the next drive and add it to the runs")
    if not all(c.is_delay for c in discovery.unseparated_combinations):
        prediction = "predict with model.yaml; " if is_written and not (discovery.effects or discovery.minor) else ""
        lines.append(f"{prediction}weigh the car and compare its tyres with those of the vehicle file")
    if discovery.minor and is_written:
        minor = ", ".join(name_with_alternatives(discovery, e) if discovery.effects else to_words(e.name)
                          for e in discovery.minor)
        start = "model.yaml also contains" if discovery.effects else "predict with model.yaml, which contains"
        caution = SLIP_CAUTION * any(get_effect(e.name).at_peak_force for e in (*discovery.minor, *discovery.effective))
        lines.append(f"{start} {minor}: part of the fit, but not reported as properties of the car{caution}")
    return lines or ["nothing"]


def format_changes(changes: Mapping[str, Sequence[float]]) -> str:
    """Entries of a vehicle file before and after a change; with SI units, because the file may use other units."""
    texts = []
    for key, values in changes.items():
        before, after = (f"{x:.0f}" if abs(x) >= 1000.0 else f"{x:.4g}" for x in values[:2])
        texts.append(f"{key} {before} → {after} {get_unit_symbol(FILE_QUANTITIES[key].si_unit)}".rstrip())
    return ", ".join(texts)


def list_details(discovery: Discovery, update: VehicleUpdate | None) -> list[tuple[str, list[str]]]:
    """(heading, sentences) of the sections below the summary, without empty sections."""
    decisions = [reason.text for reason in discovery.reasons if reason.subject == "outcome"]
    if discovery.power_analysis.measured:
        decisions.append(f"false alarms: an effect was reported in {discovery.power_analysis.alarms} of "
                         f"{discovery.power_analysis.simulated_drives} simulated drives without an effect")
    minor = [text for _, text in describe_minor(discovery)]
    priors = ", ".join(f"{a.key} {format_estimate(a.value, (a.value - a.deviation, a.value + a.deviation), a.unit)}"
                       f"{'' if a.stated else ' (default uncertainty)'}"
                       for a in discovery.assumed if not a.key.startswith("tyre_"))
    change = "; to change an uncertainty, set `uncertainty` in the entry of the vehicle file"
    sections = [*((role, [text]) for role, text in describe_drives(discovery)), ("meaning", explain_effects(discovery)),
                ("decision", decisions), ("minor effects", minor),
                ("to do", recommend(discovery, update)[1:]),
                ("effective corrections", [describe_effective_corrections(discovery)]),
                ("priors from the vehicle file", [priors + change] if priors else []),
                ("varying effects", list(map(describe_varying, discovery.varying))),
                ("detectability", [describe_detectable(discovery)])]
    return [(heading, texts) for heading, section in sections if (texts := [text for text in section if text])]


def describe_condition(region: result.LargeErrorRegion) -> tuple[str, str]:
    """(driving condition of large errors, their ratio to the expected error with the 95 % interval)."""
    first = region.condition.split()[0]
    preposition = ("" if first in ("everywhere", "within") else
                   "at " if first in ("speed", "lateral", "road-wheel", "steering", "forward") else "in ")
    condition = preposition + region.condition.replace("^2", "²")
    if region.excess > MAX_RATIO:
        return condition, f"more than {MAX_RATIO:g}"
    low, high = region.interval
    interval = f"{low:.1f} to {high:.1f}" if high < MAX_RATIO else f"more than {low:.1f}"
    return condition, f"{region.excess:.1f} ({interval})"
