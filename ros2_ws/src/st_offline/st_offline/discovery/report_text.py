"""A discovery in sentences and rows of tables, for the terminal and the page."""

import math
from collections.abc import Mapping, Sequence

from st_core.channels import LABELS
from st_core.checks import Finding, Severity
from st_core.discovery.decision import FILE, FORCES, IMPLAUSIBLE, MINOR
from st_core.discovery.next_manoeuvre import MIN_SEPARATION
from st_core.discovery.result import (
    PARTS,
    Combination,
    Discovery,
    ErrorCondition,
    ForceCurve,
    FoundEffect,
    Power,
    Step,
    VaryingEffect,
)
from st_core.discovery.settings import Limits
from st_core.effects import EFFECTS, get_effect
from st_core.vehicle import VEHICLE_QUANTITIES

from ..checking.check_report import describe_effect, group_by_name
from .quantities import change, channel, decimal, decimals, fitted, metres, plain, short_values, size, values
from .vehicle_update import SLIP_SPEED, VehicleUpdate

MAX_PARTS = 6
MAX_UNDETECTABLE = 4  # effects listed in a sentence; the table contains all
MAX_KEYS = 3  # keys of a vehicle file listed in a sentence; the table contains all
MIN_CHANGE = 0.005  # m; smaller changes of the position error are replaced by the channel with the largest change
MAX_SEPARATION = 10.0  # standard deviations
MAX_RATIO = 1000.0  # times the expected error; predictions with larger errors have diverged
Z95 = 1.96
LIMITS = Limits()
UNEXPLAINED = "a residual remains that no effect of the library explains"
EFFECT_HEAD = ("effect", "value (95 % interval)", "5 s position error without it", "reduces most", "significant in")
EFFECT_NOTE = ("Errors: complete model, held-out drives. Without it: this effect removed, the others refitted. An "
               "effect is named if it is significant and reduces the error of a channel by "
               f"{100 * LIMITS.relevant:g} % of its baseline, or the 5 s position error by "
               f"{LIMITS.relevant_position:g} m, over all driving or in one driving condition, or if it is a sensor "
               f"error, evident from redundant sensors, of at least {LIMITS.min_relative_size:g} times its typical "
               "size")


def with_alternatives(found: Discovery, effect: FoundEffect, short: str = "") -> str:
    """Name and value of an effect and of its alternatives, each fitted in place of the effect; for an added load, the
    upper limit. short: text in place of the name and value of the effect."""
    numbers = {c.name: c.parameters for c in found.candidates}
    prefix = {name: "up to " for name in effect.alternatives
            if any(p.deviation < math.inf for p in get_effect(name).parameters)}
    others = (f"{plain(name)} {prefix.get(name, '')}{fitted(name, numbers.get(name, {}))}".strip()
              for name in effect.alternatives)
    return " or ".join((short or f"{plain(effect.name)} {short_values(effect.name, effect.parameters)}", *others))


def by_size(effects: Sequence[FoundEffect]) -> list[FoundEffect]:
    """Sorted by the increase of the position error without each, largest first."""
    return sorted(effects, key=lambda e: -e.position_5s_increase)


def effect_rows(found: Discovery) -> list[tuple[str, str, str, str, str]]:
    """A row for each named effect, columns as EFFECT_HEAD."""
    return [(with_alternatives(found, e, plain(e.name)), "; ".join(values(e.name, e.parameters)),
             f"{'+' if e.position_5s_increase >= 0.0 else '−'}{metres(abs(e.position_5s_increase))}",
             f"{channel(e.channel)} error by {100 * e.share:.0f} %" if e.channel and e.share >= 0.005 else "-",
             agreement(e)) for e in by_size(found.effects)]


def most_reduced_channel(step: Step) -> str:
    """The channel whose error a step reduces most; empty if there is none."""
    ratios = {key: one.augmented / one.base for key, one in step.channels.items() if one.base > 0}
    best = min(ratios, key=ratios.__getitem__, default=None)
    return f"{channel(best)} error {100 * (ratios[best] - 1.0):+.0f} %".replace("-", "−") if best else ""


