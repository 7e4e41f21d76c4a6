"""The command `st identify`: identifies vehicle parameters from experiments and from driving."""

from pathlib import Path

import typer

from . import _options as shared


@shared.expand_options(shared.ReadOptions)
def identify(
    what: str | None = typer.Argument(None, help="Name of an experiment; without it all experiments are listed."),
    files: list[Path] = typer.Argument(None, help="Data of the experiment: tables (CSV) or recordings."),
    model: Path | None = typer.Option(
        None, help="Model file used to predict drives, instead of nonlinear; its effects are not changed.",
        **shared.FILE),
    effects: shared.EffectsOfModel = None,
    output: Path | None = typer.Option(None, help="Folder of the results; default runs/identify-<what>-<time>."),
    force: bool = typer.Option(False, "--force", help="Also use drives in which `st check` finds an error."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> None:
    """Identify parameters: value, uncertainty, verdict; a figure, a report, and a vehicle file with provenance.

    The given vehicle file is not changed; the new one is vehicle.yaml in the output folder. Exit status: 0 at least one
    parameter is identified or doubtful, 1 none, 2 the data cannot be used.
    """
    from rich.table import Table
    from st_live.configuration import load_model
    from st_live.suite import SuiteError
    from st_offline.identification.experiment import IdentificationJob
    from st_offline.identification.identify_command import EXPERIMENTS, run_command
    from st_recordings.paths import new_folder

    if what is None:
        table = Table("experiment", "identifies", "data", box=None)
        for experiment in EXPERIMENTS.values():
            table.add_row(experiment.name, experiment.description, experiment.files)
        shared.console.print(table)
        return
    if what not in EXPERIMENTS:
        typer.echo(f"st identify: unknown experiment {what!r}; use {', '.join(EXPERIMENTS)}", err=True)
        raise typer.Exit(2)
    with shared.report_errors(f"identify {what}", SuiteError):
        vehicle, read_settings = read_options.resolve()
        parameters, file = shared.load_vehicle_or_default(vehicle)
        folder = new_folder(output, f"identify-{what}", create=False)
        base = load_model(model, effects, parameters, str(file))
        job = IdentificationJob(EXPERIMENTS[what], tuple(files or ()), parameters, str(file), folder, read_settings,
                                force, base)
        status = run_command(job, shared.console)
    shared.report_default_car("identify", vehicle, file)
    raise typer.Exit(status)
