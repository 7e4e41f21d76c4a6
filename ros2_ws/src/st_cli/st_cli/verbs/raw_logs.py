"""The commands `st align`, `st import`, `st ncom` and `st recover` for raw logs and bags."""

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.markup import escape

from . import _options as shared
from ._options import console

if TYPE_CHECKING:
    from rich.table import Table
    from st_core.clock_types import Alignment
    from st_core.vehicle import VehicleParameters
    from st_recordings.runs import ReadSettings
    from st_recordings.runs.raw import RawRun
    from st_recordings.runs.run_types import RunSource

VERDICT_STYLE = {"good": "green", "doubtful": "yellow", "refused": "red"}


@shared.expand_options(shared.ReadOptions)
def align(
    files: list[Path] = typer.Argument(
        ..., help="INS recording (.ncom, .xcom, .vbo, bag; CSV of t, vx, yaw_rate) and CAN logs; a folder; run.yaml."),
    search: tuple[float, float] | None = typer.Option(
        None, help="Bounds of the offset in seconds, if it is known approximately."),
    output: Path | None = typer.Option(None, help="Folder for the results; default runs/align-<name>-<time>."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> int:
    """Find offset and drift between the clocks of INS and CAN log, report their uncertainty, and draw the signals.

    Exit status: 0 good or doubtful alignment (the reasons are printed), 1 no usable alignment, 2 a file cannot be read.
    """
    from st_offline.alignment_figure import draw_alignment
    from st_offline.terminal import list_files, print_line
    from st_recordings.paths import json_text, new_folder
    from st_recordings.runs.raw import read_pair
    from st_recordings.runs.run_types import summarise_alignment

    _, settings = read_options.resolve(search=search)
    with console.status("reading and aligning"):
        pair = read_pair(files, settings)
    folder = new_folder(output, f"align-{pair.name}")
    for warning in pair.warnings:
        print_line(f"[yellow]{escape(warning)}[/yellow]")
    if read_options.car is None:
        shared.report_default_car("align", read_options.dbc, pair.dbc)
    alignment = pair.alignment
    print_alignment(pair)
    content = {**summarise_alignment(alignment), "ins_can_latency": pair.latency_text}
    (folder / "alignment.json").write_text(json_text(content), encoding="utf-8")
    results = {folder / "alignment.json": "offset and drift, with uncertainty"}
    if pair.shared_signals and alignment.method != "none":
        title = f"{pair.name}: {describe_alignment(alignment, pair.can.start_ns, pair.ins.is_utc)}"
        draw_alignment(pair.shared_signals, alignment, title, folder)
        results[folder / "alignment.png"] = "the signals of both recordings, aligned"
    list_files(results)
    return 1 if alignment.verdict == "refused" else 0


def describe_alignment(alignment: "Alignment", start_ns: int, is_utc: bool) -> str:
    """One-line description of an alignment, for a title. start_ns: start of the CAN log. is_utc: INS time is UTC."""
    offset = (f"offset {_format_seconds(alignment.offset_at_ns(start_ns))} s" if is_utc
              else f"CAN log starts at INS time {_format_seconds(int(alignment.to_reference_ns(start_ns)))} s")
    if alignment.method == "by hand":
        return f"{offset}, set by hand"
    return (f"{offset} (standard deviation {_format_deviation(alignment.offset_deviation * 1e3, 'ms', 1)}), drift "
            f"{alignment.drift_ppm:+.1f} ppm ({_format_deviation(alignment.drift_deviation, 'ppm', 1)}), "
            f"{alignment.verdict}")


def print_alignment(pair: "RawRun") -> None:
    """Print the verdict, offset and drift with their standard deviations, and the signals."""
    from rich.table import Table
    from st_offline.terminal import print_line

    alignment = pair.alignment
    style = VERDICT_STYLE[alignment.verdict]
    method = {"by hand": "set by hand", "none": ""}.get(alignment.method, f"by {alignment.method}")
    console.print(f"[bold]{escape(pair.name)}[/bold]  [{style}]{alignment.verdict}[/{style}] {method}", highlight=False)
    if alignment.method != "none":
        start_ns = pair.can.start_ns
        middle = (alignment.at_ns - start_ns) * 1e-9
        latency_deviation = max((s.latency_uncertainty for s in pair.shared_signals), default=0.0)
        estimation_deviation = max(alignment.offset_deviation**2 - latency_deviation**2, 0.0) ** 0.5
        table = Table(box=None, padding=(0, 2), show_header=False)
        offset = _format_seconds(alignment.offset_at_ns(start_ns))
        table.add_row("INS minus CAN clock", f"{offset} s", "at the start of the CAN log")
        if not pair.ins.is_utc:
            ins_time = _format_seconds(int(alignment.to_reference_ns(start_ns)))
            table.add_row("INS time", f"{ins_time} s", "at the start of the CAN log")
        if alignment.method != "by hand":
            overlap_label = "overlap" if alignment.method == "shared signals" else "time span of the INS time messages"
            if any(signal.name.startswith(("forward velocity", "yaw")) for signal in pair.shared_signals):
                table.add_row("delay of INS frames on CAN", pair.latency_text, "after the measurement")
            table.add_row("INS minus CAN clock", f"{_format_seconds(alignment.offset_ns)} s",
                          f"{middle:.1f} s later, in the middle of the {overlap_label}")
            without_latency = _format_deviation(estimation_deviation * 1e3, "ms")
            table.add_row("  standard deviation", _format_deviation(alignment.offset_deviation * 1e3, "ms"),
                          f"{without_latency} without the uncertainty of the latency")
            table.add_row("drift", f"{alignment.drift_ppm:+.2f} ppm",
                          "INS relative to CAN clock; standard deviation "
                          f"{_format_deviation(alignment.drift_deviation, 'ppm')}")
            table.add_row(overlap_label, f"{alignment.overlap:.1f} s", "")
        console.print(table)
    for reason in alignment.reasons:
        print_line(f"  [{style}]·[/{style}] {escape(reason)}")
    if alignment.signals:
        console.print(_make_signal_table(alignment))


def _make_signal_table(alignment: "Alignment") -> "Table":
    from rich.table import Column, Table

    table = Table(Column("signal", overflow="fold"), box=None, padding=(0, 2))
    for name in ("difference from the\ncommon offset, ms\n(standard deviation)", "correlation",
                 "residual /\nstandard\ndeviation"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in alignment.signals:
        difference = f"{row.difference * 1e3:+z.2f} ({_format_deviation(row.deviation * 1e3)})"
        table.add_row(row.name, difference, f"{row.correlation:.5f}", f"{row.residual:.4f}")
    return table


def _format_deviation(deviation: float, unit: str = "", decimals: int = 2) -> str:
    return f"{deviation:.{decimals}f} {unit}".rstrip() if math.isfinite(deviation) else "unknown"


def _format_seconds(nanoseconds: int) -> str:
    """Signed seconds with six decimals; a float would round an offset of years."""
    seconds, remainder = divmod(abs(nanoseconds), 10**9)
    return f"{'-' if nanoseconds < 0 else '+'}{seconds}.{remainder // 1000:06d}"


@shared.expand_options(shared.ReadOptions)
def import_(
    paths: list[Path] = typer.Argument(..., help="NCOM files with CAN logs, folders of them, or run.yaml."),
    output: Path | None = typer.Option(
        None, help="Bag directory; with several runs, the folder of their bags. Default runs/import-<name>-<time>."),
    search: tuple[float, float] | None = typer.Option(None, help="Bounds of the offset in seconds."),
    force: bool = typer.Option(False, "--force", help="Also write runs in which `st check` finds an error."),
    strict: bool = typer.Option(False, "--strict", help="Do not write runs with a doubtful alignment."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> int:
    """Write INS recording and CAN logs as one rosbag2 MCAP, aligned to one time base, with raw packets and frames.

    `ros2 bag play` sends the bag to the live nodes; `st check`, `evaluate`, `discover` and others read it. Exit status:
    0 all runs written, 1 some runs not written, 2 no run written.
    """
    from st_core.errors import ConfigurationError
    from st_recordings.paths import OutputError, new_folder
    from st_recordings.runs.errors import RunError
    from st_recordings.runs.sources import find_runs

    vehicle, settings = read_options.resolve(search=search, accept_doubtful=not strict)
    parameters, file = shared.load_vehicle_or_default(vehicle)
    runs = [run for run in find_runs(paths) if run.kind == "ncom" or run.problem is not None]
    if not runs:
        raise ConfigurationError(
            f"{', '.join(map(str, paths))}: no NCOM file with CAN logs found, and only these can be imported; "
            "st check, evaluate and discover read other recordings directly")
    written = 0
    for run in runs:
        try:
            bag = output / run.name if output and len(runs) > 1 else output
            _import_run(run, parameters, new_folder(bag, f"import-{run.name}", create=False), settings, force)
            written += 1
        except (RunError, OutputError) as error:
            typer.echo(f"st import: {error}", err=True)
    if written:
        shared.report_default_car("import", vehicle, file)
    return 0 if written == len(runs) else 1 if written else 2


def _import_run(source: "RunSource", car: "VehicleParameters", folder: Path, settings: "ReadSettings",
                force: bool) -> None:
    from st_offline.alignment_figure import draw_alignment
    from st_offline.checking.check_report import print_findings
    from st_offline.checking.gate import check_before_use
    from st_offline.terminal import list_files, make_progress_bars, print_line
    from st_recordings.runs.write import import_run

    started = time.perf_counter()
    with make_progress_bars() as progress:
        task = progress.add_task(f"{source.name}: reading and aligning", total=None)
        imported = import_run(source, car, folder, settings,
                              lambda run: check_before_use(source.path, run, car, force),
                              lambda fraction: progress.update(task, description=f"{source.name}: writing, %",
                                                               total=100, completed=round(100 * fraction)))
    duration = time.perf_counter() - started
    for warning in imported.warnings:
        print_line(f"[yellow]{escape(warning)}[/yellow]")
    print_findings({source.name: imported.findings})
    alignment = imported.run.alignment
    text = describe_alignment(alignment, imported.run.can.start_ns, is_utc=True)
    if imported.run.shared_signals:
        draw_alignment(imported.run.shared_signals, alignment, f"{source.name}: {text}", folder)
    style = VERDICT_STYLE[alignment.verdict]
    print_line(f"[bold]{escape(source.name)}[/bold]  [{style}]{text}[/{style}]")
    print_line("  " + ", ".join(f"{topic} {count}" for topic, count in imported.counts.items()))
    summary = f"{imported.span:.0f} s of driving in {duration:.1f} s, {imported.span / duration:.0f} times real time"
    list_files({folder: summary})


def ncom(
    file: Path = typer.Argument(..., help="NCOM recording.", **shared.FILE),
    csv: Path = typer.Option(..., "--csv", help="File for the navigation values, one row per packet.",
                             dir_okay=False),
    status: Path | None = typer.Option(None, "--status", help="File for the status fields, one row per change.",
                                       dir_okay=False),
) -> None:
    """Write an NCOM file as CSV: time, acceleration, rates, position, velocity, attitude and derived values."""
    from oxts_bridge.export import write_csv

    with shared.report_errors("ncom", OSError, ValueError):
        write_csv(file, csv, status)


def recover(
    path: Path = typer.Argument(..., help="A run, a bag directory or an .mcap file that was not closed.", exists=True),
    output: Path | None = typer.Option(
        None, help="Path of the repaired recording; default: in place, and the damaged file is renamed."),
) -> None:
    """Repair a recording cut off by a crash or power loss; a complete recording is not changed."""
    from st_recordings import recovery

    with shared.report_errors("recover", OSError, ValueError):
        typer.echo(str(recovery.recover(path, output)))