def title(found: Discovery) -> str:
    """The result in one line."""
    if found.outcome == "not_testable":
        return "These drives have too little excitation for a result"
    effects = [with_alternatives(found, e) for e in by_size(found.effects)]
    together = map(ratio_to_file, found.known_together)
    named = "; ".join((*effects, *together) if _explains_most(found) else (*together, *effects))
    if found.outcome == "unknown":
        known = f"; in addition {named}" if named else ""
        return f"{_errors(found)}: a significant error that no effect of the library explains{known}"
    unexplained = f"{UNEXPLAINED}: {found.signature[0]}" if found.signature else ""
    more = f"; {unexplained}" if unexplained else ""
    if named:
        return f"{_errors(found)}: {named}{more}"
    if found.outcome == "varying":
        varying = ", ".join(f"an effect that resembles {plain(b.resembles)} ({metres(b.position_5s_reduction)}) but "
                            f"varies with {b.varies_with}" for b in found.varying)
        return f"{_errors(found)}: {'; '.join(filter(None, (unexplained, varying, 'no effect is named')))}"
    return f"{_errors(found)}: no significant model error"


def _explains_most(found: Discovery) -> bool:
    """Whether one named effect makes up more than half of the reduction of the position error."""
    position = found.errors.get("position_5s")
    return position is None or any(e.position_5s_increase > 0.5 * (position.base - position.augmented)
                                   for e in found.effects)


def _errors(found: Discovery) -> str:
    position = found.errors.get("position_5s")
    if position is None:
        name = next((n for n in LABELS if n in found.errors), None)
        if name is None:
            return "Errors"
        one = found.errors[name]
        ratio = 100.0 * (one.augmented / one.base - 1.0)
        return f"{channel(name)} error {size(one.base, one.unit)} to {size(one.augmented, one.unit)} ({ratio:+.0f} %)"
    named = found.named_errors["position_5s"].augmented if found.effective else position.augmented
    effective = named - position.augmented > LIMITS.relevant_position
    after = "" if found.model is None else f" → {metres(named if effective else position.augmented)}"
    after += f", {metres(position.augmented)} with effective corrections" if effective else ""
    more = len(found.minor) + (0 if effective else len(found.effective)) if found.effects else 0
    others = f", with {more} more effect{'' if more == 1 else 's'} that {'is' if more == 1 else 'are'} not named"
    return f"5 s position error {metres(position.base)}{after} (held-out{others if more else ''})"


def summary(found: Discovery, update: VehicleUpdate | None, findings: Mapping[str, Sequence[Finding]]
            ) -> list[tuple[str, str]]:
    """(name, text) below the title: residual, inseparable and undetectable effects, recordings, recommendations.
    findings: of the checks, by run."""
    unknown = [residual(found), not_separable(found), not_detectable(found)]
    serious = [(one, names) for one, names in group_by_name(findings) if one.severity is not Severity.NOTE]
    recordings = ""
    if serious:
        one, names = serious[0]
        more = f" and {len(serious) - 1} more" if len(serious) > 1 else ""
        correction = ("These are errors of the recordings: correct them as st check proposes, and run st discover again"
                      if one.advice is None or one.advice.kind != "look" else f"Advice: {one.advice.line}")
        recordings = f"{one.text} ({', '.join(filter(None, (*names, describe_effect(one))))}){more}. {correction}"
    do = to_do(found, update)
    together = [f"{ratio_to_file(one)}: {', '.join(map(plain, one.effects[:-1]))} or "
                f"{plain(one.effects[-1])}, which these drives do not separate" for one in found.known_together]
    pairs = [("only the combination is identifiable", "; ".join(together)),
             ("not known", "; ".join(filter(None, unknown))), ("recordings", recordings),
             ("to do", "; ".join(filter(None, [*contradicted_quantities(found), do[0], next_drive(found)])))]
    return [(key, text) for key, text in pairs if text]


def drives(found: Discovery) -> list[tuple[str, str]]:
    """Names and durations of the suspect runs and of the reference runs."""
    lines = []
    for role in ("suspect", "reference"):
        runs = [run for run in found.runs if run.role == role]
        names = ", ".join(f"{run.name} {run.seconds:.0f} s" for run in runs)
        sites = len({run.site for run in runs})
        where = f" at {sites} sites (overlapping tracks are one site)" if sites > 1 else ""
        lines.append((role, f"{len(runs)} run{'' if len(runs) == 1 else 's'}, {sum(r.seconds for r in runs):.0f} s"
                      f"{where}: {names}" if runs else "none; the search starts from the vehicle file"))
    return lines


