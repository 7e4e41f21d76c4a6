"""Tables: a whole drive in one CSV, or its INS part with the CAN logs of the same drive."""

from dataclasses import replace

from st_core.corrections import Correction
from st_core.vehicle import VehicleParameters

from .. import csv
from ..columns import Layout
from ..csv_table import read_table
from ..ins_log import InsLog
from ..readers import Reader, register
from ..run_types import LoadedRun, ReadSettings, RunSource


def read(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings) -> LoadedRun:
    yaw = source.settings.get("correct", {}).get("yaw", Correction())
    table = csv.read_csv(source.where, vehicle, source.settings.get("layout"), yaw.scale, settings.steering)
    about = {"reader": "csv", "columns": dict(table.columns)}
    return LoadedRun(replace(table.log, name=source.name), about, source.labels, table.warnings,
                     auxiliary=table.auxiliary)


def read_ins(source: RunSource, settings: ReadSettings) -> InsLog:
    return csv.ins_of(read_table(source.where, source.settings.get("layout") or Layout()))


register(Reader("csv", "csv", (".csv",), read, read_ins, holds_drive=csv.has_drive_columns,
                lacks_steering=csv.lacks_steering, scales_yaw=True))
