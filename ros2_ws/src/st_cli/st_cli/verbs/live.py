"""The commands `st demo` and `st live`: run the live suite with a simulated or a real car."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

from . import _options as shared

EXTRA_DRIVING = 2.0  # s; the drive is this much longer than the run
SCENARIOS = ("S1 to S7 of the paper, sweep, step, ramp_to_limit, brake_in_turn, lane_change, slalom, weave, circle, "
             "there_and_back, or a .yaml file")


@shared.expand_options(shared.RunOptions)
def demo(
    scenario: str | None = typer.Option(None, help=f"Manoeuvre of the virtual Leaf: {SCENARIOS}; default S6."),
    drive: Path | None = typer.Option(None, help="Recorded drive (CSV) to use instead of a scenario.", **shared.FILE),
    vehicle: Path | None = typer.Option(
        None, help="Vehicle file; default the Leaf's. There is no --car, because the bus is always the Leaf's.",
        **shared.FILE),
    plant_vehicle: Path | None = typer.Option(
        None, help="Vehicle file of the simulated car; default: --vehicle, which is the vehicle file of the nodes.",
        **shared.FILE),
    duration: float | None = typer.Option(
        None, callback=shared.in_range(6.0, "s"),
        help="Seconds of driving, at least 6; default 60, or the whole drive."),
    plant: str | None = typer.Option(None, help="ideal, realistic (default), or a file with plant settings."),
    effect: list[str] = typer.Option([], help="Set an effect of the virtual Leaf, name=value; repeatable."),
    ncom_rate: int = typer.Option(100, help="NCOM packets per second: 100 or 250."),
    seed: int = typer.Option(0, help="Seed of the simulated noise."),
    run_options: shared.RunOptions = shared.RunOptions(),
    output: Path | None = typer.Option(None, help="Folder for the run; default runs/demo-<scenario or drive>-<time>."),
) -> int:
    """Run the live suite on the virtual Leaf or on a recorded drive; show how well each model predicts."""
    from st_live import configuration, session

    title = drive.stem if drive else Path(scenario or "S6").stem
    if duration is None and drive is None:
        duration = 60.0
    options = ["--seed", str(seed), "--ncom-rate", str(ncom_rate)]
    for name, value in (("--drive", drive and drive.absolute()), ("--scenario", scenario), ("--plant", plant)):
        options += [name, str(value)] if value else []
    # The drive is longer than the run, so that measured inputs do not end before the last prediction.
    options += ["--duration", str(duration + EXTRA_DRIVING)] if duration else []
    options += [part for setting in effect for part in ("--effect", setting)]
    car = configuration.VirtualCar(configuration.resolve_vehicle_file(vehicle), options,
                                   plant_vehicle and plant_vehicle.absolute())
    description, source = (title, "recorded drive") if drive else (f"scenario {title}", "virtual Leaf")
    vehicle_name = configuration.find_vehicle_name(car.vehicle)
    summary = {"title": description, "source": source, "vehicle": vehicle_name, "seed": seed}
    return _run(f"demo-{title}", summary, car.vehicle, car.make_bridge_parameters(), run_options, output,
                source=lambda suite: session.make_timer(duration, car.start(suite) - session.END_MARGIN))


@shared.expand_options(shared.ReadOptions, "car", "vehicle", "dbc", "signals", "steering_sign", "steering_latency")
@shared.expand_options(shared.RunOptions)
def live(
    can_interface: str = typer.Option("socketcan", help="python-can interface."),
    can_channel: str = typer.Option("can0", help="Channel of that interface."),
    ncom_port: int = typer.Option(3000, help="UDP port to which the RT sends NCOM.", min=1, max=65535),
    ncom_address: str = typer.Option("0.0.0.0", help="Local address to listen on; default all, as the RT broadcasts."),
    ncom_sender: str = typer.Option("", help="Accept packets from this address only."),
    car_options: shared.ReadOptions = shared.ReadOptions(),
    duration: float | None = typer.Option(
        None, callback=shared.in_range(1.0, "s"),
        help="Stop after this many seconds, at least 1; default: until Ctrl-C."),
    realtime: bool = typer.Option(
        False, "--realtime", help="Real-time scheduling of bridges and predictor; to permit it: manual, live.md."),
    run_options: shared.RunOptions = shared.RunOptions(),
    output: Path | None = typer.Option(None, help="Folder for the run; default runs/live-<time>."),
) -> int:
    """Listen to the RT3000 and the car's CAN bus; predict, score and record until Ctrl-C."""
    from st_live import configuration, session

    ins = {"udp_port": ncom_port, "bind_address": ncom_address, "sender_filter": ncom_sender}
    can = {"interface": can_interface, "channel": can_channel}
    car = car_options.fill_in_car(requires_bus=True)
    vehicle = configuration.resolve_vehicle_file(car.vehicle)
    bridges = configuration.make_bridge_parameters(vehicle, ins, can | car.sensor_settings, car.dbc, car.signals)
    summary = {"title": "live", "source": f"{can_interface}:{can_channel}, NCOM port {ncom_port}",
               "vehicle": configuration.find_vehicle_name(vehicle)}
    return _run("live", summary, vehicle, bridges, run_options, output, car.vehicle is None,
                source=lambda _: session.make_timer(duration), default_domain=0, supervised=True, realtime=realtime)


def _run(name: str, summary: dict[str, Any], vehicle: Path, bridges: Mapping[str, Mapping[str, Any]],
         options: shared.RunOptions, output: Path | None, reports_default_car: bool = False, **arguments: Any) -> int:
    """Run the suite and report the results; returns the exit status.

    name: start of the name of the default output folder. summary: entries of summary.json. bridges: parameters of the
    bridges. reports_default_car: whether to report the use of the Leaf's file. arguments: further arguments of
    `session.run`. Raises StCoreError, RunError and OutputError.
    """
    from st_live import configuration, report, session
    from st_recordings.paths import new_folder

    model_settings = configuration.make_model_parameters(options.model, options.effects, vehicle)
    view = options.make_view()
    folder = new_folder(output, name)
    parameters = configuration.make_live_parameters(folder, vehicle, bridges, model_settings, options.record == "all")
    parameters = configuration.set_bands_and_course(parameters, options.bands, options.course, options.adaptive)
    if reports_default_car:
        shared.report_default_car(name, None, vehicle)
    outcome = session.run(folder, parameters, summary["title"], shared.console, view, **arguments)
    status = report.report_results(folder, outcome, summary, shared.console)
    view.finish(folder, shared.console)
    return status
