"""What a discovery says, in sentences: the same in the terminal and on the page."""

import math
from collections.abc import Mapping, Sequence

from st_core.channels import WORDS
from st_core.discovery.decision import FILE
from st_core.discovery.limits import Limits
from st_core.discovery.result import (
    PARTS,
    BoundEffect,
    BudgetLine,
    Discovery,
    ForceCurve,
    FoundEffect,
    Gap,
    Power,
    Step,
    Value,
    WhereStatement,
)
from st_core.effects import EFFECTS
from st_core.vehicle import VEHICLE_QUANTITIES

from .quantities import change, channel, fitted_shortly, metres, plain, short_values, size, values
from .vehicle_update import VehicleUpdate

MOST_PARTS = 6
MOST_BLIND = 8  # told in a sentence; all are in the table
LEAST = 0.005  # m; a step that changes the position by less is told by the channel it changes most
MOST_WORST = 2
MOST_TIMES = 1000.0  # the expected error: beyond that predictions diverge
SURE = 1.96
SHOWN = Limits().shown


def by_any_name(found: Discovery, effect: FoundEffect) -> str:
    """Name and value, and those of its alternatives, each with the value it has in that place."""
    values = {c.name: c.parameters for c in found.candidates}
    others = (f"{plain(name)} {fitted_shortly(name, values.get(name, {}))}".strip() for name in effect.alternatives)
    return " or ".join((f"{plain(effect.name)} {short_values(effect.parameters)}", *others))


def taken(steps: Sequence[Step]) -> dict[str, float]:
    """Metres of the mean held-out position error after 5 s that each effect of the waterfall takes away.

    What replaces another inherits what that took; what was taken back later leaves its part under "".
    """
    found: dict[str, float] = {}
    for step in steps:
        less = step.position_5s.base - step.position_5s.augmented
        if step.action == "removed":
            found[""] = found.get("", 0.0) + less + found.pop(step.effect, 0.0)
        else:
            before = found.pop(step.instead, 0.0) if step.action == "exchanged" else 0.0
            found[step.effect] = found.get(step.effect, 0.0) + before + less
    return found


def step_name(step: Step) -> str:
    """A step of the waterfall: "+ steering ratio", "- mass", "mass instead of friction"."""
    if step.action == "exchanged":
        return f"{plain(step.effect)} instead of {plain(step.instead)}"
    return f"{'+' if step.action == 'added' else '−'} {plain(step.effect)}"


def share_of(name: str, steps: Sequence[Step]) -> str:
    """What an effect takes away: metres, or of another channel where it takes away none."""
    away = taken(steps).get(name, 0.0)
    mine = [step for step in steps if step.effect == name and step.action != "removed"]
    return (metres(away) if away >= LEAST or not mine else other_channel(mine[-1])) or metres(away)


def other_channel(step: Step) -> str:
    """The channel whose error a step makes smallest; empty without any."""
    ratios = {key: one.augmented / one.base for key, one in step.channels.items() if one.base > 0}
    best = min(ratios, key=ratios.__getitem__, default=None)
    return f"{channel(best)} error {100 * (ratios[best] - 1.0):+.0f} %".replace("-", "−") if best else ""


def changes(found: Discovery) -> str:
    """The held-out position error, before and after."""
    gap = found.gap.get("position_5s")
    if gap is None:
        gap_name = next((n for n in WORDS if n in found.gap), None)
        return f"{channel(gap_name)} error {before_and_after(found.gap[gap_name])}" if gap_name else "Errors"
    if found.model is None:
        return f"5 s position error {metres(gap.base)} (held-out)"
    return f"5 s position error {metres(gap.base)} → {metres(gap.augmented)} (held-out)"


UNEXPLAINED = "more is missing that no known effect explains"


