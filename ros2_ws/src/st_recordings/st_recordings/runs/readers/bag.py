"""Registers the reader of bags: directories and single storage files of rosbag2, and files of ROS 1."""

import json
import re
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal

from st_core.vehicle import VehicleParameters

from .. import bag
from ..bag_storage import EXTENSIONS, ROS1_EXTENSION, open_bag
from ..cdr import CAN_FRAMES, STEERING
from ..errors import RunError, log_warnings
from ..ins_log import InsLog
from ..readers import Reader, register
from ..run_types import Label, LoadedRun, ReadSettings, RunSource, SteeringField

_COMMAND = re.compile(r"(?i)cmd|command|target|desired|setpoint|reference")
_COMMAND_TOPIC = re.compile(_COMMAND.pattern + r"|control|ackermann|\bdrive\.steering_angle")
_MEASUREMENT = re.compile(r"(?i)state|status|feedback|report|measure|actual")
_STEERING_NAME = re.compile("(?i)steer|ackermann")  # SystemRptFloat may also be an accelerator or a brake
# Type -> field, quantity and unit of the steering angle, positive to the left. Sources: definitions of these packages.
_STEERING_TYPES: dict[str, tuple[str, Literal["road", "wheel"], Literal["rad", "deg"]]] = {
    **dict.fromkeys(("autoware_vehicle_msgs/msg/SteeringReport", "autoware_auto_vehicle_msgs/msg/SteeringReport"),
                    ("steering_tire_angle", "road", "rad")),
    **{f"dbw_{car}_msgs/msg/SteeringReport": ("steering_wheel_angle", "wheel", "rad") for car in (
        "mkz", "fca", "polaris")},
    "raptor_dbw_msgs/msg/SteeringReport": ("steering_wheel_angle", "wheel", "deg"),
    **dict.fromkeys(("pacmod_msgs/msg/SystemRptFloat", "pacmod3_msgs/msg/SystemRptFloat"), ("output", "wheel", "rad")),
    "ackermann_msgs/msg/AckermannDriveStamped": ("drive.steering_angle", "road", "rad")}


def read(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings) -> LoadedRun:
    steering, warning = settings.steering if settings.steering and settings.steering.topic else None, ""
    report = _find_steering(source.path, source.files) if steering is None and vehicle is not None else None
    if steering is None and bag.may_need_can_frames(source.path, source.files):
        from ..raw import read_raw_run

        with suppress(RunError) if report else nullcontext():
            return read_raw_run(source, vehicle, settings)
    if report is not None:
        steering, warning = report, _describe(report)
    elif steering is not None and _is_command(steering):
        warning = (f"{steering.topic} or its field {steering.field} is named like a command, which the car follows "
                   "with a delay; name a measured steering angle with --steering-topic")
    run = _read_bag(source, vehicle, settings, steering)
    return replace(run, warnings=(*run.warnings, f"{source.path}: {warning}")) if warning else run


def add_steering(path: Path, settings: ReadSettings) -> ReadSettings:
    """Settings of a replay, with the steering report that `_find_steering` selects; logs a warning about it.

    Unchanged if they name a steering topic or field, or the bag may need its CAN frames (see `read`)."""
    if settings.steering is not None or bag.may_need_can_frames(path) or (steering := _find_steering(path)) is None:
        return settings
    log_warnings([f"{path}: {_describe(steering)}"])
    return replace(settings, steering=steering)


def _describe(steering: SteeringField) -> str:
    return (f"the steering angle is {steering.field} of {steering.topic}, positive to the left as defined for its type "
            f"(--steering-is {steering.quantity}, --steering-unit {steering.unit}); --steering-topic selects another")


def _find_steering(path: Path, files: Sequence[Path] = ()) -> SteeringField | None:
    """The steering angle in the only topic with a type in _STEERING_TYPES that is not a command; None if there is not
    exactly one, or if the bag contains st_msgs/Steering or CAN frames or cannot be read."""
    with suppress(RunError):
        storage = open_bag(path, files)
        known_types = _STEERING_TYPES.keys() & {*storage.store.fielddefs, *storage.definitions()}
        fields = [SteeringField(topic.name, *_STEERING_TYPES[topic.type_name]) for topic in storage.topics
                  if topic.type_name in known_types and _STEERING_NAME.search(f"{topic.name} {topic.type_name}")]
        measured = [field for field in fields if not _is_command(field)]
        return measured[0] if len(measured) == 1 and not {STEERING, CAN_FRAMES} & storage.by_type.keys() else None
    return None


def _is_command(steering: SteeringField) -> bool:
    """Whether topic or field has the name of a command, such as /control/command, but not /controller/state."""
    topic = steering.topic.rpartition("/")[2]
    return bool(_COMMAND.search(steering.field) or (
        _COMMAND_TOPIC.search(f"{steering.topic} {steering.field}") and not _MEASUREMENT.search(topic)))


def _read_bag(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings,
              steering: SteeringField | None) -> LoadedRun:
    if bag.lacks_odometry(source.path, source.files, settings.odometry):
        from ..bag_table import read_bag_as_table

        run = read_bag_as_table(source.path, vehicle, steering, source.files, settings.odometry)
        if run is not None:
            return replace(run, log=replace(run.log, name=source.name), labels=source.labels, provenance={
                **run.provenance, "reader": "bag", "recorded": bag.read_metadata_records(source.path)})
    drive = bag.read_bag(source.path, source.name, steering, settings.odometry, source.files)
    recorded_labels = json.loads(drive.records.get("import", {}).get("labels", "[]"))
    return replace(drive, labels=source.labels or tuple(Label(*entry) for entry in recorded_labels))


def read_ins(source: RunSource, settings: ReadSettings) -> InsLog:
    return bag.read_odometry(source.path, settings.odometry, source.files)


def has_drive(path: Path) -> bool:
    """Whether a bag may contain a drive: in odometry, or in other messages that contain every INS channel."""
    if bag.has_odometry(path):
        return True
    from ..bag_table import has_ins_channels

    return bag.lacks_odometry(path) and has_ins_channels(path)


register(Reader("bag", "bag", (*EXTENSIONS, ROS1_EXTENSION), read, read_ins, is_folder=bag.is_bag,
                has_drive=has_drive, lacks_steering=bag.lacks_steering))
