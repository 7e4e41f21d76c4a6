"""The live suite under measurement: all nodes and the virtual Leaf at full rates, on a domain of its own."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from _drawn_bands import drawn_bands
from st_core.vehicle import VehicleParameters
from st_live.bands import with_bands
from st_live.node import Monitor
from st_live.session import NODES, node_parameters
from st_live.suite import Suite, claimed_domain
from st_live.wires import VirtualCar
from st_recordings.paths import config


@contextmanager
def running_suite(duration: float, ncom_rate: int = 250, can_rate: str = "full",
                  bands: bool = False) -> Iterator[Suite]:
    """Nodes up and data flowing; everything ended and deleted afterwards. bands: around every prediction."""
    with claimed_domain() as domain, tempfile.TemporaryDirectory(prefix="st-bench-") as name:
        rates = ["--ncom-rate", str(ncom_rate), "--can-rate", can_rate]
        car = VirtualCar(config("vehicle/leaf.yaml"), ["--scenario", "S6", "--duration", str(duration), *rates])
        folder = Path(name)
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        parameters = node_parameters(folder, car.vehicle, car.bridge_parameters())
        if bands:
            file = folder / "bands.yaml"
            vehicle = VehicleParameters.from_yaml(car.vehicle.read_text(), str(car.vehicle))
            file.write_text(drawn_bands(vehicle).to_yaml(), encoding="utf-8")
            parameters = with_bands(parameters, file)
        with Suite(folder, parameters, domain) as suite:
            for package, executable in NODES:
                suite.start_node(package, executable)
            with Monitor(domain) as monitor:
                missing = monitor.wait_for_nodes({executable for _, executable in NODES}, 30)
            if missing:
                raise RuntimeError(f"nodes not up: {missing}")
            car.start(suite)
            yield suite