def title(found: Discovery) -> str:
    """The answer in a line."""
    if found.outcome == "not_testable":
        return "These drives show too little to say what may be missing"
    sentences = ", ".join(f"{by_any_name(found, e)} ({share_of(e.name, found.steps)})" for e in found.effects)
    if found.outcome == "unknown":
        known = f"; in addition {sentences}" if sentences else ""
        return f"{changes(found)}: something is missing that no known effect explains{known}"
    more = f"; {UNEXPLAINED}: {found.signature[0]}" if found.signature else ""
    if sentences:
        return f"{changes(found)}: {sentences}{more}"
    if found.outcome == "bound":
        tied = ", ".join(f"something like {plain(b.resembles)} ({metres(b.position_5s)}), tied to {b.to}"
                         for b in found.bound)
        return f"{changes(found)}: {tied}; nothing is named{more}"
    return f"{changes(found)}: nothing is missing with certainty"


def drives(found: Discovery) -> list[tuple[str, str]]:
    """Which runs are suspect and which are reference, by name and seconds."""
    lines = []
    for role in ("suspect", "reference"):
        mine = [run for run in found.runs if run.role == role]
        sentences = ", ".join(f"{run.name} {run.seconds:.0f} s" for run in mine)
        sites = len({run.site for run in mine})
        where = f" at {sites} sites (overlapping tracks are one site)" if sites > 1 else ""
        lines.append((role, f"{len(mine)} run{'' if len(mine) == 1 else 's'}, {sum(r.seconds for r in mine):.0f} s"
                      f"{where}: {sentences}" if mine else "none; the search starts from the vehicle file"))
    return lines


def what(found: Discovery) -> list[str]:
    """One line for each effect."""
    parts = []
    for effect in found.effects:
        physics = EFFECTS[effect.name].physics if effect.name in EFFECTS else ""
        others = ", ".join(map(plain, effect.alternatives))
        joint = f" (with {', '.join(map(plain, effect.joint))} only: they cancel)" if effect.joint else ""
        parts.append(f"{plain(effect.name)}{f' (or {others}: not ruled out)' if others else ''}{joint}, {effect.kind}: "
                     + values(effect.name, effect.parameters) + condition_of(found, effect)
                     + (f"; {physics}" if physics else ""))
    if found.outcome == "unknown" or found.signature:
        parts.append("; ".join(("something that is not in the library", *found.signature)))
    return parts or ["no effect is added to the model"]


def condition_of(found: Discovery, effect: FoundEffect) -> str:
    """The vehicle file's quantity on which a value depends, as stiffness and inertia on the mass; empty without one."""
    key = EFFECTS[effect.name].ratio_to if effect.name in EFFECTS else ""
    known = next((a for a in found.assumed if a.key == key), None)
    return f", if the {key} is {known.value:.4g} ± {known.deviation:.2g} {known.unit}" if known else ""


def clearest(values_of: Sequence[Value], most: int) -> list[Value]:
    """The parts that say most, in their order."""
    sentences = sorted(values_of, key=lambda v: -abs(v.share) / max(v.deviation, 1e-9))[:most]
    return [v for v in values_of if v in sentences]


def tied(one: BoundEffect) -> str:
    sentences = clearest(one.values, MOST_PARTS)
    shown = "; ".join(f"{v.where}: {v.share:.2f} ± {SURE * v.deviation:.2f}" for v in sentences)
    more = f" and {len(one.values) - len(sentences)} more" if len(one.values) > len(sentences) else ""
    return (f"something like {plain(one.resembles)} {short_values(one.parameters)} removes {metres(one.position_5s)} "
            f"but is not the same everywhere, so it is no property of the car; tied to {one.to}, with the shares "
            f"{shown}{more}")


def showing(entries: Sequence[Value]) -> int:
    """How many parts of the driving show an effect by themselves: share above zero with 95 %."""
    return sum(v.share - SURE * v.deviation > 0.0 for v in entries)


def agreed(effect: FoundEffect) -> str:
    """In how many runs (of few runs: parts of them) and sites an effect shows. Places are too small to ask."""
    sentences = []
    for level in ("run", "site"):
        shown = effect.agreement.get(level, ())
        called = "parts of the runs" if any(", part " in v.where for v in shown) else f"{level}s"
        sentences += [f"{showing(shown)} of {len(shown)} {called}"] if shown else []
    entries = [v for level in ("run", "site") for v in effect.agreement.get(level, ())]
    if not entries:
        return ""
    low, high = min(entries, key=lambda v: v.share), max(entries, key=lambda v: v.share)
    return (f"{plain(effect.name)} is visible separately in {', '.join(sentences)}; smallest share {low.share:.2f} "
            f"of the value ({low.where}), largest {high.share:.2f} ({high.where})")


