"""The command `st demo`: runs the live suite on this computer, with the virtual Leaf or a recorded drive."""

from pathlib import Path

import typer
from rich.console import Console

from . import _options as shared

EXTRA_DRIVING = 2.0  # s of driving after the predictor stops
SCENARIOS = (
    "S1 to S7 of the paper, sweep, step, ramp_to_limit, brake_in_turn, lane_change, slalom, weave, circle, "
    "there_and_back, or a .yaml file"
)


def demo(
    scenario: str | None = typer.Option(None, help=f"Manoeuvre of the virtual Leaf: {SCENARIOS}; default S6."),
    drive: Path | None = typer.Option(None, help="A recorded drive (CSV) instead.", exists=True, dir_okay=False),
    # No --car: DBC, table and steering on these buses are always those of the virtual Leaf.
    vehicle: Path | None = typer.Option(
        None, help="Vehicle file; default the Leaf's. There is no --car, because the bus is always the Leaf's.",
        exists=True, dir_okay=False),
    plant_vehicle: Path | None = typer.Option(
        None, help="Vehicle file of the simulated car; default: --vehicle, which is the vehicle file of the nodes.",
        exists=True, dir_okay=False),
    duration: float | None = typer.Option(None, help="Seconds of driving; default 60, or the whole drive.", min=6.0),
    plant: str | None = typer.Option(None, help="ideal, realistic (default), or a file with plant settings."),
    effect: list[str] = typer.Option([], help="Set an effect of the virtual Leaf, name=value; repeatable."),
    ncom_rate: int = typer.Option(100, help="NCOM packets per second: 100 or 250."),
    seed: int = typer.Option(0, help="Seed of the simulated noise."),
    model: shared.FourthModel = None,
    effects: shared.EffectsOfModel = None,
    bands: shared.BandsFile = None,
    adaptive: shared.Adaptive = None,
    course: shared.CourseFile = None,
    record: shared.Record = "needed",
    view: shared.View = False,
    view_address: shared.ViewAddress = None,
    view_save: shared.ViewSave = None,
    output: Path | None = typer.Option(None, help="Folder of the run; default runs/demo-<what>-<time>."),
) -> None:
    """Run the live suite on the virtual Leaf or on a recorded drive; show how well each model predicts."""
    from st_live import configuration, report, session
    from st_live.page import LiveView
    from st_live.suite import SuiteError
    from st_recordings.paths import new_folder

    console = Console()
    what = drive.stem if drive else Path(scenario or "S6").stem
    if duration is None and drive is None:
        duration = 60.0
    options = ["--seed", str(seed), "--ncom-rate", str(ncom_rate)]
    for name, value in (("--drive", drive and drive.absolute()), ("--scenario", scenario), ("--plant", plant)):
        options += [name, str(value)] if value else []
    # The car drives on while the predictor stops, so that every prediction up to the end has inputs.
    options += ["--duration", str(duration + EXTRA_DRIVING)] if duration else []
    options += [part for setting in effect for part in ("--effect", setting)]
    with shared.report_errors("demo", SuiteError):
        car = configuration.VirtualCar(configuration.vehicle_file(vehicle), options,
                                       plant_vehicle and plant_vehicle.absolute())
        model_settings = configuration.model_parameters(model, effects, car.vehicle)
        page = LiveView(view, view_address, view_save)
        folder = new_folder(output, f"demo-{what}")
        parameters = configuration.live_parameters(folder, car.vehicle, car.bridge_parameters(), model_settings,
                                                   record == "all")
        parameters = configuration.add_files(parameters, bands, course, adaptive)
        outcome = session.run(folder, parameters, what, duration, car.start, console, page)
    about = {"what": what, "source": "recorded drive" if drive else "virtual Leaf",
             "vehicle": configuration.vehicle_name(car.vehicle), "seed": seed}
    status = report.conclude(folder, outcome, about, console)
    page.finish(folder, console)
    raise typer.Exit(status)
