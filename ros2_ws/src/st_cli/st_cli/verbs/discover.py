"""The commands `st identify` and `st discover`: identify parameters; find errors in vehicle file, sensors and model."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer
from st_core.channels import CHANNELS
from typer.core import TyperCommand

from . import _options as shared

REFERENCE = "--reference"


class ReferenceCommand(TyperCommand):
    """Command in which `--reference a b` means `--reference a --reference b`; the next option or -- ends the list."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        expanded = expand_references(args)
        try:
            return super().parse_args(ctx, list(expanded))
        except typer.BadParameter as error:
            if REFERENCE not in expanded or error.param is None or error.param.name != "runs":
                raise
            raise typer.BadParameter(f"no runs are left: {REFERENCE} takes every path up to the next option; name "
                                     "the runs before it, or after --", ctx) from None


def expand_references(arguments: Sequence[str]) -> list[str]:
    """Repeat --reference before each of the paths that follow it, up to the next option."""
    expanded: list[str] = []
    count = -1  # paths since the last --reference; -1 outside its list
    for argument in arguments:
        if argument.startswith("-"):
            count = 0 if argument == REFERENCE else -1
        elif count >= 0:
            expanded += [REFERENCE] if count else []
            count += 1
        expanded.append(argument)
    return expanded


@shared.expand_options(shared.ReadOptions)
def discover(
    runs: shared.Runs,
    reference: list[Path] = typer.Option(
        [], REFERENCE, help="Reference drives of the healthy car: all paths up to the next option. The search starts "
        "from the fit to these drives instead of from the vehicle file."),
    base: str = typer.Option("nonlinear", help="Base model: kinematic, linear, nonlinear, or a model file (.yaml)."),
    output: Path | None = typer.Option(None, help="Folder for the results; default: a new one in runs/."),
    channels: str = typer.Option(",".join(CHANNELS), help="Measurements to use, comma-separated.", show_default="all"),
    effects: Path | None = typer.Option(None, help="Folder of your own effects to include.", **shared.FOLDER),
    simulate_power: bool = typer.Option(
        False, "--simulate-power", help="Measure power and false-alarm rate with one search step on simulated drives, "
        "with known effects and without effects; by default, the power is predicted. Takes minutes."),
    propose: bool | None = typer.Option(
        None, "--propose/--no-propose", help="Search for a relation that is not in the effect library, and write it as "
        "an effect file to keep or delete; default: if the unexplained residual is large. Takes a minute."),
    seed: int = typer.Option(0, help="Seed of all random draws."),
    jobs: int = typer.Option(1, help="Number of parallel processes (reading) and threads (search).", min=1),
    figures: str = typer.Option("png", help="Formats of the figure files: png, pdf, svg; empty: none."),
    report: bool = typer.Option(True, help="Draw figures and write report.html."),
    force: bool = typer.Option(False, "--force", help="Also use runs in which `st check` finds an error."),
    fresh: bool = typer.Option(False, "--fresh", help="Search again, even if the same inputs have a cached result."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> int:
    """Find errors in vehicle file, sensors and model; write corrected files and the reduction of the prediction error.

    Exit status: 0 the result uses all runs, 1 some could not be used, 2 the search could not be started.
    """
    from st_core.discovery import DiscoverySettings
    from st_offline.discovery.discover_command import run_command
    from st_offline.discovery.drives import Request

    vehicle, read_settings = read_options.resolve()
    parameters, file = shared.load_vehicle_or_default(vehicle)
    settings = DiscoverySettings(channels=shared.split_names(channels), seed=seed, simulate_power=simulate_power)
    request = Request(base, parameters, str(file), file.read_text(encoding="utf-8"), settings, runs, reference,
                      read_settings, effects, output, jobs, shared.split_names(figures), report, not fresh, force,
                      propose)
    status = run_command(request)
    shared.report_default_car("discover", vehicle, file)
    return status


@shared.expand_options(shared.ReadOptions)
def identify(
    experiment: str | None = typer.Argument(None, help="Name of an experiment; without it all experiments are listed."),
    files: list[Path] = typer.Argument(None, help="Data of the experiment: tables (CSV) or recordings."),
    model: Path | None = typer.Option(
        None, help="Model file used to predict drives, instead of nonlinear; its effects are not changed.",
        **shared.FILE),
    effects: shared.ModelEffects = None,
    output: Path | None = typer.Option(None, help="Folder for the results; default: a new one in runs/."),
    force: bool = typer.Option(False, "--force", help="Also use drives in which `st check` finds an error."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> int:
    """Identify parameters; write values, uncertainties, verdicts, figure, report, and a vehicle file with provenance.

    The given vehicle file is not changed; the new one is vehicle.yaml in the output folder. Exit status: 0 at least one
    parameter is identified or doubtful, 1 none, 2 the data cannot be used.
    """
    from st_core.errors import ConfigurationError
    from st_live.configuration import load_model
    from st_offline.identification.experiment import IdentificationJob
    from st_offline.identification.identify_command import EXPERIMENTS, run_command
    from st_offline.terminal import make_table
    from st_recordings.paths import new_folder

    if experiment is None:
        shared.console.print(make_table([{"experiment": e.name, "identifies": e.description, "data": e.required_files}
                                         for e in EXPERIMENTS.values()]))
        return 0
    if experiment not in EXPERIMENTS:
        raise ConfigurationError(f"unknown experiment {experiment!r}; use {', '.join(EXPERIMENTS)}")
    with shared.report_errors(f"identify {experiment}"):
        vehicle, read_settings = read_options.resolve()
        parameters, file = shared.load_vehicle_or_default(vehicle)
        folder = new_folder(output, f"identify-{experiment}", create=False)
        job = IdentificationJob(EXPERIMENTS[experiment], tuple(files or ()), parameters, str(file), folder,
                                read_settings, force, load_model(model, effects, parameters, str(file)))
        status = run_command(job)
    shared.report_default_car("identify", vehicle, file)
    return status