def sure(found: Discovery) -> list[str]:
    """The rules that decided, and how far the parts of the driving agree."""
    sentences = [reason.text for reason in found.reasons if reason.subject == "answer"]
    sentences += filter(None, map(agreed, found.effects))
    certificate = found.certificate
    if certificate.driven:
        sentences.append(f"with the same inputs and without any effect, something was stated {certificate.alarms} of "
                    f"{certificate.of} times")
    return sentences


def parts(budget: Sequence[BudgetLine]) -> str:
    """The gap budget in a sentence, largest part first."""
    sentences = [f"{one.part} {span(one)}" for one in sorted(budget, key=lambda b: -max(b.last, b.first))
            if max(one.last, one.first) >= LEAST]
    return "; ".join(sentences)


def span(one: BudgetLine) -> str:
    """Metres and share of the base's error, from added last to added first."""
    low, high = sorted((one.last, one.first))
    shares = sorted((100 * one.share_last, 100 * one.share_first))
    if high - low < LEAST:
        return f"{metres(high)} ({shares[1]:.0f} %)"
    return f"{metres(low)} to {metres(high)} ({shares[0]:.0f} to {shares[1]:.0f} %)"


def left(found: Discovery) -> str:
    """What remains, against the noise."""
    gap = found.gap.get("position_5s")
    if gap is None:
        return ""
    after = gap.augmented if found.model else gap.base
    text = f"{metres(after)} of the 5 s position error remain; noise alone leaves {metres(gap.floor)}"
    worst = f"; the worst run is {gap.worst_run} with {metres(gap.worst)}" if gap.worst_run else ""
    worse = gap.worse_runs
    compared = f"; made worse on {', '.join(worse)}" if worse else "; it became larger in no run"
    return f"{text}{worst}{compared if found.model else ''}"


def blind(found: Discovery) -> list[str]:
    """What these drives cannot show, and what they do."""
    sentences = [visible(found)] if visible(found) else []
    if found.not_testable:
        largest = {p.effect: p for p in sorted(found.certificate.powers, key=lambda p: abs(p.size))}
        ranked = sorted(found.not_testable, key=lambda n: rank(n.name))
        names = ", ".join(plain(n.name) + (f" of {change(largest[n.name].size, largest[n.name].unit)}"
                                           if n.name in largest else "") for n in ranked[:MOST_BLIND])
        more = len(found.not_testable) - MOST_BLIND
        sentences.append(f"cannot be seen: {names}{f' and {more} more, listed below' if more > 0 else ''}")
    return sentences


def visible(found: Discovery) -> str:
    """The smallest sizes these drives would show, vehicle parameters first."""
    best: dict[str, Power] = {}
    for power in sorted(found.certificate.powers, key=lambda p: abs(p.size)):
        if power.found >= SHOWN:
            best.setdefault(power.effect, power)
    ranked = sorted(best.values(), key=lambda p: rank(p.effect))
    sentences = [f"{plain(p.effect)} of {change(p.size, p.unit)}" for p in ranked[:MOST_BLIND]]
    return f"would show {', '.join(sentences)}{', …' if len(ranked) > MOST_BLIND else ''}" if sentences else ""


def rank(name: str) -> tuple[bool, int]:
    """Vehicle parameters first, then by part."""
    kind = EFFECTS[name].kind if name in EFFECTS else ""
    return kind != "vehicle parameters", PARTS.index(kind) if kind in PARTS else len(PARTS)


def following(found: Discovery) -> str:
    """The drive to do next, or nothing."""
    n = found.next_manoeuvre
    if n is None:
        return ""
    first, second = map(plain, n.separates)
    now = next((p.strength for p in found.separability if {p.first, p.second} == set(n.separates)), 0.0)
    return (f"{n.name}, {n.times} times {n.duration:.0f} s at {n.speed:.1f} m/s: would separate {first} and {second} "
            f"by {n.strength:.1f} standard deviations of the noise; these drives: {now:.1f}; {plain(n.reason)}")


