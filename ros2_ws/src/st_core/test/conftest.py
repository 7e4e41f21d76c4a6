"""The two cars of config/vehicle."""

import pytest
from st_core.vehicle import VehicleParameters
from support import read_car


@pytest.fixture(scope="session")
def leaf() -> VehicleParameters:
    return read_car("leaf")


@pytest.fixture(scope="session", params=["leaf", "hyundai_genesis"])
def car(request) -> VehicleParameters:
    return read_car(request.param)
