"""Racelogic VBOX files, alone or with the CAN logs of the same drive."""

from dataclasses import replace

from st_core.corrections import Correction
from st_core.vehicle import VehicleParameters

from ..columns import Layout
from ..ins_log import InsLog
from ..readers import Reader, register
from ..run_types import LoadedRun, ReadSettings, RunSource


def read(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings) -> LoadedRun:
    from .. import csv, vbo

    yaw = source.settings.get("correct", {}).get("yaw", Correction())
    layout = csv.with_steering(source.settings.get("layout") or Layout(), settings.steering)
    table = vbo.read_vbo(source.where, layout)
    drive = csv.drive_of(table, vehicle, yaw.scale, settings.steering)
    about = {"reader": "vbo", "columns": dict(drive.columns)}
    return LoadedRun(replace(drive.log, name=source.name), about, source.labels, drive.warnings,
                     auxiliary=drive.auxiliary)


def read_ins(source: RunSource, settings: ReadSettings) -> InsLog:
    from .. import csv, vbo

    return csv.ins_of(vbo.read_vbo(source.where, source.settings.get("layout") or Layout()))


register(Reader("vbo", "vbo", (".vbo",), read, read_ins, scales_yaw=True))