def meaning(found: Discovery) -> list[str]:
    """Equation of each effect, and the quantities and effects that its value depends on."""
    lines = []
    for effect in by_size(found.effects):
        kind = EFFECTS.get(effect.name)
        known = next((a for a in found.assumed if kind and a.key == kind.ratio_to), None)
        signs = [f"{plain(p.name)}: {p.meaning}" for p in kind.parameters if p.fit and p.meaning] if kind else []
        parts = (kind.physics if kind else "", *signs,
                 f"if the {known.key} is {known.value:.4g} ± {known.deviation:.2g} {known.unit}" if known else "",
                 f"identifiable only together with {', '.join(map(plain, effect.joint))}: they compensate each other"
                 if effect.joint else "")
        lines.append(f"{plain(effect.name)}: {'; '.join(filter(None, parts))}" if any(parts) else "")
    if found.outcome == "unknown" or found.signature:
        lines.append("; ".join(("an effect that is not in the library", *found.signature)))
    return lines


def describe_varying(effect: VaryingEffect) -> str:
    """An effect that varies between parts of the drives, with its most significant local values."""
    ranked = sorted(effect.values, key=lambda v: -abs(v.ratio) / max(v.deviation, 1e-9))[:MAX_PARTS]
    ratios = "; ".join(f"{v.where}: {v.ratio:.2f} ± {Z95 * v.deviation:.2f}" for v in effect.values if v in ranked)
    more = f" and {len(effect.values) - len(ranked)} more" if len(effect.values) > len(ranked) else ""
    name = f"{plain(effect.resembles)} {short_values(effect.resembles, effect.parameters)}"
    reduction = metres(effect.position_5s_reduction)
    return (f"an effect that resembles {name} reduces the error by {reduction}, but varies with {effect.varies_with}, "
            f"so it is not a property of the car; local values relative to this one: {ratios}{more}")


def agreement(effect: FoundEffect) -> str:
    """Number of runs (if few: of parts of runs) and of sites in which an effect is significant on its own."""
    counts = []
    for partition in ("run", "site"):
        parts = effect.agreement.get(partition, ())
        called = "parts of runs" if any(", part " in v.where for v in parts) else f"{partition}s"
        above = sum(v.ratio - Z95 * v.deviation > 0.0 for v in parts)
        counts += [f"{above} of {len(parts)} {called}"] if parts else []
    return ", ".join(counts) or "-"


def certainty(found: Discovery) -> list[str]:
    """The rule that decided the outcome, and its measured false alarm rate."""
    lines = [reason.text for reason in found.reasons if reason.subject == "outcome"]
    if found.certificate.measured:
        lines.append(f"false alarms: an effect was named in {found.certificate.alarms} of "
                     f"{found.certificate.simulated_drives} simulated drives without any")
    return lines


def residual(found: Discovery) -> str:
    """The residual and the noise."""
    position = found.errors.get("position_5s")
    if position is None:
        return ""
    after = position.augmented if found.model else position.base
    text = f"residual 5 s position error {metres(after)}; noise floor {metres(position.floor)}"
    worst = f"; the worst run is {position.worst_run} with {metres(position.worst)}" if position.worst_run else ""
    worse = f"; larger than before in {', '.join(position.worse_runs)}" if position.worse_runs and found.model else ""
    return f"{text}{worst}{worse}"


def ratio_to_file(combination: Combination) -> str:
    """Ratio of a combination to that of the vehicle file, or a delay, with its 95 % interval."""
    low, high = combination.interval
    if combination.is_time:
        return f"{combination.name} {combination.value:.3f} s ({low:.3f} to {high:.3f})"
    ratio, low, high = (value / combination.file for value in (combination.value, low, high))
    return f"{combination.name} {ratio:.2f} ({low:.2f} to {high:.2f}) times the vehicle file value"


def not_separable(found: Discovery) -> str:
    """Effects that explain the drives equally well, with the limits of this test, or that compensate for each other."""
    names = [" or ".join(map(plain, (e.name, *e.alternatives))) for e in found.effects if e.alternatives]
    pairs = [f"{plain(e.name)} with {', '.join(map(plain, e.joint))} (they compensate for each other)"
             for e in found.effects if e.joint]
    limits = (f" (each has at least {100 * LIMITS.min_rival_gain:g} % of the first one's gain, and is not "
              f"significantly worse, p >= {LIMITS.undecided_p:g}, or worse by less than "
              f"{100 * LIMITS.unexplained_share:g} % of a residual above {LIMITS.max_noise_ratio:g} times the noise)"
              ) if names else ""
    return f"not separable: {'; '.join((*names, *pairs))}{limits}" if names or pairs else ""


