"""What a discovery says, in sentences: the same in the terminal and on the page."""

from collections.abc import Mapping, Sequence

from st_core.discovery import Discovery, DiscoverySettings, FittedParameter, FoundEffect, Gap, WhereStatement
from st_core.effects import EFFECTS

CHANNEL = {"velocity_y": "lateral velocity", "yaw_rate": "yaw rate", "acceleration_y": "lateral acceleration",
           "yaw": "heading", "position": "position", "position_5s": "position after 5 s"}
MOST_BLIND = 6
MOST_CHANGES = 3  # told in a sentence; all are in the table
RANKED = ("position_5s", "velocity_y", "yaw_rate", "acceleration_y", "yaw", "position")
_DISPLAY = {"rad": ("°", 57.29577951308232), "rad/s": ("°/s", 57.29577951308232)}


def factor(unit: str) -> float:
    """From SI to what is shown."""
    return _DISPLAY.get(unit, ("", 1.0))[1]


def shown_unit(unit: str) -> str:
    return _DISPLAY.get(unit, (unit.replace("^2", "²"), 1.0))[0]


def channel(name: str) -> str:
    return CHANNEL.get(name, name.replace("_", " "))


def plain(name: str) -> str:
    """An effect's name as words."""
    return name.replace("_", " ")


def size(value: float, unit: str) -> str:
    """A number of a channel as a reader wants it: angles in degrees."""
    number = value * factor(unit)
    space = "" if shown_unit(unit).startswith("°") else " "
    return f"{number:.3g}{space}{shown_unit(unit)}"


def value(p: FittedParameter) -> str:
    unit = "" if p.unit == "1" else f" {p.unit.replace('^2', '²')}"
    return f"{p.value:.3g} ({p.interval[0]:.3g} to {p.interval[1]:.3g}){unit}"


def values(effect: FoundEffect) -> str:
    return ", ".join(f"{plain(name)} {value(p)}" for name, p in effect.parameters.items())


def title(found: Discovery) -> str:
    """The verdict in a line."""
    names = [plain(e.name) for e in found.effects]
    if found.outcome == "none" and found.p < DiscoverySettings().false_alarm:
        return "No missing effect is stated: hardly more than healthy drives show"
    if found.outcome == "none":
        return "No missing effect: nothing beyond what is to be expected"
    if found.outcome == "not_testable":
        return "These drives cannot show what may be missing"
    if found.outcome == "unknown":
        return "Something is missing that no known effect explains"
    if found.outcome == "several":
        return f"{len(names)} effects are missing: {', '.join(names[:-1])} and {names[-1]}"
    if found.outcome == "ambiguous":
        every = [names[0], *(plain(a) for a in found.effects[0].alternatives)]
        more = " or …" if len(every) > 3 else ""
        return f"One effect is missing, {' or '.join(every[:3])}{more}: these drives cannot tell"
    return f"Missing: {names[0]}"


def where(found: Discovery) -> str:
    """The most telling statement of up to two channels."""
    # Conditions say most; then times, places, and that it is everywhere.
    kinds = {"run": 1, "within": 2, "everywhere": 3}
    shown: dict[str, WhereStatement] = {}
    for one in sorted(found.where, key=lambda w: (kinds.get(w.condition.split()[0], 0), -w.interval[0])):
        shown.setdefault(one.channel, one)
    if not shown:
        return "Nowhere does the model miss more than is to be expected."
    return "; ".join(statement(w) for w in list(shown.values())[:2]) + "."


def statement(w: WhereStatement) -> str:
    return f"{channel(w.channel)} {condition(w)}"


def condition(w: WhereStatement) -> str:
    """A statement without its channel."""
    before = {"everywhere": "", "within": "", "speed": "at ", "lateral": "at ", "steering": "at ", "forward": "at "}
    where = before.get(w.condition.split()[0], "in ") + w.condition
    low, high = w.interval
    return f"{where}: {w.excess:.1f} times the expected error ({low:.1f} to {high:.1f})"


