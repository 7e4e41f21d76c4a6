"""rosbag2 recordings: folders, and bare files of one."""

import json
from collections.abc import Mapping
from typing import Any

from st_core.vehicle import VehicleParameters

from .. import bag
from ..bag_storage import EXTENSIONS
from ..ins_log import InsLog
from ..readers import Reader, register
from ..run_types import Label, LoadedRun, ReadSettings, RunSource


def read(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings) -> LoadedRun:
    steering = settings.steering if settings.steering and settings.steering.topic else None
    splits = source.files if len(source.files) > 1 else ()
    drive = bag.read_bag(source.where, source.name, steering, settings.odometry, splits)
    recorded = {name: dict(record) for name, record in drive.records.items()}
    about: dict[str, Any] = {"reader": "bag", "topics": dict(drive.topics), "recorded": recorded}
    if drive.origin is not None:
        about["origin"] = list(drive.origin)
    labels = source.labels or _recorded_labels(drive.records)
    return LoadedRun(drive.log, about, labels, drive.warnings, auxiliary=drive.auxiliary)


def read_ins(source: RunSource, settings: ReadSettings) -> InsLog:
    return bag.read_odometry(source.where, settings.odometry)


def _recorded_labels(records: Mapping[str, Mapping[str, str]]) -> tuple[Label, ...]:
    """Labels of an imported run."""
    return tuple(Label(*entry) for entry in json.loads(records.get("import", {}).get("labels", "[]")))


register(Reader("bag", "bag", EXTENSIONS, read, read_ins, is_folder=bag.is_bag, holds_drive=bag.holds_odometry,
                lacks_steering=bag.lacks_steering))
