"""Steering of other makes in a bag: one number of a topic of any known type, named by the user."""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from rosbags.typesys.store import Typestore

from .bag_storage import Storage, Topic
from .errors import RunError

# Of topics that the suite publishes itself, and of those that every ROS system has.
OURS = ("/ins/", "/vehicle/", "/can/", "/predictor/", "/evaluator/", "/identifier/", "/view/", "/tf", "/diagnostics",
        "/clock", "/rosout", "/parameter_events", "/events/")


@dataclass(frozen=True)
class SteeringField:
    """Where the steering angle is [rad, left +]. field: path in the message, as "drive.steering_angle".

    quantity: road (mean of the front wheels) or wheel (the hand wheel, offset not removed).
    """

    topic: str
    field: str = "data"
    quantity: Literal["road", "wheel"] = "road"


def unknown(topics: list[Topic], played: tuple[str, ...]) -> list[Topic]:
    """What a bag holds that is neither played nor of the suite."""
    return [t for t in topics if t.count and t.name not in played
            and not t.type_name.startswith("st_msgs/") and not t.name.startswith(OURS)]


def steering_topic(where: Any, topics: list[Topic], steering: SteeringField, store: Typestore) -> Topic:
    """The topic named. Raises RunError where it is not in the bag, empty, or of a type that is not known."""
    found = next((t for t in topics if t.name.lstrip("/") == steering.topic.lstrip("/") and t.count), None)
    if found is None:
        names = ", ".join(sorted(t.name for t in topics if t.count))[:300] or "no messages"
        raise RunError(where, f"--steering-topic: no message of {steering.topic} is in it; it has {names}",
                       "name one of them")
    if found.type_name not in store.fielddefs:
        raise RunError(where, f"--steering-topic: the type {found.type_name} of {found.name} is not known",
                       "known are the types of ROS 2 Jazzy")
    return found


def steering_value(where: Any, message: Any, steering: SteeringField) -> float:
    """The angle in a message [rad]. Raises RunError, naming the fields there are, where the path ends at no number."""
    value = message
    for part in steering.field.split("."):
        fields = [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("__")]
        if part not in fields:
            has = f"no {part!r}; it has {', '.join(fields)}" if fields else f"no {part!r}; nothing is below it"
            raise RunError(where, f"--steering-field: {steering.field!r} is not in {steering.topic}: {has}",
                           "give the path to one number, as drive.steering_angle")
        value = getattr(value, part)
    if isinstance(value, bool | str) or not isinstance(value, int | float | np.number):
        raise RunError(where, f"--steering-field: {steering.field!r} of {steering.topic} is not a number",
                       "give the path to one number, as drive.steering_angle")
    return float(value)


def stamp_of(message: Any, log_ns: int) -> int:
    """header.stamp [ns]; when the message was recorded where it has none, or it was left empty."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return (stamp.sec * 1_000_000_000 + stamp.nanosec if stamp else 0) or log_ns


def steering_columns(where: Any, storage: Storage, topic: Topic, steering: SteeringField,
                     store: Typestore) -> dict[str, np.ndarray]:
    """The fields of st_msgs/Steering, of a topic of another type. What is not measured is NaN. Raises RunError."""
    stamps, angles = [], []
    for log_ns, data in storage.timed(topic.name):
        try:
            message = store.deserialize_cdr(data, topic.type_name)
        except Exception as error:  # rosbags lets through what struct and numpy run into
            raise RunError(where, f"a message of {topic.name} is damaged ({type(error).__name__})",
                           "record it again, or mend the bag with `st recover`") from None
        stamps.append(stamp_of(message, log_ns))
        angles.append(steering_value(where, message, steering))
    values, missing = np.array(angles), np.full(len(angles), math.nan)
    wheel = steering.quantity == "wheel"
    # Of a hand wheel, the vehicle file makes the road wheels' angle (DriveLog.with_steering).
    return {"header.stamp": np.array(stamps, np.int64), "road_wheel_angle": values,
            "steering_wheel_angle": values if wheel else missing, "valid": np.isfinite(values)}
