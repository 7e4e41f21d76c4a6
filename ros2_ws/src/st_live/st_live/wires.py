"""What stands at the other end of the wires: parameters of the bridges for a real car, or for the virtual Leaf."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from st_recordings.car import read_vehicle
from st_recordings.paths import config, project_root
from st_sim.run import check
from st_sim.settings import SimulationError

from .suite import Suite, SuiteError, find_executable, free_udp_port

START_TIMEOUT = 20.0  # s until the virtual Leaf sends


def vehicle_file(given: Path | None) -> Path:
    """The vehicle file of a run, the Leaf's by default. Raises RunError and StCoreError, one line."""
    path = (given or config("vehicle/leaf.yaml")).absolute()
    read_vehicle(path)
    return path


def name_of(vehicle: Path) -> str:
    """Of a car, in results: its folder where the file is one of a folder, else its file."""
    return vehicle.parent.name if vehicle.name == "vehicle.yaml" else vehicle.stem


def bridge_parameters(
    vehicle: Path,
    ins: dict[str, Any],
    bus: dict[str, Any],
    dbc: Path | None = None,
    signals: Path | None = None,
) -> dict[str, dict[str, Any]]:
    """Parameters of both bridges. ins: of oxts_bridge; bus: of canedge_bridge: interface, channel, steering."""
    files = {
        "vehicle_file": str(vehicle),
        "dbc_file": str((dbc or config("can/leaf_ze0.dbc")).absolute()),
        "signals_file": str((signals or config("can/leaf_ze0.yaml")).absolute()),
    }
    # The raw frames go into the bag, so that it can be decoded again with another DBC.
    return {"oxts_bridge": ins, "canedge_bridge": {**bus, **files, "publish_frames": True}}


class VirtualCar:
    """The virtual Leaf on wires of its own: a free UDP port, and that port's CAN group on the loopback interface.

    vehicle: file of bridges and nodes. options: of the virtual_leaf command, besides those for the wires. driven: file
    of the car itself, where that is another. Raises SuiteError for what it would refuse.
    """

    def __init__(self, vehicle: Path, options: Sequence[str], driven: Path | None = None):
        self.vehicle = vehicle
        self.port = free_udp_port()
        self.channel = f"239.74.163.2:{self.port}"
        wires = {
            "--vehicle": driven or self.vehicle,
            "--config": project_root() / "config",
            "--ncom-port": self.port,
            "--can-interface": "udp_multicast",
            "--can-channel": self.channel,
        }
        self._words = [*options, *(str(word) for pair in wires.items() for word in pair)]
        try:
            check(self._words)
        except SimulationError as error:
            raise SuiteError(str(error)) from None

    def bridge_parameters(self) -> dict[str, dict[str, Any]]:
        # Whatever config/nodes.yaml says of a real car's sensor: this one is the table's.
        bus = {"interface": "udp_multicast", "channel": self.channel, "steering_sign": 1, "steering_latency": 0.0}
        return bridge_parameters(self.vehicle, {"udp_port": self.port, "bind_address": "127.0.0.1"}, bus)

    def start(self, suite: Suite) -> float:
        """Start it and wait until data flow; returns how long they will [s].

        Raises SuiteError with its own words if they do not.
        """
        words = [*self._words, "--output", str(suite.folder / "truth")]
        leaf = suite.start("virtual_leaf", [find_executable("st_sim", "virtual_leaf"), *words])
        end = time.monotonic() + START_TIMEOUT
        while time.monotonic() < end and leaf.process.poll() is None:
            for line in leaf.log.read_text().splitlines():
                if '"sending"' in line:
                    return json.loads(line)["duration"]
            time.sleep(0.05)
        raise SuiteError(leaf.last_lines() or "the virtual Leaf did not start")