def summary(found: Discovery, update: VehicleUpdate | None) -> list[str]:
    """The answer in three sentences: what was found, what to do first, what remains."""
    return [title(found), to_do(found, update)[0], left(found)]


def assumed(found: Discovery) -> list[str]:
    """Which quantities of the vehicle file bind, how firmly, and what contradicts them."""
    sentences = [f"{a.key} {a.value:.4g} ± {a.deviation:.2g} {a.unit.removesuffix('1')}".rstrip()
            + ("" if a.stated else " (default)") for a in found.assumed if not a.key.startswith("tyre_")]
    lines = [f"{', '.join(sentences)}; `uncertainty` in an entry of the file changes that"] if sentences else []
    refuted = {r.subject: r.text for r in found.reasons if r.rule == FILE}
    return [*lines, *(f"{plain(name)}: {text}" for name, text in refuted.items())]


def properties(found: Discovery) -> list[str]:
    """What is known of stiffness, mass, inertia and lengths together, where that differs from the vehicle file; and the
    force of each axle at the largest driven slip."""
    sentences = [f"{one.name} × {one.value / one.file:.3g} of the file's ({one.interval[0] / one.file:.3g} to "
            f"{one.interval[1] / one.file:.3g})" for one in found.combinations
            if one.file and not one.interval[0] <= one.file <= one.interval[1]]
    sentences += [f"{c.axle} axle force {force_ratio(c)}" for c in found.axle_curves
             if found.model and not c.low[-1] <= c.file[-1] <= c.high[-1]]
    return sentences


def force_ratio(curve: ForceCurve) -> str:
    """Force at the largest driven slip over the file's, with its 90 % band."""
    force, low, high = (values[-1] / curve.file[-1] for values in (curve.force, curve.low, curve.high))
    return f"× {force:.2f} ({low:.2f} to {high:.2f}) of the file's at {math.degrees(curve.slip[-1]):.1f}°"


def corrections(found: Discovery) -> list[str]:
    """What is in the model to predict and is no property of the car."""
    if not found.effective:
        return []
    gap, named = (one.get("position_5s") for one in (found.gap, found.gap_named))
    fall = f" ({metres(named.augmented)} → {metres(gap.augmented)} after 5 s)" if gap and named else ""
    sentences = ", ".join(f"{plain(e.name)} {short_values(e.parameters)}" for e in found.effective)
    return [f"{sentences}{fall}: helps to predict, is no property; in model.yaml, marked effective"]


def to_do(found: Discovery, update: VehicleUpdate | None) -> list[str]:
    """What the user may do with the answer."""
    sentences = []
    if update is not None and not update.text and update.error[1] > update.error[0]:
        sentences.append(f"vehicle.yaml is not written: by itself it would make the position error after 5 s "
                    f"{metres(update.error[0])} → {metres(update.error[1])} on held-out drives; use model.yaml")
    sentences += update.objections if update is not None else ()
    if update is not None and update.folded:
        same = ", ".join(f"{plain(e.name)} {short_values(e.parameters)}" for e in found.effects
                         if e.name in update.folded)
        sentences.append(f"use vehicle.yaml: {keys(update.changes)}, the same correction as {same}")
        sentences += [f"vehicle.yaml holds the first of {by_any_name(found, e)}; these drives do not tell them apart: "
                 "measure one of them on the car" for e in found.effects if e.name in update.folded and e.alternatives]
    for name, change_of in (update.kept if update is not None else {}).items():
        sentences.append(f"{plain(name)} is in model.yaml: these recordings contain the road wheel angle, or play "
                    "in the steering acts before it, and no entry of a vehicle file corrects that; for recordings of "
                    f"the steering wheel, set {keys(change_of)}")
    rest = [e for e in found.effects if update is None or e.name not in update.folded]
    sensors = [plain(e.name) for e in rest if e.kind == "sensors"]
    if sensors:
        sentences.append(f"{', '.join(sensors)}: model.yaml corrects for it; when the sensors are repaired, or the "
                    "recordings corrected in run.yaml, run st discover again: this model would correct twice")
    others = [plain(e.name) for e in rest if e.kind != "sensors" and (update is None or e.name not in update.kept)]
    if others:
        sentences.append(f"predict with model.yaml, which adds {', '.join(others)}")
    if found.signature and found.effects:
        sentences.append("more is missing than is named, and a name may be a part of it: compare the values with what "
                         "you know of the car")
    if found.outcome == "unknown" or found.signature:
        sentences.append("see where and when the model fails; you can add your own effect (docs/manual/effects.md)")
    shows = list(dict.fromkeys(n.manoeuvre for n in found.not_testable if n.manoeuvre))
    if found.outcome == "not_testable":
        sentences.append(f"drive more{': ' + ', '.join(shows) if shows else ''}, and add it to the runs")
    if found.outcome == "ambiguous" and found.next_manoeuvre is not None:
        sentences.append("do the next drive and add it to the runs")
    if found.minor and found.effects:
        kept = ", ".join(by_any_name(found, e) for e in found.minor)
        sentences.append(f"model.yaml also contains {kept}: part of the fit, but too small compared with what remains; "
                    "do not take it for a property of the car")
    return sentences or ["nothing"]