def what(found: Discovery) -> str:
    if found.outcome == "unknown":
        return "Not in the library. " + " ".join(found.signature)
    if not found.effects:
        return "No effect is added to the model."
    parts = []
    for effect in found.effects:
        physics = EFFECTS[effect.name].physics if effect.name in EFFECTS else ""
        parts.append(f"{plain(effect.name)}, {values(effect)}" + (f"; {physics}" if physics else ""))
    return ". ".join(parts) + "."


def changed(gap: Mapping[str, Gap]) -> str:
    """Held-out errors before and after: the largest changes, what did not surely change, what became worse."""
    if not gap:
        return "No held-out drive to judge it on."
    certain = surely_changed(gap)
    if not certain:
        text = "On held-out driving no error surely changed."
    else:
        told = ", ".join(f"{channel(n)} error {before_and_after(gap[n])}" for n in certain[:MOST_CHANGES])
        text = f"On held-out driving: {told}."
        same = [channel(n) for n in RANKED if n in gap and n not in certain]
        text += f" Not surely changed: {', '.join(same)}." if same else ""
    worse = sorted({run for one in gap.values() for run in one.worse_runs})
    return text + (f" Made worse on: {', '.join(worse)}." if worse else "")


def surely_changed(gap: Mapping[str, Gap]) -> list[str]:
    """Names of what changed for sure, the largest relative change first."""
    certain = [n for n in RANKED if n in gap and (gap[n].interval[0] > 0.0 or gap[n].interval[1] < 0.0)]
    return sorted(certain, key=lambda n: -abs(gap[n].augmented / gap[n].base - 1.0))


def before_and_after(one: Gap) -> str:
    change = 100.0 * (one.augmented / one.base - 1.0)
    return f"{size(one.base, one.unit)} to {size(one.augmented, one.unit)} ({change:+.0f} %)"


def sure(found: Discovery) -> str:
    """How far the answer may be believed."""
    chance = ("Healthy drives would show as much with probability" if found.effects else
              "Probability that an effect gains as much on healthy drives:") + f" {_probability(found.p)}."
    parts = [chance]
    for effect in found.effects:
        others = ", ".join(plain(a) for a in effect.alternatives)
        parts.append(f"{plain(effect.name)} has {100 * effect.probability:.0f} % against {others}." if others else
                     f"No other effect of the library explains as well what {plain(effect.name)} does.")
    if found.not_testable:
        parts.append("Effects these drives cannot show: "
                     f"{', '.join(plain(n.name) for n in found.not_testable[:MOST_BLIND])}"
                     f"{', …' if len(found.not_testable) > MOST_BLIND else ''}.")
    return " ".join(parts)


def following(found: Discovery) -> str:
    """The drive to do next, or nothing."""
    n = found.next_manoeuvre
    if n is None:
        return ""
    strength = f"{n.strength:.1f} standard deviations apart"
    return (f"{n.name}, {n.times} times {n.duration:.0f} s at {n.speed:.1f} m/s: puts {plain(n.separates[0])} and "
            f"{plain(n.separates[1])} {strength}. {n.reason}")


def verdict(found: Discovery) -> list[tuple[str, str]]:
    """(question, answer) of the first lines."""
    lines = [("where", where(found)), ("what", what(found))]
    if found.effects:
        lines.append(("what changes", changed(found.gap)))
    lines.append(("how sure", sure(found)))
    if following(found):
        lines.append(("next drive", following(found)))
    return lines


def _probability(p: float) -> str:
    return "below 0.001" if p < 0.001 else f"{p:.2g}"


def worst_channel(found: Discovery, channels: Sequence[str]) -> str:
    """The channel the figures look at: where the gap is largest for sure."""
    known = [w for w in found.where if w.channel in channels]
    if known:
        return max(known, key=lambda w: w.interval[0]).channel
    return next((c for c in ("yaw_rate", "velocity_y") if c in channels), channels[0])
