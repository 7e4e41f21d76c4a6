"""The answer of a discovery on the terminal."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from st_core.discovery import Discovery

from ..terminal import list_files, report_problem
from . import quantities, report_text
from .drives import Drive
from .relation_report import RelationReport
from .vehicle_update import VehicleUpdate

WHAT = {"report.html": "one page, with all figures", "discovery.json": "every number, docs/manual/discovery.md",
        "vehicle.yaml": "the vehicle file, corrected: --vehicle of every command",
        "effects": "the relation proposed, as an effect; its folder: --effects of st evaluate, st demo, st live",
        "proposed.yaml": "a model with it: --model, together with --effects and the vehicle file as it was given",
        "model.yaml": "what a vehicle file cannot hold: --model of st demo, st live, st evaluate"}


def show(found: Discovery, update: VehicleUpdate | None, failed: Sequence[Drive], files: Mapping[str, Path],
         earlier: bool, console: Console, law: RelationReport | None = None) -> None:
    """Runs, answer, waterfall, budget. earlier: whether the answer is that of an earlier start. law: what is proposed
    beyond the library."""
    lines = report_text.verdict(found, update)
    _answers(lines[:2], console)
    console.print(f"[bold]{escape(report_text.title(found))}[/bold]", highlight=False)
    if law is not None and law.headline:
        console.print(f"[bold]{escape(law.headline)}[/bold]", highlight=False)
    for table in filter(None, (waterfall(found), budget(found))):
        console.print(table)
    _answers(lines[2:], console)
    if law is not None:
        _law(law, console)
    for warning in found.warnings:
        console.print(f"[yellow]{escape(warning)}[/yellow]", highlight=False)
    for drive in failed:
        report_problem(drive.name, drive.problem, console)
    if earlier:
        console.print("[dim]The answer of an earlier call with the same inputs; --fresh searches anew.[/dim]")
    list_files({file: WHAT[name] for name, file in files.items()}, console)


def _law(law: RelationReport, console: Console) -> None:
    console.print("[bold]Beyond the effects of the library[/bold]")
    _answers(law.groups, console)
    for shown in law.tables:
        table = Table(*map(escape, shown.head), title=escape(shown.title), title_justify="left", box=None,
                      padding=(0, 1))
        for column in table.columns[1:]:
            column.justify = "right"
        for row in shown.rows:
            table.add_row(*map(escape, row))
        console.print(table)
    for what, command in law.commands:  # not wrapped: they are copied
        console.print(f"[bold]{escape(what)}[/bold]: {escape(command)}", soft_wrap=True, highlight=False)


def _answers(lines: Sequence[tuple[str, Sequence[str]]], console: Console) -> None:
    for question, answer in lines:
        if len(answer) == 1:
            console.print(f"[bold]{question}[/bold]: {escape(answer[0])}", highlight=False)
        else:
            console.print(f"[bold]{question}[/bold]", highlight=False)
            console.print(*(f"  {escape(text)}" for text in answer), sep="\n", highlight=False)


def waterfall(found: Discovery) -> Table | None:
    """The steps from base to model; None without any."""
    if not found.steps:
        return None
    table = Table("step", "value then", "after 5 s, m", "less, m", "95 %", box=None, padding=(0, 1))
    for column in table.columns[2:]:
        column.justify = "right"
    table.add_row("start", found.start, f"{found.steps[0].position_5s.base:.3f}", "", "")
    for step in found.steps:
        change = step.position_5s
        low, high = change.interval
        table.add_row(escape(report_text.step_name(step)), escape(quantities.short_values(step.parameters)),
                      f"{change.augmented:.3f}", f"{change.base - change.augmented:.3f}", f"{low:.3f} to {high:.3f}")
    return table


def budget(found: Discovery) -> Table | None:
    """The parts of the gap; None without any."""
    if not found.budget:
        return None
    table = Table("part of the error", "added last", "added first", "of the loss", box=None, padding=(0, 1))
    for column in table.columns[1:]:
        column.justify = "right"
    for one in found.budget:
        loss = sorted((100 * one.loss_last, 100 * one.loss_first))
        table.add_row(one.part, f"{one.last:.2f} m, {100 * one.share_last:.0f} %",
                      f"{one.first:.2f} m, {100 * one.share_first:.0f} %", f"{loss[0]:.0f} to {loss[1]:.0f} %")
    return table
