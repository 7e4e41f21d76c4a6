"""`st foxglove`: a running suite for Foxglove, without foxglove_bridge."""

from pathlib import Path

import typer

from ._options import refusals


def foxglove(
    port: int = typer.Option(8765, help="Of the WebSocket.", min=1, max=65535),
    host: str = typer.Option("127.0.0.1", help="Address to listen on; the default reaches this machine only."),
    domain: int | None = typer.Option(None, help="ROS domain of the suite; `st demo` prints it.", min=0, max=232),
    vehicle: Path | None = typer.Option(
        None, help="Vehicle file, for the outline; default config/vehicle/leaf.yaml.", exists=True, dir_okay=False
    ),
) -> None:
    """Relay a running suite to Foxglove and draw its markers, until Ctrl-C; open config/foxglove/st.json there."""
    # Imported when it runs, see demo.py.
    import sys
    import tempfile
    import time

    from rich.console import Console
    from st_live.configuration import vehicle_file
    from st_live.suite import Suite, SuiteError, chosen_domain_id, merge
    from st_recordings.paths import config

    console = Console()
    with refusals("foxglove", SuiteError):
        car = vehicle_file(vehicle)
        domain = chosen_domain_id() if domain is None else domain
        markers = merge(config("nodes.yaml"), {"markers": {"vehicle_file": str(car)}})["markers"]
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
