"""The command `st evaluate`: evaluates runs in this process or in Dask workers, writes and prints the results."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from st_core.errors import ConfigurationError
from st_recordings.paths import new_folder
from st_recordings.runs import RunError, RunSource, find_runs
from st_recordings.runs.errors import join_problems

from ..bands.bands_report import print_tables
from ..checking.check_report import describe_clock, print_findings
from ..terminal import format_count, list_files, make_progress_bars, print_line, report_problem
from .drawing import check_formats
from .evaluation_report import describe_settings, make_headline, make_summary, write_results
from .tables import make_terminal_table
from .work import RunReport, Task, evaluate_run

FILE_DESCRIPTIONS = {
    "page": "the complete report, in one file", "json": "all numbers; keys in docs/manual/evaluation.md",
    "table": "the first table above", "latex": "the first table above, in the layout of the paper",
    "seconds": "errors by second of the horizon", "bins": "errors by driving condition",
    "manoeuvres": "errors by part of the drive"}
MEMORY_PER_WORKER = "1500MB"  # a worker that needs more is restarted, and its run fails


def run_command(paths: Sequence[Path], task: Task, output: Path | None, workers: int, scheduler: str | None,
                console: Console, tolerance: float | None = None) -> int:
    """Run the command; returns the exit status: 0 if every run was evaluated, else 1. tolerance: lateral error [m] for
    the advice on models; None for no advice. Raises ConfigurationError, OutputError."""
    check_formats(task.formats)
    start_time = time.perf_counter()
    sources = find_runs(paths)
    _raise_if_all_failed([source.problem for source in sources])
    task = replace(task, folder=new_folder(output, "evaluate"))
    reports = evaluate_all(sources, task, workers, scheduler, console)
    _raise_if_all_failed([report.problem for report in reports])
    evaluated_runs = [report for report in reports if not report.problem]
    title = make_headline(evaluated_runs, task.over)
    with console.status("writing the report"):
        files = write_results(reports, task, title)
    console.print(make_terminal_table(evaluated_runs, task.over, title, console.width))
    print_line(make_summary(evaluated_runs, task)[0], console)
    for key, value in describe_settings(task).items():
        print_line(f"[dim]{key}: {escape(value)}[/dim]", console)
    print_tables([report.bands for report in evaluated_runs], task.bands is not None, task.adaptive, console)
    if tolerance is not None:
        from .advice import print_advice  # the import takes half a second

        print_advice([s for s, r in zip(sources, reports, strict=True) if not r.problem], task, tolerance, console)
    for report in evaluated_runs:
        if text := describe_clock(report.metadata["alignment"]):
            print_line(f"{escape(report.name)}: {escape(text)}", console)
    print_findings({report.name: report.findings for report in reports}, console)
    list_files({files[key]: description for key, description in FILE_DESCRIPTIONS.items()}, console)
    failed_reports = [report for report in reports if report.problem]
    for report in failed_reports:
        report_problem(report.name, report.problem, console)
    times = ", ".join(f"{part} {sum(r.seconds.get(part, 0.0) for r in evaluated_runs):.1f} s"
                      for part in ("read", "predict", "draw"))
    hours = sum(r.metadata["duration"] for r in evaluated_runs) / 3600.0
    console.print(f"[dim]{format_count(len(evaluated_runs), 'run')}, {hours:.2f} h of driving in "
                  f"{time.perf_counter() - start_time:.1f} s ({times})[/dim]", highlight=False)
    return 1 if failed_reports else 0


def _raise_if_all_failed(problems: Sequence[RunError | str | None]) -> None:
    if all(problems):
        raise ConfigurationError("no run can be used: " + join_problems(map(str, problems)))


def evaluate_all(sources: Sequence[RunSource], task: Task, workers: int, scheduler: str | None,
                 console: Console) -> list[RunReport]:
    """Evaluate all runs with a progress display; returns the reports in the order of the sources."""
    with make_progress_bars(console) as progress:
        runs, starts = progress.add_task("runs"), progress.add_task("", visible=False)

        def evaluate(source: RunSource) -> RunReport:
            progress.update(starts, description=escape(f"{source.name}: reading"), total=None, completed=0,
                            visible=True)
            return evaluate_run(source, task, lambda done, total: progress.update(
                starts, description=escape(source.name), total=total, completed=done))

        reports = (_evaluate_in_workers(sources, task, workers, scheduler) if workers > 1 or scheduler else
                   map(evaluate, sources))
        by_name = {report.name: report for report in progress.track(reports, len(sources), task_id=runs)}
    return [by_name[source.name] for source in sources]


def _evaluate_in_workers(sources: Sequence[RunSource], task: Task, workers: int,
                         scheduler: str | None) -> Iterator[RunReport]:
    """Yield the report of each run in the order of completion.

    scheduler: address of a Dask scheduler; its workers read the files under the same paths. Raises ConfigurationError
    if the workers are not available.
    """
    try:
        from distributed import Client, LocalCluster, as_completed
    except ImportError:
        raise ConfigurationError("Dask is not installed: leave out --workers and --scheduler") from None
    with contextlib.ExitStack() as stack:
        try:
            cluster = scheduler or stack.enter_context(LocalCluster(
                n_workers=workers, threads_per_worker=1, memory_limit=MEMORY_PER_WORKER, dashboard_address=None,
                host="127.0.0.1", silence_logs=50))
            client = stack.enter_context(Client(cluster, timeout="10s"))
        except (OSError, TimeoutError) as error:
            problem = f"no Dask scheduler at {scheduler}" if scheduler else "Dask workers cannot be started"
            raise ConfigurationError(f"{problem}: {error}") from None
        futures = {client.submit(evaluate_run, source, task, pure=False, retries=0): source for source in sources}
        for future in as_completed(futures):
            failure = future.exception()
            source = futures[future]
            yield future.result() if failure is None else RunReport(
                source.name, problem=f"{source.path}: the worker failed: {' '.join(str(failure).split())[:200]}")
            future.release()
