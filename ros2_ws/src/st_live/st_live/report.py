"""The end of a run: summary.json, paths.png, the table in the terminal, and the exit status."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from st_recordings.counted import lines
from st_recordings.results import read_results, summarise, write_summary
from st_recordings.runs.errors import RunError

from .figures import paths_figure
from .session import Outcome
from .tables import error_table, finding


def conclude(folder: Path, outcome: Outcome, about: dict[str, Any], console: Console) -> int:
    """Write and show what the run found.

    Returns 0 when every process ended well and something was scored or the run was ended by hand, 130 when it was ended
    before anything flowed, else 1.
    """
    if outcome.interrupted and not outcome.statuses:
        console.print("ended before anything was sent or recorded")
        return 130
    _say_what_went_wrong(folder, outcome, console)
    with console.status("reading the recordings, drawing"):
        try:
            results = read_results(folder)
        except RunError as error:
            console.print(f"[red]{escape(str(error))}[/red]", highlight=False, soft_wrap=True)
            return 1
        summary = summarise(results, {**about, "exit_statuses": outcome.statuses})
        write_summary(folder / "summary.json", summary)
        paths_figure(results, f"{about['what']}: {finding(summary)}", folder / "paths.png")
    console.print(error_table(summary, f"{about['what']}: error over each 5 s horizon, at the INS point"))
    for line in lines(results.bands):
        console.print(line, highlight=False, soft_wrap=True)
    ticks = summary["ticks"]
    console.print(f"ticks {ticks['due']}, predicted {ticks['predicted']}, skipped {ticks['skipped']}")
    for name, what in (
        ("bag", "what was sent and measured"),
        ("errors", "every score"),
        ("summary.json", "this table"),
        ("paths.png", "the picture"),
    ):
        console.print(f"  {escape(str(folder / name))}  [dim]{what}[/dim]", highlight=False, soft_wrap=True)
    scored = any(modes["hindsight"]["n_starts"] for modes in summary["models"].values())
    if not scored:
        console.print("[yellow]nothing was scored: shorter than a horizon, or an input was missing[/yellow]")
        console.print(escape(outcome.health.rstrip()), highlight=False, soft_wrap=not console.is_terminal)
    return 0 if outcome.ok and (scored or outcome.interrupted) else 1


def _say_what_went_wrong(folder: Path, outcome: Outcome, console: Console) -> None:
    if outcome.problem:
        console.print(f"[red]{escape(outcome.problem)}[/red]", highlight=False, soft_wrap=True)
    for name, times in outcome.restarts.items():
        console.print(
            f"[yellow]{name} was started again, {times} times; its recordings go on beside the first one (bag_2, "
            "errors_2), and `st recover` mends what was cut off[/yellow]", soft_wrap=True
        )
    failed = {name: status for name, status in outcome.statuses.items() if status}
    if failed:
        console.print(
            "[red]ended with an error: "
            + ", ".join(f"{n} (status {s})" for n, s in failed.items())
            + f"; see {escape(str(folder / 'logs'))}[/red]",
            highlight=False,
            soft_wrap=True,
        )
