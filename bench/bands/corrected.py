"""Corrects the vehicle file and the model of a car with `st discover`."""

from collections.abc import Sequence

from st_core.bands.error_budget import Intervals
from st_core.checks import check, pool_estimates
from st_core.discovery import DiscoverySettings, discover
from st_core.log import DriveLog
from st_core.model_file import ModelFile
from st_core.models import Model, get_model
from st_core.vehicle import VehicleParameters
from st_offline.bands.bands_report import collect_intervals
from st_offline.discovery.discover_command import build_model_file
from st_offline.discovery.drives import Drive, Request
from st_offline.discovery.vehicle_update import update_vehicle


def correct_files(logs: Sequence[DriveLog], vehicle: VehicleParameters) -> tuple[VehicleParameters, Model, Intervals]:
    """Vehicle, model and 95 % intervals of its parameters, from the files that `st discover` writes for these logs."""
    sensors = pool_estimates([check(log, vehicle).estimates for log in logs])
    settings = DiscoverySettings()
    discovery = discover(logs, vehicle, "nonlinear", (), settings, sensor_estimates=sensors)
    request = Request("nonlinear", vehicle, "the file", vehicle.to_yaml(), settings,
                      drives=[Drive(log.name, log, {"files": {}}) for log in logs])
    files = update_vehicle(discovery, request)
    if files is None:
        raise RuntimeError(f"st discover found no model: {discovery.outcome}")
    car = VehicleParameters.from_yaml(files.text) if files.text else vehicle
    model = build_model_file(discovery, request, files)
    if model is None:
        return car, get_model("nonlinear"), {}
    file = ModelFile.from_yaml(model.to_yaml())
    return car, file.model(), next(iter(collect_intervals([file]).values()))
