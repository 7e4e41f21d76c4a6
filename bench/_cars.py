"""Vehicle files of the virtual Leaf and of the Genesis, and the real drives of the Genesis."""

import os
from pathlib import Path

from st_core.vehicle import VehicleParameters
from st_recordings.car import read_vehicle
from st_recordings.paths import config, project_root

LEAF_FILE, GENESIS_FILE = config("car/leaf/vehicle.yaml"), config("car/hyundai_genesis/vehicle.yaml")
DATA = Path(os.environ.get("ST_SHARED", project_root().parent / "shared")) / "data"
"""Folder of the real drives, which are not part of the repository."""
SOUND_DRIVES, OTHER_DRIVES = DATA / "hyundai_genesis_oxts", DATA / "hyundai_genesis_more"
"""Nine drives without a known fault, and other drives, most of them with a fault of known cause."""


def leaf() -> VehicleParameters:
    return read_vehicle(LEAF_FILE)


def genesis() -> VehicleParameters:
    return read_vehicle(GENESIS_FILE)