def keys(changes_of: Mapping[str, Sequence[float]]) -> str:
    """Keys of a vehicle file before and after; SI, with the unit where there is one: the file may use another."""
    return ", ".join(f"{key} {before:.5g} → {after:.5g} {_unit(key)}".rstrip()
                     for key, (before, after, *_) in changes_of.items())


def _unit(key: str) -> str:
    quantity = VEHICLE_QUANTITIES.get(key)
    return quantity.si_unit.removesuffix("1") if quantity else ""


def verdict(found: Discovery, update: VehicleUpdate | None) -> list[tuple[str, list[str]]]:
    """(question, lines of the answer) of what is told first; empty answers are left out."""
    lines = [*((role, [text]) for role, text in drives(found)), ("what", what(found)), ("how sure", sure(found)),
             ("what to do", to_do(found, update)), ("properties", properties(found)),
             ("effective corrections", corrections(found)), ("taken from the vehicle file", assumed(found)),
             ("not named", list(map(tied, found.bound))),
             ("parts of the error", [parts(found.budget)]), ("what remains", [left(found)]),
             ("the base fails most", misses(found)), ("these drives", blind(found)),
             ("next drive", [following(found)])]
    collected = [(question, [text for text in answer if text]) for question, answer in lines]
    return [(question, answer) for question, answer in collected if answer]


def misses(found: Discovery) -> list[str]:
    """Where the base model is surely worst, before anything was found."""
    return [statement(w) for w in sorted(found.where, key=lambda w: -w.interval[0])[:MOST_WORST]]


def statement(w: WhereStatement) -> str:
    return f"{channel(w.channel)} {condition(w)}"


def condition(w: WhereStatement) -> str:
    """A statement without its channel."""
    before = {"everywhere": "", "within": "", "speed": "at ", "lateral": "at ", "steering": "at ", "forward": "at "}
    where = before.get(w.condition.split()[0], "in ") + w.condition.replace("^2", "²")
    low, high = w.interval
    if w.excess > MOST_TIMES:
        return f"{where}: more than {MOST_TIMES:g} times the expected error"
    return f"{where}: {w.excess:.1f} times the expected error ({low:.1f} to {min(high, MOST_TIMES):.1f})"


def significantly_changed(gap: Mapping[str, Gap]) -> list[str]:
    """Names of what changed for sure, the largest relative change first."""
    certain = [n for n in WORDS if n in gap and (gap[n].interval[0] > 0.0 or gap[n].interval[1] < 0.0)]
    return sorted(certain, key=lambda n: -abs(gap[n].augmented / gap[n].base - 1.0))


def before_and_after(one: Gap) -> str:
    ratio = 100.0 * (one.augmented / one.base - 1.0)
    return f"{size(one.base, one.unit)} to {size(one.augmented, one.unit)} ({ratio:+.0f} %)"


def worst_channel(found: Discovery, channels: Sequence[str]) -> str:
    """The channel the figures look at: where the gap is largest for sure."""
    known = [w for w in found.where if w.channel in channels]
    if known:
        return max(known, key=lambda w: w.interval[0]).channel
    return channels[0]
