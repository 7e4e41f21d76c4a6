"""The command `st check`: finds faults in recordings before they are mistaken for model errors."""

from pathlib import Path

import typer

from . import _options as shared


@shared.reads_recordings()
def check(
    runs: shared.Runs,
    output: Path | None = typer.Option(None, help="Folder of the results; default runs/check-<time>."),
    json: Path | None = typer.Option(None, "--json", help="JSON file of the results; default check.json in --output.",
                                     dir_okay=False),
    propose_correction: Path | None = typer.Option(
        None, "--propose-correction", "--propose-cure", dir_okay=False,
        help="Write a run.yaml that corrects the errors found; for a single run."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> None:
    """Find errors in recordings: units, signs, clocks, axes, projections, reference points, sensors.

    Nothing is corrected; each finding states how to correct it. Exit status: 0 no error found, 1 an error was found or
    a run could not be read, 2 nothing could be read.
    """
    from rich.console import Console
    from st_offline.checking.check_command import CheckJob, run_command

    with shared.report_errors("check"):
        vehicle, read_settings = read_options.resolve()
        parameters, file = shared.load_vehicle_or_default(vehicle)
        job = CheckJob(
            runs, parameters, str(file), vehicle is not None, read_settings, output, json, propose_correction)
        status = run_command(job, Console(), lambda used: shared.report_default_car("check", None, used))
    raise typer.Exit(status)
