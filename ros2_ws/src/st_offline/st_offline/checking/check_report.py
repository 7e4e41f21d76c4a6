"""What a check found, on the terminal."""

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from st_core.checks import Checked, Finding, Severity, across_runs

from ..terminal import line, report_problem
from . import check_wording as words
from .check_document import CheckedRun, FailedRun

STYLE = {Severity.ERROR: "red", Severity.WARNING: "yellow", Severity.NOTE: "dim"}


def show(run: CheckedRun | FailedRun, console: Console) -> None:
    """The verdict in a line, then what was found."""
    if isinstance(run, FailedRun):
        report_problem(run.name, run.problem, console)
        return
    line(f"[bold]{escape(run.name)}[/bold]: [{_colour(run.checked)}]{escape(words.verdict(run.checked))}[/]  "
         f"[dim]{run.duration:.0f} s, {escape(run.vehicle.name)} from {escape(run.vehicle_from)}[/dim]", console)
    for finding in run.checked.findings:
        _show_finding(finding, console)


def _colour(checked: Checked) -> str:
    gravest = min((words.GRAVITY.index(one.severity) for one in checked.findings), default=None)
    return "green" if gravest is None or words.GRAVITY[gravest] is Severity.NOTE else STYLE[words.GRAVITY[gravest]]


def _show_finding(finding: Finding, console: Console) -> None:
    line(f"  [{STYLE[finding.severity]}]{finding.severity.value}[/] [bold]{escape(finding.name)}[/bold]: "
         f"{escape(finding.text)}", console)
    about = [words.where(finding), words.effect(finding)]
    line(f"    [dim]{escape('; '.join(filter(None, about)))}[/dim]", console)
    if finding.advice:
        place = words.PLACE[finding.advice.kind]
        line(f"    {f'correction, {place}' if place else 'advice: '}{escape(finding.advice.line)}", console)


def show_together(runs: Sequence[Checked], console: Console) -> None:
    """Quantities measured in several runs, and whether they are consistent."""
    found = across_runs(runs)
    if found:
        console.print("[bold]all runs together[/bold]", highlight=False)
    for one in found:
        line(f"  {escape(one.text)}", console)


def print_findings(name: str, findings: Sequence[Finding], console: Console) -> None:
    """Prints the findings of a run, one line each, for verbs other than `st check`."""
    for finding in findings:
        line(f"[{STYLE[finding.severity]}]{escape(name)}: {escape(words.line(finding))}[/]", console)
