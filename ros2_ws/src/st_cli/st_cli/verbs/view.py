"""`st view`: a recorded run in the browser."""

from pathlib import Path

import typer

from ._options import CarName, refusals, report_default_car_of_bag, resolve_car


def view(
    recording: Path = typer.Argument(..., help="Folder of a run, a bag, or a saved view (.rrd).", exists=True),
    car: CarName = None,
    vehicle: Path | None = typer.Option(
        None, help="Vehicle file, for the outline; default that of --car, else the one in the recording.", exists=True,
        dir_okay=False
    ),
    save: Path | None = typer.Option(None, help="Only write the view to this file (.rrd)."),
) -> None:
    """Look at a recorded run in the browser, forwards and backwards in time, until Ctrl-C."""
    # Imported when it runs, see demo.py.
    import signal
    import tempfile

    from rich.console import Console
    from st_live.page import check_new_rerun_file
    from st_live.rerun_server import RecordingView, check_rerun
    from st_live.suite import SuiteError

    # SIGTERM ends it as Ctrl-C does, so that server and temporary folder are removed.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    console = Console()
    with refusals("view", SuiteError), tempfile.TemporaryDirectory(prefix="st-view-") as name:
        check_rerun("st view")
        vehicle = resolve_car(car, vehicle)[0]
        if save:
            check_new_rerun_file("--save", save)
        file = recording
        if recording.suffix != ".rrd":
            from st_live.recorded_view import draw

            report_default_car_of_bag("view", recording, vehicle)
            file = save or Path(name, "view.rrd")
            with console.status("drawing"):
                pictures = draw(recording, file, vehicle)
            console.print(f"{pictures} pictures of {recording.name}", highlight=False)
        elif save:
            raise SuiteError(f"--save {save}: {recording} is a saved view already")
        if not save:
            with RecordingView(Path(name), file) as page:
                page.show(console)
