"""Summary of a discovery on the terminal: the answer, its values, what to do. The page has the rest."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from st_core.discovery import Discovery

from ..checking.check_document import findings_in
from ..terminal import list_files, report_problem
from . import quantities, report_text
from .drives import Drive
from .relation_report import RelationReport
from .vehicle_update import VehicleUpdate

WHAT = {"report.html": "one page, with all figures", "discovery.json": "every number, docs/manual/discovery.md",
        "vehicle.yaml": "the vehicle file, corrected: --vehicle of every command",
        "effects": "the relation proposed, as an effect; its folder: --effects of st evaluate, st demo, st live",
        "proposed.yaml": "a model with it: --model, together with --effects and the vehicle file as it was given",
        "model.yaml": "corrections with no entry in a vehicle file: --model of st demo, st live, st evaluate"}
MAX_ADVICE = 3  # sentences; the page has all
MAX_NAMES = 4  # of effects that these drives cannot show


def show(found: Discovery, update: VehicleUpdate | None, recordings: Sequence[Drive], files: Mapping[str, Path],
         earlier: bool, console: Console, law: RelationReport | None = None) -> None:
    """Print the answer, the values of its effects, what to do, and the files.

    recordings: all runs, with those that could not be used. earlier: the answer is from the cache. law: the search for
    a relation beyond the library.
    """
    for role, text in report_text.drives(found):
        _print(role, text, console)
    console.print(f"[bold]{escape(report_text.title(found))}[/bold]", highlight=False)
    if law is not None and law.headline:
        console.print(f"[bold]{escape(law.headline)}[/bold]", highlight=False)
    if found.effects:
        console.print(values_table(found))
    for question, text in (("residual", report_text.left(found)), ("not separable", not_separable(found)),
                           ("not visible in these drives", not_visible(found)),
                           *(("what to do", advice) for advice in report_text.to_do(found, update)[:MAX_ADVICE]),
                           ("next drive", report_text.following(found)), ("recordings", findings(recordings)),
                           *(("warning", text) for text in found.warnings)):
        if text:
            _print(question, text, console)
    for what, command in law.commands if law is not None else ():  # not wrapped: they are copied
        console.print(f"[bold]{escape(what)}[/bold]: {escape(command)}", soft_wrap=True, highlight=False)
    for drive in recordings:
        if drive.problem:
            report_problem(drive.name, drive.problem, console)
    if earlier:
        console.print("[dim]Cached answer to the same inputs; --fresh repeats the search.[/dim]")
    list_files({file: WHAT[name] for name, file in files.items()}, console)


def _print(question: str, text: str, console: Console) -> None:
    console.print(f"[bold]{question}[/bold]: {escape(text)}", highlight=False)


def values_table(found: Discovery) -> Table:
    """Value and 95 % interval of every parameter of the effects, and by how much each effect reduces the error."""
    table = Table("effect", "value (95 % interval)", "5 s error reduced by", box=None, padding=(0, 1))
    table.columns[2].justify = "right"
    for effect in found.effects:
        name, reduced = quantities.plain(effect.name), report_text.share_of(effect.name, found.steps)
        for parameter, fitted in effect.parameters.items():
            prefix = f"{quantities.plain(parameter)} " if len(effect.parameters) > 1 else ""
            table.add_row(escape(name), escape(prefix + quantities.value(fitted)), escape(reduced))
            name = reduced = ""
    return table


def not_separable(found: Discovery) -> str:
    """Effects that explain the drives equally well, or that only act as a pair; empty without any."""
    plain = quantities.plain
    return "; ".join([*(" or ".join(map(plain, (e.name, *e.alternatives))) for e in found.effects if e.alternatives),
                      *(f"{plain(e.name)} with {', '.join(map(plain, e.joint))} (they cancel)"
                        for e in found.effects if e.joint)])


def not_visible(found: Discovery) -> str:
    """The first effects that these drives cannot show, vehicle parameters first, and the number of the others."""
    ranked = sorted(found.not_testable, key=lambda n: report_text.rank(n.name))
    more = len(ranked) - MAX_NAMES
    names = ", ".join(quantities.plain(n.name) for n in ranked[:MAX_NAMES])
    return f"{names} and {more} more" if more > 0 else names


def findings(recordings: Sequence[Drive]) -> str:
    """Number of findings by severity in the recordings; empty without any."""
    count = Counter(one.severity.value for drive in recordings for one in findings_in(drive.about))
    numbers = ", ".join(f"{number} {severity}{'s' if number > 1 else ''}" for severity, number in count.items())
    return f"{numbers}; listed in the report and by st check" if numbers else ""
