"""Bands are not calibrated with a recording that contains the vehicle file of a different car."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_offline.bands.calibration_command import _check_recorded_car
from st_recordings.runs import LoadedRun, RunError, RunSource
from support import LEAF

CAR = VehicleParameters.from_yaml(LEAF.read_text())


def load_recording(vehicle: VehicleParameters) -> LoadedRun:
    time, zero = np.array([0, 1]), np.zeros(2)
    log = DriveLog("run", time, *[zero] * 6, time, zero)
    return LoadedRun(log, {"recorded": {"configuration": {"vehicle": vehicle.to_yaml()}}})


def test_recording_is_rejected_for_a_different_car_name_but_not_for_different_values():
    source = RunSource("run", "bag", (Path("bag"),))
    _check_recorded_car(source, load_recording(replace(CAR, mass=CAR.mass + 50.0)), CAR)
    with pytest.raises(RunError, match=r"is a drive of 'Another', but the vehicle file is for"):
        _check_recorded_car(source, load_recording(replace(CAR, name="Another")), CAR)
