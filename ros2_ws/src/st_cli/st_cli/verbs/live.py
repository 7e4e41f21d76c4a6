"""The command `st live`: runs the suite on the real car."""

from pathlib import Path

import typer
from rich.console import Console

from . import _options as shared


def live(
    can_interface: str = typer.Option("socketcan", help="python-can interface."),
    can_channel: str = typer.Option("can0", help="Channel of that interface."),
    ncom_port: int = typer.Option(3000, help="UDP port to which the RT sends NCOM.", min=1, max=65535),
    ncom_address: str = typer.Option("0.0.0.0", help="Local address to listen on; default all, as the RT broadcasts."),
    ncom_sender: str = typer.Option("", help="Accept packets from this address only."),
    car: shared.CarName = None,
    vehicle: shared.VehicleFile = None,
    dbc: shared.Dbc = None,
    signals: shared.Signals = None,
    steering_sign: shared.SteeringSign = None,
    steering_latency: shared.SteeringLatency = None,
    duration: float | None = typer.Option(None, help="Stop after this many seconds; default: until Ctrl-C.", min=1.0),
    model: shared.FourthModel = None,
    effects: shared.EffectsOfModel = None,
    realtime: bool = typer.Option(
        False, "--realtime", help="Real-time scheduling for bridges and predictor; permission: docs/manual/live.md."),
    bands: shared.BandsFile = None,
    adaptive: shared.Adaptive = None,
    course: shared.CourseFile = None,
    record: shared.Record = "needed",
    view: shared.View = False,
    view_address: shared.ViewAddress = None,
    view_save: shared.ViewSave = None,
    output: Path | None = typer.Option(None, help="Folder of the run; default runs/live-<time>."),
) -> None:
    """Listen to the RT3000 and the car's CAN bus; predict, score and record until Ctrl-C."""
    from st_live import configuration, report, session
    from st_live.page import LiveView
    from st_live.suite import SuiteError
    from st_recordings.paths import new_folder

    console = Console()
    ins = {"udp_port": ncom_port, "bind_address": ncom_address, "sender_filter": ncom_sender}
    bus = {"interface": can_interface, "channel": can_channel}
    with shared.report_errors("live", SuiteError):
        named = shared.resolve_car(car, vehicle, dbc, signals, steering_sign, steering_latency, complete=True)
        vehicle = configuration.vehicle_file(named.vehicle)
        model_settings = configuration.model_parameters(model, effects, vehicle)
        page = LiveView(view, view_address, view_save)
        folder = new_folder(output, "live")
        bridges = configuration.bridge_parameters(vehicle, ins, bus | named.steering, named.dbc, named.signals)
        parameters = configuration.live_parameters(folder, vehicle, bridges, model_settings, record == "all")
        parameters = configuration.add_files(parameters, bands, course, adaptive)
        if named.vehicle is None:
            shared.report_default_car("live", vehicle)
        outcome = session.run(folder, parameters, "live", duration, None, console, page, supervised=True,
                              realtime=realtime)
    about = {"what": "live", "source": f"{can_interface}:{can_channel}, NCOM port {ncom_port}",
             "vehicle": configuration.vehicle_name(vehicle)}
    status = report.conclude(folder, outcome, about, console)
    page.finish(folder, console)
    raise typer.Exit(status)
