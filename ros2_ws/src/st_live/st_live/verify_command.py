"""What `st verify` does and shows."""

from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text
from st_core.palette import MODEL_COLOUR
from st_recordings.output import new_folder

from .suite import SuiteError
from .verification import MODES, Verification, recordings_of, replay_bag, verify


def verify_command(bag: Path, vehicle: Path | None, tolerance: float, again: bool, output: Path | None,
                   console: Console) -> int:
    """Exit status: 0 when nothing differs by more than `tolerance` [m] and every score exists on both sides."""
    found = None if again else _verified(bag, vehicle, console)
    if found is None:
        why = "as asked" if again else "it holds no predictions"
        folder = new_folder(output, f"verify-{bag.stem}")
        console.print(f"{bag.name} is played through the nodes ({why}); recordings in {folder}", highlight=False)
        outcome, _ = replay_bag(recordings_of(bag)[0], folder, vehicle, 0.0, console)
        if not outcome.ok:
            failed = f"a node ended with an error: {outcome.statuses}; see {folder / 'logs'}"
            raise SuiteError(outcome.problem or failed)
        found = _verified(folder, vehicle, console)
    if found is None or not found.n_starts:
        settling = sum(c.n_settling for c in found.comparisons) if found else 0
        why = (f"all {settling} predictions start too soon after the first sample heard" if settling
               else "no prediction was made from this recording")
        console.print(f"nothing to compare: {why}")
        return 2
    console.print(_table(found))
    for warning in found.warnings:
        console.print(f"[yellow]{warning}[/yellow]", highlight=False, soft_wrap=True)
    if not found.same_configuration:
        console.print("[yellow]the predictions carry the hash of another vehicle or other settings[/yellow]")
    return _conclusion(found, tolerance, console)


def _verified(path: Path, vehicle: Path | None, console: Console) -> Verification | None:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        bar = progress.add_task("reading and comparing")
        return verify(path, vehicle, lambda done, total: progress.update(bar, completed=done, total=total))


def _table(found: Verification) -> Table:
    """Fits into 80 columns with an hour's numbers."""
    table = Table(title=f"Live against library ({found.vehicle}): largest differences", title_justify="left",
                  title_style="bold", box=None, collapse_padding=True, pad_edge=False)
    table.add_column("model")
    for heading in ("starts", "start\nstate\nmm", "path\nmm", "hindsight\nscores\nnumber, mm",
                    "forecast\nscores\nnumber, mm", "only on\none side"):
        table.add_column(heading, justify="right", no_wrap=True)
    for c in found.comparisons:
        scores = [f"{c.n_scores[mode]}, {c.error[mode] * 1000:.2g}" for mode in MODES]
        table.add_row(Text(c.model, style=MODEL_COLOUR.get(c.model, "")), str(c.n_starts), f"{c.start * 1000:.2g}",
                      f"{c.position * 1000:.2g}", *scores, str(c.n_disagree))
    return table


def _conclusion(found: Verification, tolerance: float, console: Console) -> int:
    scores = sum(sum(c.n_scores.values()) for c in found.comparisons)
    disagree, cut = (sum(getattr(c, name) for c in found.comparisons) for name in ("n_disagree", "n_cut"))
    passed = found.largest <= tolerance and not disagree
    verdict = "[green]live equals offline[/green]" if passed else "[red]live differs from offline[/red]"
    worst = max(found.comparisons, key=lambda c: c.position)
    where = ""
    if worst.at_ns and not passed:
        time = f"{datetime.fromtimestamp(worst.at_ns * 1e-9, UTC):%H:%M:%S.%f}"[:-3]
        where = f"; the path of {worst.model} most at {time} UTC"
    console.print(f"{verdict}: {found.n_starts} predictions and {scores} scores compared, largest difference "
                  f"{found.largest * 1000:.3g} mm (limit {tolerance * 1000:g} mm), {disagree} scores complete on one "
                  f"side only; {cut} more the nodes were ended before{where}", highlight=False, soft_wrap=True)
    settling = sum(c.n_settling for c in found.comparisons)
    console.print(f"[dim]{settling} predictions not compared: they start while the filter of the forward acceleration "
                  f"still depends on which sample each node heard first[/dim]", highlight=False, soft_wrap=True)
    return 0 if passed else 1
