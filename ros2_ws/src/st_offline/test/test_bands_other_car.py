"""A recording says which car drove; bands are not learnt from another one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_offline.bands.calibration_command import _refuse_other_car
from st_recordings.runs import LoadedRun, RunError, RunSource
from support import ROOT

LEAF = VehicleParameters.from_yaml((ROOT / "config" / "vehicle" / "leaf.yaml").read_text())


def recorded(vehicle: VehicleParameters) -> LoadedRun:
    time, zero = np.array([0, 1]), np.zeros(2)
    log = DriveLog("run", time, *[zero] * 6, time, zero)
    return LoadedRun(log, {"recorded": {"configuration": {"vehicle": vehicle.to_yaml()}}})


def test_a_recording_of_a_car_of_another_name_is_refused_and_one_with_other_values_is_not():
    source = RunSource("run", "bag", (Path("bag"),))
    _refuse_other_car(source, recorded(replace(LEAF, mass=LEAF.mass + 50.0)), LEAF)
    with pytest.raises(RunError, match=r"is a drive of 'Another', but the vehicle file is for"):
        _refuse_other_car(source, recorded(replace(LEAF, name="Another")), LEAF)
