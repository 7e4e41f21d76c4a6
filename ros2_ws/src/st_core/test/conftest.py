"""The two cars of config/vehicle, read as the nodes read them."""

import pytest
from st_core.vehicle import VehicleParameters
from support import ROOT


def read_car(name: str) -> VehicleParameters:
    path = ROOT / "config" / "vehicle" / f"{name}.yaml"
    return VehicleParameters.from_yaml(path.read_text(), str(path))


@pytest.fixture(scope="session")
def leaf() -> VehicleParameters:
    return read_car("leaf")


@pytest.fixture(scope="session", params=["leaf", "hyundai_genesis"])
def car(request) -> VehicleParameters:
    return read_car(request.param)
