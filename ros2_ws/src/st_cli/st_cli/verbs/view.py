"""The commands `st view` and `st foxglove`: show a recorded run or a running suite."""

import signal
import sys
import tempfile
import time
from pathlib import Path

import typer

from ._options import FILE, CarName, ReadOptions, VehicleOfBag, console, report_default_car_of_bag, report_errors


def view(
    recording: Path = typer.Argument(..., help="Folder of a run, a bag, or a saved view (.rrd).", exists=True),
    car: CarName = None,
    vehicle: VehicleOfBag = None,
    save: Path | None = typer.Option(None, help="Only write the view to this file (.rrd)."),
) -> None:
    """Show a recorded run in the browser, forwards and backwards in time, until Ctrl-C."""
    from st_live.rerun_server import check_new_rerun_file, check_rerun, show_recording
    from st_live.suite import SuiteError

    # SIGTERM acts like Ctrl-C, so that the server is stopped and the temporary folder removed.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with report_errors("view", SuiteError), tempfile.TemporaryDirectory(prefix="st-view-") as name:
        check_rerun("st view")
        vehicle = ReadOptions(car, vehicle).resolve_car().vehicle
        if save:
            check_new_rerun_file("--save", save)
        file = recording
        if recording.suffix != ".rrd":
            from st_live.recorded_view import draw_recording

            report_default_car_of_bag("view", recording, vehicle)
            file = save or Path(name, "view.rrd")
            with console.status("drawing"):
                n_frames = draw_recording(recording, file, vehicle)
            console.out(f"{n_frames} frames of {recording.name}", highlight=False)
        elif save:
            raise SuiteError(f"--save {save}: {recording} is already a saved view; leave out --save")
        if not save:
            show_recording(Path(name), file, console)


def foxglove(
    port: int = typer.Option(8765, help="Port of the WebSocket.", min=1, max=65535),
    host: str = typer.Option("127.0.0.1", help="Address to listen on; default: this computer only."),
    domain: int | None = typer.Option(None, help="ROS domain of the suite; `st demo` prints it.", min=0, max=232),
    vehicle: Path | None = typer.Option(
        None, help="Vehicle file, for the outline; default config/vehicle/leaf.yaml.", **FILE),
) -> None:
    """Relay a running suite to Foxglove and draw its markers, until Ctrl-C; open config/foxglove/st.json there."""
    from st_live.configuration import resolve_vehicle_file
    from st_live.suite import Suite, SuiteError, merge_parameters, read_domain_id
    from st_recordings.paths import config

    with report_errors("foxglove", SuiteError):
        car = resolve_vehicle_file(vehicle)
        domain = read_domain_id() if domain is None else domain
        markers = merge_parameters(config("nodes.yaml"), {"markers": {"vehicle_file": str(car)}})["markers"]
        with tempfile.TemporaryDirectory(prefix="st-foxglove-") as name, \
                Suite(Path(name), {"markers": markers}, domain or 0) as suite:
            relay = [sys.executable, "-m", "st_live.nodes.relay", "--host", host, "--port", str(port)]
            suite.start("foxglove_relay", relay)
            suite.start_node("st_predictor", "markers")
            console.print(f"ws://{host}:{port} relays ROS domain {domain or 0}; layout: config/foxglove/st.json; "
                          "Ctrl-C ends it", highlight=False, soft_wrap=True)
            try:
                while True:
                    suite.check()
                    time.sleep(0.5)
            except KeyboardInterrupt:
                console.print()
