"""`st import`: raw logs into one bag on one clock."""

from pathlib import Path

import typer

from . import _options as shared


@shared.reads_recordings()
def import_(
    paths: list[Path] = typer.Argument(..., help="Runs: .ncom with CAN logs, folders of them, run.yaml."),
    output: Path | None = typer.Option(
        None, help="Bag directory; with several runs, the folder of their bags. Default runs/import-<name>-<time>."
    ),
    search: tuple[float, float] | None = typer.Option(None, help="Bounds of the offset in seconds."),
    force: bool = typer.Option(False, "--force", help="Write also runs in which `st check` finds an error."),
    strict: bool = typer.Option(False, "--strict", help="Refuse runs with a doubtful alignment."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> None:
    """Write INS recording and CAN logs as one rosbag2 MCAP: aligned, in one time base, raw packets and frames kept.

    `ros2 bag play` of it drives the live nodes, and every st verb reads it. Exit status 0: all runs written; 1: some
    were not (each with its reason); 2: nothing could be done.
    """
    from rich.console import Console
    from st_recordings.paths import OutputError, new_folder
    from st_recordings.runs.errors import RunError
    from st_recordings.runs.sources import find_runs

    console = Console()
    with shared.refusals("import"):
        vehicle, settings = read_options.resolve(search=search, doubtful=not strict)
        parameters, file = shared.load_vehicle_or_default(vehicle)
    found = [run for run in find_runs(paths) if run.kind == "ncom" or run.problem is not None]
    if not found:
        typer.echo(f"st import: {', '.join(map(str, paths))}: no raw logs (.ncom with CAN logs) are in there", err=True)
        raise typer.Exit(2)
    written = 0
    for run in found:
        try:
            given = output / run.name if output and len(found) > 1 else output
            folder = new_folder(given, f"import-{run.name}", create=False)
            _import_one(run, parameters, folder, settings, force, console)
            written += 1
        except (RunError, OutputError) as error:
            typer.echo(f"st import: {error}", err=True)
    if vehicle is None:
        shared.report_default_car("import", file)
    if written < len(found):
        raise typer.Exit(1 if written else 2)


def _import_one(source, parameters, folder: Path, settings, force: bool, console) -> None:
    import time

    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from st_offline.alignment_figure import alignment_figure
    from st_offline.checking.check_report import print_findings
    from st_offline.checking.gate import checked_run
    from st_recordings.runs.write import import_run

    from .align import VERDICT_STYLE, sentence

    began = time.perf_counter()
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console,
                  transient=True) as progress:
        task = progress.add_task(f"{source.name}: reading and aligning", total=None)
        done = import_run(source, parameters, folder, settings, checked_run(source.where, parameters, force),
                          lambda share: progress.update(task, description=f"{source.name}: writing", total=1.0,
                                                        completed=share))
    seconds = time.perf_counter() - began
    for warning in done.warnings:
        console.print(f"[yellow]{warning}[/yellow]", highlight=False, soft_wrap=True)
    print_findings({source.name: done.findings}, console)
    alignment = done.run.alignment
    text = sentence(alignment, done.run.can.start_ns, absolute=True)
    if done.run.shared:
        alignment_figure(done.run.shared, alignment, f"{source.name}: {text}", folder / "alignment.png")
    style = VERDICT_STYLE[alignment.verdict]
    console.print(f"[bold]{source.name}[/bold]  [{style}]{text}[/{style}]", highlight=False, soft_wrap=True)
    console.print("  " + ", ".join(f"{topic} {count}" for topic, count in done.counts.items()), highlight=False,
                  soft_wrap=True)
    console.print(f"  {folder}  [dim]{done.span:.0f} s of driving in {seconds:.1f} s, {done.span / seconds:.0f} times "
                  "real time[/dim]", highlight=False, soft_wrap=True)
