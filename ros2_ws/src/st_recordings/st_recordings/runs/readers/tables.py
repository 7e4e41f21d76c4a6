"""Registers the readers of tables (CSV, MDF, MATLAB, HDF5, Arrow, VBOX) of a drive or, with CAN logs, of the INS."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from st_core.corrections import Correction
from st_core.log import INS_SIGNALS
from st_core.vehicle import VehicleParameters

from .. import csv
from ..binary_table import BINARY_EXTENSIONS
from ..columns import Layout
from ..csv_table import Table, join_tables, read_table
from ..ins_log import InsLog
from ..mf4 import MF4_EXTENSIONS
from ..run_types import LoadedRun, ReadSettings, RunSource
from ..vbo import lacks_steering, read_vbo
from . import Reader, register


def _get_yaw_scale(source: RunSource) -> float:
    return source.settings.get("correct", {}).get("yaw", Correction()).scale


def register_table(kind: str, extensions: tuple[str, ...], read_file: Callable[[Path, Layout], Table],
                   **tests: Callable[[Path], bool]) -> None:
    """Adds a kind of table. kind: also its key in a run.yaml. read_file: reads one file. tests: fields of `Reader`."""
    def read_and_join(source: RunSource, layout: Layout) -> Table:
        return join_tables([read_file(file, layout) for file in source.files])

    def read(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings) -> LoadedRun:
        layout = csv.add_steering_column(source.settings.get("layout") or Layout(), settings.steering)
        run = csv.build_drive(read_and_join(source, layout), vehicle, _get_yaw_scale(source), settings.steering)
        return replace(run, log=replace(run.log, name=source.name), labels=source.labels,
                       provenance={"reader": kind, **run.provenance})

    def read_ins(source: RunSource, settings: ReadSettings) -> InsLog:
        table = read_and_join(source, source.settings.get("layout") or Layout())
        required = csv.MOTION_SIGNALS if settings.for_alignment else INS_SIGNALS
        return csv.build_ins_log(table, required, _get_yaw_scale(source))

    register(Reader(kind, kind, extensions, read, read_ins, is_table=True, **tests))


register_table("csv", (".csv", ".tsv", ".txt", ".dat", ".lvm", *MF4_EXTENSIONS, *BINARY_EXTENSIONS), read_table,
               has_drive=lambda file: not csv.find_missing_in_header(file),
               # It contains a position, and lacks at most one INS channel.
               is_incomplete=lambda file: not {"x", "y"} & {*(missing := csv.find_missing_in_header(
                   file, INS_SIGNALS, with_derived_motion=False))} and len(missing) <= 1,
               lacks_steering=lambda file: csv.find_missing_in_header(file) == [csv.ROAD_WHEEL])
register_table("vbo", (".vbo",), read_vbo, lacks_steering=lacks_steering)
