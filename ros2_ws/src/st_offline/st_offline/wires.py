"""What stands at the other end of the wires: parameters of the bridges for a real car, or for the virtual Leaf."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .paths import config, project_root
from .suite import Suite, SuiteError, find_executable, free_udp_port

START_TIMEOUT = 20.0  # s until the virtual Leaf sends


def bridge_parameters(
    vehicle: Path,
    ins: dict[str, Any],
    bus: dict[str, Any],
    dbc: Path | None = None,
    signals: Path | None = None,
) -> dict[str, dict[str, Any]]:
    """Parameters of both bridges. ins: of oxts_bridge; bus: interface and channel of canedge_bridge."""
    files = {
        "vehicle_file": str(vehicle),
        "dbc_file": str((dbc or config("can/leaf_ze0.dbc")).absolute()),
        "signals_file": str((signals or config("can/leaf_ze0.yaml")).absolute()),
    }
    # The raw frames go into the bag, so that it can be decoded again with another DBC.
    return {"oxts_bridge": ins, "canedge_bridge": {**bus, **files, "publish_frames": True}}


class VirtualCar:
    """The virtual Leaf on wires of its own: a free UDP port, and that port's CAN group on the loopback interface."""

    def __init__(self, vehicle: Path):
        self.vehicle = vehicle
        self.port = free_udp_port()
        self.channel = f"239.74.163.2:{self.port}"

    def bridge_parameters(self) -> dict[str, dict[str, Any]]:
        bus = {"interface": "udp_multicast", "channel": self.channel}
        return bridge_parameters(self.vehicle, {"udp_port": self.port, "bind_address": "127.0.0.1"}, bus)

    def start(self, suite: Suite, options: Sequence[str]) -> float:
        """Start it and wait until data flow; returns how long they will [s].

        Raises SuiteError with its own words if they do not.
        """
        wires = {
            "--vehicle": self.vehicle,
            "--config": project_root() / "config",
            "--ncom-port": self.port,
            "--can-interface": "udp_multicast",
            "--can-channel": self.channel,
            "--output": suite.folder / "truth",
        }
        words = [str(word) for pair in wires.items() for word in pair]
        leaf = suite.start("virtual_leaf", [find_executable("st_sim", "virtual_leaf"), *options, *words])
        end = time.monotonic() + START_TIMEOUT
        while time.monotonic() < end and leaf.process.poll() is None:
            for line in leaf.log.read_text().splitlines():
                if '"sending"' in line:
                    return json.loads(line)["duration"]
            time.sleep(0.05)
        raise SuiteError(leaf.last_lines() or "the virtual Leaf did not start")
