"""`st demo`: the whole live suite on this machine, with the virtual Leaf, or a recorded drive, on the wires."""

from pathlib import Path

import typer
from rich.console import Console

from ..paths import config
from ..report import conclude
from ..session import node_parameters, output_folder, run, wait_until_sending
from ..suite import Child, Suite, SuiteError, find_executable, free_udp_port


def demo(
    scenario: str = typer.Option(
        "S6",
        help="Manoeuvre of the virtual Leaf: S1 to S7 of the paper, sweep, step, lane_change, brake_in_turn, ramp_to_limit.",
    ),
    drive: Path | None = typer.Option(
        None, help="A recorded drive (CSV) instead of a manoeuvre.", exists=True, dir_okay=False
    ),
    vehicle: Path | None = typer.Option(
        None, help="Vehicle file; default config/vehicle/leaf.yaml.", exists=True, dir_okay=False
    ),
    duration: float = typer.Option(60.0, help="Seconds of driving.", min=10.0),
    plant: str = typer.Option("realistic", help="ideal, realistic, or a file with plant settings."),
    effect: list[str] = typer.Option(
        [], help="Switch an effect of the virtual Leaf: name=value. May be given several times."
    ),
    ncom_rate: int = typer.Option(100, help="NCOM packets per second: 100 or 250."),
    seed: int = typer.Option(0, help="Of the simulated noise."),
    output: Path | None = typer.Option(None, help="Folder of the run; default runs/demo-<what>-<time>."),
) -> None:
    """Drive the virtual Leaf (or a recorded drive) through the real bridges and nodes, and show how well each model predicts."""
    console = Console()
    name = drive.stem if drive else scenario
    vehicle = (vehicle or config("vehicle/leaf.yaml")).absolute()
    try:
        folder = output_folder(output, f"demo-{name}")
        port = free_udp_port()
        # Each run has a CAN group of its own, so that two demos do not hear each other.
        channel = f"239.74.{163 + port % 64}.{1 + port // 64 % 254}"
        parameters = node_parameters(
            folder,
            vehicle,
            {
                "oxts_bridge": {"udp_port": port},
                "canedge_bridge": {
                    "interface": "udp_multicast",
                    "channel": channel,
                    "vehicle_file": str(vehicle),
                    "dbc_file": str(config("can/leaf_ze0.dbc")),
                    "signals_file": str(config("can/leaf_ze0.yaml")),
                },
            },
        )

        def start_leaf(suite: Suite) -> Child:
            what = ["--drive", str(drive.absolute())] if drive else ["--scenario", scenario, "--plant", plant]
            leaf = suite.start(
                "virtual_leaf",
                [
                    find_executable("st_sim", "virtual_leaf"),
                    *what,
                    "--vehicle",
                    str(vehicle),
                    "--duration",
                    str(duration),
                    "--seed",
                    str(seed),
                    "--ncom-port",
                    str(port),
                    "--ncom-rate",
                    str(ncom_rate),
                    "--can-interface",
                    "udp_multicast",
                    "--can-channel",
                    channel,
                    "--output",
                    str(folder / "truth"),
                    *(word for e in effect for word in ("--effect", e)),
                ],
            )
            wait_until_sending(leaf)
            return leaf

        outcome = run(folder, parameters, name, duration, start_leaf, console)
    except SuiteError as error:
        typer.echo(f"st demo: {error}", err=True)
        raise typer.Exit(1) from None
    about = {
        "what": name,
        "source": "recorded drive" if drive else "virtual Leaf",
        "vehicle": vehicle.stem,
        "duration": duration,
        "seed": seed,
    }
    raise typer.Exit(conclude(folder, outcome, about, console))