PAIR_HEAD = ("effect", "alternative", f"share of the gain (limit {LIMITS.min_rival_gain:.0%})",
             f"increase of the residual (limit {LIMITS.unexplained_share:.0%})",
             f"p (limit {LIMITS.undecided_p:g})", "cosine", "separation, σ of the noise")


def pair_rows(found: Discovery) -> list[tuple[str, ...]]:
    """A row for each pair of effects that is not separable, columns as PAIR_HEAD; the smallest separation first."""
    rows = []
    for pair in sorted(found.separability, key=lambda p: p.strength):
        figures = next((r.figures for r in found.reasons if r.rule == "alternative" and r.subject == pair.second
                        and f"{plain(pair.first)} it " in r.text), {})
        rows.append((plain(pair.first), plain(pair.second), *(f"{figures[key]:{form}}" if key in figures else "-" for
                     key, form in (("share", ".0%"), ("deficit", ".1%"), ("p_no_worse", ".2g"))),
                     f"{pair.cosine:.3f}", separation(pair.strength)))
    return rows


def not_detectable(found: Discovery) -> str:
    """The first effects that are not detectable in these drives, with the largest size tried, vehicle parameters
    first."""
    largest = {p.effect: p for p in sorted(found.certificate.powers, key=lambda p: abs(p.size))}
    combined = {name for one in found.known_together for name in one.effects}  # their sum is known
    ranked = sorted((n.name for n in found.not_testable if n.name not in combined), key=rank)
    names = ", ".join(plain(name) + (f" of {change(largest[name].size, largest[name].unit)}" if name in largest else "")
                      for name in ranked[:MAX_UNDETECTABLE])
    more = len(ranked) - MAX_UNDETECTABLE
    return f"not detectable in these drives: {names}{f' and {more} more' if more > 0 else ''}" if names else ""


def contradicted_quantities(found: Discovery) -> list[str]:
    """Quantities of the vehicle file that the best fit contradicts."""
    texts = {r.subject: r.text for r in found.reasons if r.rule == FILE}
    return [f"{plain(name)}: {text}" for name, text in texts.items()]


def separation(strength: float) -> str:
    """A separation [standard deviations] as text; large ones are outside the linear range of the prediction."""
    return f"{strength:.1f}" if strength < MAX_SEPARATION else f"more than {MAX_SEPARATION:g}"


def detectable_sizes(found: Discovery) -> str:
    """The smallest detectable size of each effect in these drives, vehicle parameters first."""
    best: dict[str, Power] = {}
    for power in sorted(found.certificate.powers, key=lambda p: abs(p.size)):
        if power.probability >= LIMITS.detection_power:
            best.setdefault(power.effect, power)
    ranked = sorted(best.values(), key=lambda p: rank(p.effect))
    sizes = [f"{plain(p.effect)} of {change(p.size, p.unit)}" for p in ranked]
    return f"detectable, one at a time: {', '.join(sizes)}" if sizes else ""


def rank(name: str) -> tuple[bool, int]:
    """Vehicle parameters first, then by part."""
    kind = EFFECTS[name].kind if name in EFFECTS else ""
    return kind != "vehicle parameters", PARTS.index(kind) if kind in PARTS else len(PARTS)


def next_drive(found: Discovery) -> str:
    """The recommended next drive; "" for none."""
    n = found.next_manoeuvre
    if n is None:
        return ""
    first, second = map(plain, n.separates)
    now = next((p.strength for p in found.separability if {p.first, p.second} == set(n.separates)), 0.0)
    return (f"next drive {n.name}, {n.times} times {n.duration:.0f} s at {n.speed:.1f} m/s: would separate {first} and "
            f"{second} by {separation(n.strength)} σ of the noise (these drives: {separation(now)} σ; required: "
            f"{MIN_SEPARATION:g} σ)")


