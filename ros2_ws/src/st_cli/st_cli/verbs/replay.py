"""The commands that play, verify and show runs: `st replay`, `st verify`, `st view` and `st foxglove`."""

import signal
import sys
import tempfile
import time
from pathlib import Path

import typer

from . import _options as shared


@shared.expand_options(shared.ReadOptions, *shared.BAG_INPUTS, vehicle=shared.BagVehicle)
@shared.expand_options(shared.RunOptions, "bands", "adaptive", "course", "view", "view_address", "view_save")
def replay(
    bag: Path = typer.Argument(..., help="Bag with odometry and steering, or the folder of a run.", exists=True),
    rate: float = typer.Option(1.0, help="Playback speed relative to the recording.", min=0.05, max=100.0),
    fast: bool = typer.Option(False, "--fast", help="Play as fast as predictor and evaluator can follow."),
    force: bool = typer.Option(False, "--force", help="Use the recording even if `st check` finds an error in it."),
    run_options: shared.RunOptions = shared.RunOptions(),
    output: Path | None = typer.Option(None, help="Folder for the run; default runs/replay-<time>."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> int:
    """Play a recording through predictor, evaluator and recorder, on the clock of the recording."""
    from st_live.configuration import find_bag
    from st_live.replaying import replay_bag
    from st_live.report import report_results
    from st_offline.checking.check_report import findings_as_json, print_findings
    from st_offline.checking.gate import check_bag
    from st_recordings.paths import new_folder
    from st_recordings.runs.readers.bag import add_steering

    vehicle, read_settings = read_options.resolve()
    run, bag = bag, find_bag(bag)
    read_settings = add_steering(bag, read_settings)
    view = run_options.make_view()
    findings = check_bag(bag, vehicle, force, read_settings)
    print_findings({bag.name: findings})
    shared.report_bag("replay", run, vehicle)
    folder = new_folder(output, f"replay-{bag.stem}")
    outcome, name = replay_bag(bag, folder, vehicle, 0.0 if fast else rate, shared.console, view, run_options.bands,
                               run_options.course, run_options.adaptive, read_settings)
    summary = {"title": f"replay of {bag.name}", "source": str(bag), "vehicle": name,
               "findings": findings_as_json(findings)}
    status = report_results(folder, outcome, summary, shared.console)
    view.finish(folder, shared.console)
    return status


@shared.expand_options(shared.ReadOptions, *shared.BAG_INPUTS, vehicle=shared.BagVehicle)
def verify(
    bag: Path = typer.Argument(..., help="A recording, or the folder of a run.", exists=True),
    tolerance: float = typer.Option(
        0.001, callback=shared.in_range(0.0, "m"), help="Largest accepted difference, m or, for yaw angles, rad."),
    through_nodes: bool = typer.Option(False, "--replay", help="Play the recording through the nodes and compare."),
    force: bool = typer.Option(False, "--force", help="Use the recording even if `st check` finds an error in it."),
    output: Path | None = typer.Option(None, help="Folder for the replay; default runs/verify-<time>."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> int:
    """Compare predictions and scores of the nodes with those computed offline from the same measurements.

    A recording without predictions is first played through the nodes. Exit status: 0 equal within the tolerance, 1 not
    equal, 2 nothing to compare.
    """
    from st_live.configuration import find_bag
    from st_live.verification import verify_command
    from st_offline.checking.check_report import print_findings
    from st_offline.checking.gate import check_bag
    from st_recordings.runs.readers.bag import add_steering

    vehicle, read_settings = read_options.resolve()
    read_settings = add_steering(find_bag(bag), read_settings)
    print_findings({bag.name: check_bag(find_bag(bag), vehicle, force, read_settings)})
    shared.report_bag("verify", bag, vehicle)
    return verify_command(bag, vehicle, tolerance, through_nodes, output, shared.console, read_settings)


def view(
    recording: Path = typer.Argument(..., help="Folder of a run, a bag, or a saved view (.rrd).", exists=True),
    car: shared.CarName = None,
    vehicle: shared.BagVehicle = None,
    save: Path | None = typer.Option(None, help="Only write the view to this file (.rrd)."),
) -> None:
    """Show a recorded run in the browser, forwards and backwards in time, until Ctrl-C."""
    from st_live.page import check_new_rerun_file, check_rerun, show_recording
    from st_live.suite import SuiteError

    # SIGTERM acts like Ctrl-C, so that the server is stopped and the temporary folder removed.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with shared.report_errors("view"), tempfile.TemporaryDirectory(prefix="st-view-") as name:
        check_rerun()
        vehicle = shared.ReadOptions(car, vehicle).fill_in_car().vehicle
        if save:
            check_new_rerun_file("--save", save)
        file = recording
        if recording.suffix != ".rrd":
            from st_live.recorded_view import draw_recording

            file = save or Path(name, "view.rrd")
            with shared.console.status("drawing"):
                n_frames = draw_recording(recording, file, vehicle)
            shared.report_bag("view", recording, vehicle)
            shared.console.out(f"{n_frames} frames of {recording.name}", highlight=False)
        elif save:
            raise SuiteError(f"--save {save}: {recording} is already a saved view; leave out --save")
        if not save:
            show_recording(Path(name), file, shared.console)


def foxglove(
    port: int = typer.Option(8765, help="Port of the WebSocket.", min=1, max=65535),
    host: str = typer.Option("127.0.0.1", help="Address to listen on; default: this computer only."),
    domain: int | None = typer.Option(None, help="ROS domain of the suite; `st demo` prints it.", min=0, max=232),
    vehicle: Path | None = typer.Option(
        None, help="Vehicle file, for the outline; default config/vehicle/leaf.yaml.", **shared.FILE),
) -> None:
    """Relay a running suite to Foxglove and draw its markers, until Ctrl-C; the layout is config/foxglove/st.json."""
    from st_live.configuration import resolve_vehicle_file
    from st_live.suite import Suite, merge_parameters, read_domain_id
    from st_recordings.paths import config

    with shared.report_errors("foxglove"):
        car = resolve_vehicle_file(vehicle)
        domain = (read_domain_id() if domain is None else domain) or 0
        markers = merge_parameters(config("nodes.yaml"), {"markers": {"vehicle_file": str(car)}})["markers"]
        with tempfile.TemporaryDirectory(prefix="st-foxglove-") as name, \
                Suite(Path(name), {"markers": markers}, domain) as suite:
            relay = [sys.executable, "-m", "st_live.nodes.relay", "--host", host, "--port", str(port)]
            suite.start("foxglove_relay", relay)
            suite.start_node("st_predictor", "markers")
            shared.console.print(f"ws://{host}:{port} relays ROS domain {domain}; layout: "
                                 "config/foxglove/st.json; press Ctrl-C to stop", highlight=False, soft_wrap=True)
            try:
                while True:
                    suite.check()
                    time.sleep(0.5)
            except KeyboardInterrupt:
                shared.console.print()
