"""Registers the reader of rosbag2 recordings: bag directories and single storage files."""

import json
from dataclasses import replace

from st_core.vehicle import VehicleParameters

from .. import bag
from ..bag_storage import EXTENSIONS
from ..ins_log import InsLog
from ..readers import Reader, register
from ..run_types import Label, LoadedRun, ReadSettings, RunSource


def read(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings) -> LoadedRun:
    steering = settings.steering if settings.steering and settings.steering.topic else None
    if steering is None and any(map(bag.may_need_can_frames, source.files)):
        from ..raw import read_raw_run

        return read_raw_run(source, vehicle, settings)
    drive = bag.read_bag(source.where, source.name, steering, settings.odometry, source.files)
    imported = json.loads(drive.records.get("import", {}).get("labels", "[]"))
    return replace(drive, labels=source.labels or tuple(Label(*entry) for entry in imported))


def read_ins(source: RunSource, settings: ReadSettings) -> InsLog:
    return bag.read_odometry(source.where, settings.odometry, source.files)


register(Reader("bag", "bag", EXTENSIONS, read, read_ins, is_folder=bag.is_bag, has_drive=bag.has_odometry,
                lacks_steering=bag.lacks_steering))