def prior_quantities(found: Discovery) -> list[str]:
    """Quantities of the vehicle file used as priors, with their standard deviations."""
    known = []
    for a in (a for a in found.assumed if not a.key.startswith("tyre_")):
        value, deviation = (decimal(number, decimals(a.deviation)) for number in (a.value, a.deviation))
        known.append(f"{a.key} {value} ± {deviation} {a.unit.removesuffix('1')}".rstrip()
                     + ("" if a.stated else " (default)"))
    return [f"{', '.join(known)}; to override, set `uncertainty` in the entry of the vehicle file"] if known else []


def force_ratio(curve: ForceCurve) -> str:
    """Ratio of the force at the largest driven slip to that of the vehicle file, with its 90 % band."""
    force, low, high = (force_curve[-1] / curve.file[-1] for force_curve in (curve.force, curve.low, curve.high))
    return f"{force:.2f} (90 %: {low:.2f} to {high:.2f}) times the file's at {math.degrees(curve.slip[-1]):.1f}°"


def corrections(found: Discovery) -> list[str]:
    """Effective corrections of the model, which are not properties of the car."""
    if not found.effective:
        return []
    position, named = (one.get("position_5s") for one in (found.errors, found.named_errors))
    errors = f" ({metres(named.augmented)} → {metres(position.augmented)} after 5 s)" if position and named else ""
    names = ", ".join(f"{plain(e.name)} {short_values(e.name, e.parameters)}" for e in found.effective)
    return [f"{names}{errors}: improves predictions, but is not a property of the car; in model.yaml, marked effective"]


def _vehicle_lines(found: Discovery, update: VehicleUpdate | None) -> list[str]:
    """Recommendations on the vehicle file."""
    lines = []
    if update is not None and not update.text and not update.improves:
        where = f", and increase it in {', '.join(update.worse)}" if update.worse else ""
        lines.append(f"vehicle.yaml is not written: alone it would change the position error after 5 s from "
                     f"{metres(update.error[0])} to {metres(update.error[1])} on held-out drives{where}; "
                     "use model.yaml")
    if update is not None and update.slip_speed:
        lines.append(f"model.yaml needs minimum_slip_speed = {update.slip_speed:g} m/s for stable steps of 50 ms: set "
                     "it in the vehicle file and run st discover again")
    lines += update.objections if update is not None else ()
    lines += [f"{plain(e.name)} is negative ({short_values(e.name, {name: p})}), which is not causal: a clock or a "
              "configured latency is wrong; check the clocks (st check, st align) before using it"
              for e in found.effects for name, p in e.parameters.items() if p.unit == "s" and p.interval[1] < 0.0]
    if update is not None and update.folded:
        changes = {key: change for key, change in update.changes.items() if key != SLIP_SPEED}
        slip = {key: change for key, change in update.changes.items() if key == SLIP_SPEED}
        entries = format_changes(changes) if len(changes) <= MAX_KEYS else f"{len(changes)} entries are corrected"
        stable = f"; {format_changes(slip)}, for stable steps of 50 ms" if slip else ""
        position = found.errors.get("position_5s")
        together = (f", with model.yaml by {1.0 - position.augmented / position.base:.0%}"
                    if position and position.base > 0.0 else "")
        alone = (f"; vehicle.yaml alone reduces the position error after 5 s by "
                 f"{1.0 - update.error[1] / update.error[0]:.0%}{together}"
                 if (found.minor or found.effective) and update.error[0] > 0.0 else "")
        effects = ", ".join(map(plain, update.folded))
        lines.append(f"use the vehicle.yaml written here: {entries}, for {effects}{stable}{alone}")
        weak = {p.first for p in found.separability if p.strength < MIN_SEPARATION}
        lines += [f"vehicle.yaml contains the first of {with_alternatives(found, e)}; "
                  f"{'these drives do not' if e.name in weak else 'the model is not accurate enough to'} separate "
                  "them: measure one of them on the car"
                  for e in found.effects if e.name in update.folded and e.alternatives]
    return lines


