"""The virtual Leaf as a process of the suite, on a free UDP port and CAN group of the loopback interface."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from st_recordings.paths import project_root
from st_sim.run import check
from st_sim.settings import SimulationError

from .configuration import bridge_parameters
from .suite import Suite, SuiteError, find_executable, free_udp_port

START_TIMEOUT = 20.0  # s until the virtual Leaf sends


class VirtualCar:
    """The virtual Leaf and the bridge parameters for its interfaces.

    vehicle: file of bridges and nodes. options: of the command virtual_leaf, without those of the interfaces.
    simulated: vehicle file of the simulated car itself, by default the same. Raises SuiteError for refused options.
    """

    def __init__(self, vehicle: Path, options: Sequence[str], simulated: Path | None = None):
        self.vehicle = vehicle
        self.port = free_udp_port()
        self.channel = f"239.74.163.2:{self.port}"
        interfaces = {
            "--vehicle": simulated or self.vehicle,
            "--config": project_root() / "config",
            "--ncom-port": self.port,
            "--can-interface": "udp_multicast",
            "--can-channel": self.channel,
        }
        self._arguments = [*options, *(str(word) for pair in interfaces.items() for word in pair)]
        try:
            check(self._arguments)
        except SimulationError as error:
            raise SuiteError(str(error)) from None

    def bridge_parameters(self) -> dict[str, dict[str, Any]]:
        # config/nodes.yaml may describe the sensor of a real car; this one is that of the signal table.
        bus = {"interface": "udp_multicast", "channel": self.channel, "steering_sign": 1, "steering_latency": 0.0}
        return bridge_parameters(self.vehicle, {"udp_port": self.port, "bind_address": "127.0.0.1"}, bus)

    def start(self, suite: Suite) -> float:
        """Start it and wait until it sends; returns the duration of the drive [s].

        Raises SuiteError with its last output if it does not send.
        """
        arguments = [*self._arguments, "--output", str(suite.folder / "truth")]
        leaf = suite.start("virtual_leaf", [find_executable("st_sim", "virtual_leaf"), *arguments])
        end = time.monotonic() + START_TIMEOUT
        while time.monotonic() < end and leaf.process.poll() is None:
            for line in leaf.log.read_text().splitlines():
                if '"sending"' in line:
                    return json.loads(line)["duration"]
            time.sleep(0.05)
        raise SuiteError(leaf.last_lines() or "the virtual Leaf did not start")
