"""`st live`: the suite on the real car."""

from pathlib import Path

import typer
from rich.console import Console


def live(
    can_interface: str = typer.Option("socketcan", help="python-can interface."),
    can_channel: str = typer.Option("can0", help="Channel of that interface."),
    ncom_port: int = typer.Option(3000, help="UDP port the RT sends NCOM to.", min=1, max=65535),
    ncom_address: str = typer.Option("0.0.0.0", help="Local address to listen on; the RT broadcasts: all by default."),
    ncom_sender: str = typer.Option("", help="Take packets of this sender address only."),
    vehicle: Path | None = typer.Option(
        None, help="Vehicle file; default config/vehicle/leaf.yaml.", exists=True, dir_okay=False
    ),
    dbc: Path | None = typer.Option(None, help="DBC; default config/can/leaf_ze0.dbc.", exists=True, dir_okay=False),
    signals: Path | None = typer.Option(
        None, help="Signal table; default config/can/leaf_ze0.yaml.", exists=True, dir_okay=False
    ),
    steering_sign: int | None = typer.Option(
        None, help="+1: the decoded sensor is left positive; -1: right positive; default in config/nodes.yaml."
    ),
    steering_latency: float | None = typer.Option(
        None, help="From the turn of the wheel to the frame on this host, s; default in config/nodes.yaml.", min=0.0,
        max=1.0
    ),
    duration: float | None = typer.Option(None, help="Stop after this many seconds; default: until Ctrl-C.", min=1.0),
    model: Path | None = typer.Option(
        None, help="Model file (model.yaml of `st discover`): a fourth model beside the three.", exists=True,
        dir_okay=False,
    ),
    effects: Path | None = typer.Option(
        None, help="Folder of own effects that --model uses.", exists=True, file_okay=False
    ),
    realtime: bool = typer.Option(
        False, "--realtime", help="Real-time scheduling for bridges and predictor; needs the right to (README)."
    ),
    bands: Path | None = typer.Option(
        None, help="Bands around every prediction (bands.yaml of `st calibrate`).", exists=True, dir_okay=False
    ),
    view: bool = typer.Option(False, "--view", help="Show it live in the browser, served on this machine only."),
    view_save: Path | None = typer.Option(None, help="Write the live view to this file (.rrd), for `st view`."),
    output: Path | None = typer.Option(None, help="Folder of the run; default runs/live-<time>."),
) -> None:
    """Listen to the RT3000 and the car's CAN bus; predict, score and record until Ctrl-C."""
    # Imported when it runs, see demo.py.
    from ..bands.live import with_bands
    from ..fourth_model import fourth_model
    from ..output import OutputError, new_folder
    from ..report import conclude
    from ..session import node_parameters, run
    from ..suite import SuiteError
    from ..view.window import finish, window
    from ..wires import bridge_parameters, vehicle_file

    console = Console()
    if steering_sign not in (None, 1, -1):
        typer.echo(f"st live: --steering-sign: {steering_sign} is neither 1 nor -1", err=True)
        raise typer.Exit(2)
    ins = {"udp_port": ncom_port, "bind_address": ncom_address, "sender_filter": ncom_sender}
    bus = {"interface": can_interface, "channel": can_channel}
    steering = {"steering_sign": steering_sign, "steering_latency": steering_latency}
    bus |= {name: value for name, value in steering.items() if value is not None}
    try:
        vehicle = vehicle_file(vehicle)
        fourth = fourth_model(model, effects, vehicle)
        shown = window(view, view_save)
        folder = new_folder(output, "live")
        bridges = bridge_parameters(vehicle, ins, bus, dbc, signals)
        parameters = with_bands(node_parameters(folder, vehicle, bridges, fourth), bands)
        outcome = run(folder, parameters, "live", duration, None, console, shown, supervised=True,
                      realtime=realtime)
    except (SuiteError, OutputError) as error:
        typer.echo(f"st live: {error}", err=True)
        raise typer.Exit(2) from None
    source = f"{can_interface}:{can_channel}, NCOM port {ncom_port}"
    status = conclude(folder, outcome, {"what": "live", "source": source, "vehicle": vehicle.stem}, console)
    finish(shown, console)
    raise typer.Exit(status)