def to_do(found: Discovery, update: VehicleUpdate | None) -> list[str]:
    """Recommendations, the most important first."""
    lines = _vehicle_lines(found, update)
    for name, change_of in (update.kept if update is not None else {}).items():
        lines.append(f"{plain(name)} is in model.yaml, because no entry of the vehicle file can correct it: these "
                     "recordings contain the road wheel angle, or play in the steering acts before the ratio; for "
                     f"recordings of the steering wheel, set {format_changes(change_of)}")
    rest = [e for e in found.effects if update is None or e.name not in update.folded]
    sensors = [plain(e.name) for e in rest if e.kind == "sensors"]
    if sensors:
        lines.append(f"{', '.join(sensors)}: either use model.yaml, or correct the sensors or the recordings "
                     "(run.yaml) and run st discover again; doing both corrects the error twice")
    others = [plain(e.name) for e in rest if update is None or e.name not in update.kept]
    if others:
        lines.append(f"predict with model.yaml, which adds {', '.join(others)}")
    if found.signature and found.effects:
        lines.append("the named effects do not explain the whole error, and their values may contain a part of the "
                     "residual: compare them with known data of the car")
    if found.outcome == "unknown" or found.signature:
        lines.append("see where the model has large errors; you can add an effect of your own (docs/manual/effects.md)")
    manoeuvres = list(dict.fromkeys(n.manoeuvre for n in found.not_testable if n.manoeuvre))
    if found.outcome == "not_testable":
        lines.append(f"drive more{': ' + ', '.join(manoeuvres) if manoeuvres else ''}, and add it to the runs")
    if found.outcome == "ambiguous" and found.next_manoeuvre is not None:
        lines.append("record the next drive and add it to the runs")
    if not all(c.is_time for c in found.known_together):
        use = "" if found.effects or found.model is None else "predict with model.yaml; "
        lines.append(f"{use}weigh the car and compare its tyres with those of the vehicle file")
    if found.minor and found.effects:
        kept = ", ".join(with_alternatives(found, e) for e in found.minor)
        lines.append(f"model.yaml also contains {kept}: part of the fit, not named, not properties of the car")
    elif found.minor:
        lines.append(f"model.yaml contains {', '.join(plain(e.name) for e in found.minor)}: part of the fit, not named")
    return lines or ["nothing"]


def format_changes(changes_of: Mapping[str, Sequence[float]]) -> str:
    """Keys of a vehicle file before and after; SI, with the unit, since the file may use another."""
    units = {key: VEHICLE_QUANTITIES[key].si_unit.removesuffix("1") for key in changes_of if key in VEHICLE_QUANTITIES}
    numbers = {key: [f"{x:.0f}" if abs(x) >= 1000.0 else f"{x:.4g}" for x in pair[:2]]
               for key, pair in changes_of.items()}
    return ", ".join(f"{key} {' → '.join(pair)} {units.get(key, '')}".rstrip() for key, pair in numbers.items())


def details(found: Discovery, update: VehicleUpdate | None) -> list[tuple[str, list[str]]]:
    """(question, sentences) below the summary; questions without sentences are left out."""
    why = {r.subject: r.text for r in found.reasons if r.rule in (MINOR, FORCES, IMPLAUSIBLE)}
    minor = [f"{with_alternatives(found, e)}: {why[e.name]}" for e in by_size(found.minor) if e.name in why]
    lines = [*((role, [text]) for role, text in drives(found)), ("meaning", meaning(found)),
             ("tests passed", certainty(found)), ("not named", minor), ("what to do", to_do(found, update)[1:]),
             ("effective corrections", corrections(found)), ("taken from the vehicle file", prior_quantities(found)),
             ("varying, not named", list(map(describe_varying, found.varying))),
             ("these drives", [detectable_sizes(found)])]
    return [(heading, texts) for heading, section in lines if (texts := [text for text in section if text])]


def condition(w: ErrorCondition) -> tuple[str, str]:
    """(condition of an error, ratio to the expected error with its 95 % interval)."""
    before = {"everywhere": "", "within": "", "speed": "at ", "lateral": "at ", "steering": "at ", "forward": "at "}
    where = before.get(w.condition.split()[0], "in ") + w.condition.replace("^2", "²")
    if w.excess > MAX_RATIO:
        return where, f"more than {MAX_RATIO:g}"
    low, high = w.interval
    return where, f"{w.excess:.1f} ({f'{low:.1f} to {high:.1f}' if high < MAX_RATIO else f'more than {low:.1f}'})"


def worst_channel(found: Discovery, channels: Sequence[str]) -> str:
    """The channel with the largest excess over the expected error."""
    known = [w for w in found.where if w.channel in channels]
    return max(known, key=lambda w: w.interval[0]).channel if known else channels[0]
