"""What to drive for a proposed law, in sentences."""

from collections.abc import Sequence

from st_core.discovery.following import TIMES
from st_core.proposals import Proposal
from st_core.proposals.next_drive import OF_A_PLACE, Option
from st_core.proposals.places import QUANTITIES

from . import law_words, report_text
from .law_figure import shown

ELSEWHERE = ("drive the same again, once beginning elsewhere on the course and once in the other direction, and add "
             "these runs: only then can the place, the course and the time in the run be told apart")
SECONDS = 0.5  # of a drive: a thin range in which less is spent is not reached


def ranges(one: Proposal, of: Sequence[tuple[float, float]]) -> str:
    across, unit = shown(QUANTITIES[one.candidate.quantity])
    return ", ".join(f"{across * low:.2g} to {across * high:.2g} {unit}" for low, high in of)


def sentences(one: Proposal) -> list[str]:
    """What to drive: to tell the law from others, to make its curve surer, to fill what is thin."""
    c, drives = one.candidate, one.drives
    if c.quantity in OF_A_PLACE:
        return [ELSEWHERE]
    lines: list[str] = []
    apart = drives.tells_apart()
    if apart is not None:
        option, rival = apart
        lines.append(f"to tell it from {law_words.named(rival)}: {_driven(option, lines)}. The two then differ "
                     f"{option.apart[rival] / max(drives.now[rival], 1e-9):.1f} times as clearly")
    elif drives.now:
        lines.append("no manoeuvre of the catalogue tells it much better from the laws it may be instead: look for the "
                     "cause on the car")
    if len(drives.now) < len(one.others):
        lines.append(f"to tell it from what depends on place, course or time: {ELSEWHERE}")
    surest = drives.pins_down(one.deviation)
    if surest is not None:
        up, unit = shown(c.unit)
        lines.append(f"for a surer curve: {_driven(surest, lines)}. The largest 95 % "
                     f"interval then falls from ± {up * report_text.SURE * one.deviation.max():.2g} to ± "
                     f"{up * report_text.SURE * surest.deviation.max():.2g} {unit}")
    return [*lines, *_thin(one, lines)]


def named(one: Proposal) -> list[str]:
    """Manoeuvres that are suggested."""
    drives, apart = one.drives, one.drives.tells_apart()
    chosen = [apart[0] if apart else None, drives.pins_down(one.deviation),
              *(_through(one, k) for k in range(len(drives.thin)))]
    return list(dict.fromkeys(option.manoeuvre.name for option in chosen if option))


def _through(one: Proposal, k: int) -> Option | None:
    """What stays longest in a thin range, None where nothing stays there."""
    best = max(one.drives.options, key=lambda o: o.seconds[k], default=None)
    return best if best is not None and best.seconds[k] >= SECONDS else None


def _thin(one: Proposal, before: Sequence[str]) -> list[str]:
    """Which manoeuvre spends most time in each range that was hardly driven. before: lines that are said already."""
    lines: list[str] = []
    drives, missed = one.drives, []
    for k, between in enumerate(drives.thin):
        best = _through(one, k)
        if best is None:
            missed.append(between)
            continue
        lines.append(f"for {ranges(one, [between])}: {_driven(best, (*before, *lines))}; {best.seconds[k]:.1f} s of "
                     "each drive are in that range")
    if missed:
        lines.append(f"no manoeuvre of the catalogue stays at {ranges(one, missed)} of the "
                     f"{law_words.quantity(one.candidate)}: drive some seconds there by hand, turning to both sides")
    return lines


def _driven(option: Option, before: Sequence[str]) -> str:
    """A manoeuvre, described where it is not yet."""
    m = option.manoeuvre
    whole = f"{m.name}, {TIMES} times {m.duration:.0f} s ({m.meaning.replace('^2', '²')}, from {m.speed:.1f} m/s)"
    return m.name if any(whole in line for line in before) else whole
