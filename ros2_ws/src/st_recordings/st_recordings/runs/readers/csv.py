"""Tables: a whole drive in one CSV."""

from dataclasses import replace

from st_core.corrections import Correction
from st_core.vehicle import VehicleParameters

from .. import csv
from ..run_types import LoadedRun, ReadSettings, RunSource
from ._base import Reader, register


def read(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings) -> LoadedRun:
    yaw = source.settings.get("correct", {}).get("yaw", Correction())
    table = csv.read_csv(source.where, vehicle, source.settings.get("layout"), yaw.scale)
    about = {"reader": "csv", "columns": dict(table.columns)}
    return LoadedRun(replace(table.log, name=source.name), about, source.labels, table.warnings, extras=table.extras)


register(Reader("csv", "csv", (".csv",), read, holds_drive=csv.has_drive_columns, scales_yaw=True))
