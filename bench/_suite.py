"""The live suite under measurement: all nodes and the virtual Leaf at full rates, on a domain of its own."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from st_offline.node import Monitor
from st_offline.paths import config
from st_offline.session import NODES, node_parameters, wait_until_sending
from st_offline.suite import Suite, find_executable, free_domain_id, free_udp_port


@contextmanager
def running_suite(
    duration: float, ncom_rate: int = 250, can_rate: str = "full", scenario: str = "S6"
) -> Iterator[Suite]:
    """Nodes up and data flowing; everything ended and deleted afterwards."""
    with tempfile.TemporaryDirectory(prefix="st-bench-") as name:
        folder = Path(name)
        vehicle, port, domain = config("vehicle/leaf.yaml"), free_udp_port(), free_domain_id()
        channel = f"239.74.{100 + port % 60}.{1 + port // 60 % 254}"
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        parameters = node_parameters(folder, vehicle, {
            "oxts_bridge": {"udp_port": port},
            "canedge_bridge": {
                "interface": "udp_multicast", "channel": channel, "vehicle_file": str(vehicle),
                "dbc_file": str(config("can/leaf_ze0.dbc")), "signals_file": str(config("can/leaf_ze0.yaml")),
            },
        })  # fmt: skip
        with Suite(folder, parameters, domain) as suite:
            for package, executable in NODES:
                suite.start_node(package, executable)
            with Monitor(domain) as monitor:
                missing = monitor.wait_for_nodes({e for _, e in NODES}, 30)
            if missing:
                raise RuntimeError(f"nodes not up: {missing}")
            leaf = suite.start("virtual_leaf", [
                find_executable("st_sim", "virtual_leaf"), "--scenario", scenario, "--vehicle", str(vehicle),
                "--duration", str(duration), "--ncom-port", str(port), "--ncom-rate", str(ncom_rate),
                "--can-interface", "udp_multicast", "--can-channel", channel, "--can-rate", can_rate,
                "--output", str(folder / "truth"),
            ])  # fmt: skip
            wait_until_sending(leaf)
            yield suite
