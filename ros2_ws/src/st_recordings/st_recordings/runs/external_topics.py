"""Steering angle of any source: a number in a topic of any type, or a column of a table, named by the user."""

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
    """Where the steering angle is, in which unit and with which sign.

    topic: of a bag, "" for a table. field: path in its messages, as "drive.steering_angle"; column of a table.
    quantity: road (mean of the front wheels) or wheel (the hand wheel, offset not removed). unit: rad or deg; None for
    that in the heading of the column of a table, rad in a bag.
    sign: 1 where the number is positive to the left, -1 where to the right.
    """

    topic: str
    field: str = "data"
    quantity: Literal["road", "wheel"] = "road"
    unit: Literal["rad", "deg"] | None = None
    sign: int = 1

    @property
    def scale(self) -> float:
        """What the number is multiplied with to be in rad, left +."""
        return self.sign * (math.pi / 180.0 if self.unit == "deg" else 1.0)


def unknown(topics: list[Topic], played: tuple[str, ...]) -> list[Topic]:
    """Topics of a bag that are neither played nor of the suite."""
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
        raise RunError(where, f"--steering-topic: the type {found.type_name} of {found.name} is not known, and the bag "
                       "holds no definition of it", "record it as MCAP, which holds definitions")
    return found


def steering_value(where: Any, message: Any, steering: SteeringField) -> float:
    """The angle in a message [rad, left +].

    Raises RunError, naming the fields there are, where the path ends at no number.
    """
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
    return steering.scale * float(value)


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
        except Exception as error:  # rosbags raises whatever struct and numpy raise
            raise RunError(where, f"a message of {topic.name} is damaged ({type(error).__name__})",
                           "record it again, or repair the bag with `st recover`") from None
        stamps.append(stamp_of(message, log_ns))
        angles.append(steering_value(where, message, steering))
    values, missing = np.array(angles), np.full(len(angles), math.nan)
    wheel = steering.quantity == "wheel"
    # Of a hand wheel, the vehicle file makes the road wheels' angle (DriveLog.with_steering).
    return {"header.stamp": np.array(stamps, np.int64), "road_wheel_angle": values,
            "steering_wheel_angle": values if wheel else missing, "valid": np.isfinite(values)}
