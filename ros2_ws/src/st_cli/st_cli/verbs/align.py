"""`st align`: the clock of a CAN log against that of the INS recording."""

import json
from pathlib import Path

import typer

from ._options import ReadOptions, reads_recordings, refusals, report_default_car

VERDICT_STYLE = {"good": "green", "doubtful": "yellow", "refused": "red"}


@reads_recordings()
def align(
    files: list[Path] = typer.Argument(
        ..., help="INS recording (.ncom, .xcom, or CSV with t, vx, yaw_rate) and CAN logs, a folder, or a run.yaml."
    ),
    search: tuple[float, float] | None = typer.Option(
        None, help="Bounds of the offset in seconds, where the log is known to be nearly right already."
    ),
    output: Path | None = typer.Option(None, help="Folder for alignment.json and alignment.png."),
    read_options: ReadOptions = ReadOptions(),
) -> None:
    """Find offset and drift between the clocks of INS and CAN log, report their uncertainty, and draw both signals.

    Exit status 0: good or doubtful (see the reasons). 1: no alignment. 2: files that cannot be read.
    """
    from rich.console import Console
    from st_offline.alignment_figure import alignment_figure
    from st_recordings.paths import new_folder
    from st_recordings.runs.raw import about_alignment, read_pair

    console = Console()
    with refusals("align"):
        _, settings = read_options.resolve(search=search)
        with console.status("reading and aligning"):
            pair = read_pair(files, settings)
        folder = new_folder(output, f"align-{pair.name}")
    for warning in pair.warnings:
        console.print(f"[yellow]{warning}[/yellow]", highlight=False, soft_wrap=True)
    if read_options.car is None and read_options.dbc is None:
        report_default_car("align", pair.dbc)
    alignment = pair.alignment
    report(pair, console)
    about = {**about_alignment(alignment), "ins_can_latency": pair.latency}
    (folder / "alignment.json").write_text(json.dumps(about, indent=2, allow_nan=False) + "\n")
    console.print(f"  {folder / 'alignment.json'}", highlight=False, soft_wrap=True)
    if pair.shared and alignment.offset_ns:
        title = f"{pair.name}: {sentence(alignment, pair.can.start_ns, pair.motion.absolute)}"
        alignment_figure(pair.shared, alignment, title, folder / "alignment.png")
        console.print(f"  {folder / 'alignment.png'}  [dim]both signals, before and after[/dim]", highlight=False,
                      soft_wrap=True)
    raise typer.Exit(1 if alignment.verdict == "refused" else 0)


def sentence(alignment, start_ns: int, absolute: bool) -> str:
    """Result in one sentence, for a title. start_ns: of the CAN log; absolute: whether INS time is UTC."""
    offset = (f"offset {_seconds(alignment.offset_at_ns(start_ns))} s" if absolute
              else f"CAN log starts at INS time {_seconds(alignment.to_reference_ns(start_ns))} s")
    if alignment.method == "by hand":
        return f"{offset}, by hand"
    return (f"{offset} ± {alignment.offset_deviation * 1e3:.1f} ms, drift {alignment.drift_ppm:+.1f} ± "
            f"{alignment.drift_deviation:.1f} ppm, {alignment.verdict}")


def report(pair, console) -> None:
    """The result in words and numbers."""
    from rich.table import Table

    alignment = pair.alignment
    style = VERDICT_STYLE[alignment.verdict]
    how = {"by hand": "by hand", "none": ""}.get(alignment.method, f"by {alignment.method}")
    console.print(f"[bold]{pair.name}[/bold]  [{style}]{alignment.verdict}[/{style}] {how}", highlight=False)
    if alignment.method != "none":
        start = pair.can.start_ns
        at = (alignment.at_ns - start) * 1e-9
        table = Table(box=None, padding=(0, 2), show_header=False)
        table.add_row("INS minus CAN clock", f"{_seconds(alignment.offset_at_ns(start))} s", "at the CAN log's start")
        if not pair.motion.absolute:
            table.add_row("INS time", f"{_seconds(alignment.to_reference_ns(start))} s", "at the CAN log's start")
        if alignment.method != "by hand":
            table.add_row("INS frames on the bus", pair.latency, "after the instant they are true for")
            table.add_row("INS minus CAN clock", f"{_seconds(alignment.offset_ns)} s",
                          f"{at:.1f} s later, in the middle of the common time")
            table.add_row("  deviation there", f"{alignment.offset_deviation * 1e3:.2f} ms",
                          f"{_without_latency(pair) * 1e3:.2f} ms without that of the latency assumed for the bus")
            table.add_row("drift", f"{alignment.drift_ppm:+.2f} ± {alignment.drift_deviation:.2f} ppm",
                          "INS against CAN clock")
            table.add_row("common time", f"{alignment.overlap:.1f} s", "")
        console.print(table)
    for reason in alignment.reasons:
        console.print(f"  [{style}]·[/{style}] {reason}", highlight=False, soft_wrap=True)
    if alignment.signals:
        table = Table(box=None, padding=(0, 2))
        table.add_column("signal")
        for name in ("alone, ms", "correlation", "residual / spread"):
            table.add_column(name, justify="right")
        for row in alignment.signals:
            alone = f"{row.difference * 1e3:+.2f} ± {row.deviation * 1e3:.2f}"
            table.add_row(row.name, alone, f"{row.correlation:.5f}", f"{row.residual:.4f}")
        console.print(table)


def _without_latency(pair) -> float:
    latency = max((s.latency_uncertainty for s in pair.shared), default=0.0)
    return max(pair.alignment.offset_deviation**2 - latency**2, 0.0) ** 0.5


def _seconds(nanoseconds: int) -> str:
    """All digits down to the microsecond, also of an offset of years, which a float would round."""
    sign, rest = ("-", -nanoseconds) if nanoseconds < 0 else ("+", nanoseconds)
    return f"{sign}{rest // 10**9}.{rest % 10**9 // 1000:06d}"
