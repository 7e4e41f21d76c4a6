"""States, inputs, samples and trajectories, in SI units. Map frame: x east, y north. Body axes: x forward, y left. Yaw:
from east counter-clockwise.

Functions of angles, positions and samples accept floats or arrays and return the same type.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple, TypeAlias, get_origin, get_type_hints

import numpy as np

from .errors import StCoreError
from .ops import cos, sin

STATE_NAMES = ("x", "y", "velocity_x", "velocity_y", "yaw", "yaw_rate")
STATE_UNITS = ("m", "m", "m/s", "m/s", "rad", "rad/s")
Number: TypeAlias = Any  # a float or an array


@dataclass(frozen=True)
class Quantity:
    """Units and limits of one key of a vehicle file."""

    si_unit: str
    minimum: float  # limit in SI, inclusive
    maximum: float  # limit in SI, inclusive
    required: bool = True  # whether every vehicle file must contain the key
    other_units: Mapping[str, float] = field(default_factory=dict)  # further permitted units with their factor to SI

    @property
    def units(self) -> dict[str, float]:
        """Permitted units with their factor to SI."""
        return {self.si_unit: 1.0, **self.other_units}

    @property
    def limits(self) -> str:
        return f"{self.minimum:g} to {self.maximum:g} {self.si_unit}".removesuffix(" 1")

    def clip(self, value: float) -> float:
        return min(max(value, self.minimum), self.maximum)


def quantities_of(cls: type) -> dict[str, Quantity]:
    """The quantities of the fields that a class declares as Annotated[float, Quantity(...)], by name."""
    return {key: hint.__metadata__[0] for key, hint in get_type_hints(cls, include_extras=True).items()
            if get_origin(hint) is Annotated}


@dataclass(frozen=True, slots=True)
class VehicleState:
    """State of every model, at the centre of gravity (CG). The field order is the state order everywhere."""

    x: float  # position in the map frame [m]
    y: float  # position in the map frame [m]
    velocity_x: float  # body axes, forward [m/s]
    velocity_y: float  # body axes, left [m/s]
    yaw: float  # from map x (east) counter-clockwise, not wrapped [rad]
    yaw_rate: float  # positive in a left turn [rad/s]

    def as_tuple(self) -> tuple[float, ...]:
        """The six values as Python floats, in state order."""
        return tuple(float(getattr(self, name)) for name in STATE_NAMES)


@dataclass(frozen=True, slots=True)
class ControlInput:
    """Inputs of every model at one instant."""

    road_wheel_angle: float  # mean of the front wheels, positive to the left [rad]
    velocity_x_dot: float  # derivative of the forward velocity [m/s^2]


@dataclass(frozen=True, slots=True)
class InputSequence:
    """Inputs over a horizon, as in ControlInput, at 0, step/2, step, ... (half-step grid): 2 * steps + 1 values each.

    NaN: unknown; the states that depend on the input are NaN from this point on. signals: further signals that a model
    needs (`Model.signals`), by name, on the same grid.
    """

    road_wheel_angle: np.ndarray
    velocity_x_dot: np.ndarray
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def is_known_so_far(self) -> np.ndarray:
        """Mask: both inputs are known at a point and at all points before it."""
        return np.logical_and.accumulate(np.isfinite(self.road_wheel_angle) & np.isfinite(self.velocity_x_dot), axis=-1)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """States at 0, step, 2 step ... [s] after the start: `states` is (steps + 1, 6) float64, columns as STATE_NAMES."""

    step: float
    states: np.ndarray

    def __post_init__(self) -> None:
        if self.states.ndim != 2 or self.states.shape[1] != len(STATE_NAMES):
            raise StCoreError(f"states of a trajectory: shape {self.states.shape}, not (points, {len(STATE_NAMES)})")

    x = property(lambda self: self.states[:, 0])
    y = property(lambda self: self.states[:, 1])
    velocity_x = property(lambda self: self.states[:, 2])
    velocity_y = property(lambda self: self.states[:, 3])
    yaw = property(lambda self: self.states[:, 4])
    yaw_rate = property(lambda self: self.states[:, 5])

    @property
    def time(self) -> np.ndarray:
        """Time of each point after the start [s]."""
        return self.step * np.arange(len(self.states))


class InsSample(NamedTuple):
    """One measurement of the INS, at the INS point."""

    time_ns: int  # UTC nanoseconds since the Unix epoch
    x: float  # map frame [m]
    y: float  # map frame [m]
    yaw: float  # from east counter-clockwise, wrapped or not [rad]
    velocity_x: float  # body axes, forward [m/s]
    velocity_y: float  # body axes, left [m/s]
    yaw_rate: float  # positive in a left turn [rad/s]


def wrap_angle(angle: Number) -> Number:
    """The same angle in [-pi, pi) [rad]; NaN stays NaN."""
    return (angle + math.pi) % math.tau - math.pi


def body_to_map(x: Number, y: Number, yaw: Number) -> tuple[Number, Number]:
    """Map components of a body vector: rotation by yaw counter-clockwise."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return x * cosine - y * sine, x * sine + y * cosine


def map_to_body(x: Number, y: Number, yaw: Number) -> tuple[Number, Number]:
    """Forward and left components of a map vector: rotation by -yaw."""
    return body_to_map(x, y, -yaw)


def pose_errors(predicted_x: Number, predicted_y: Number, predicted_yaw: Number, x: Number, y: Number,
                yaw: Number) -> tuple[Number, Number, Number]:
    """Prediction errors (longitudinal [m], lateral [m], yaw [rad]) of the INS pose; NaN where it was not measured.

        (e_lon, e_lat) = R(-yaw_measured) (p_predicted - p_measured),  p at the INS point

    Source: paper, section on the comparison.
    """
    longitudinal, lateral = map_to_body(predicted_x - x, predicted_y - y, yaw)
    return longitudinal, lateral, wrap_angle(predicted_yaw - yaw)


def ins_to_cg(sample: InsSample, cg_to_ins_x: float, cg_to_ins_y: float = 0.0) -> VehicleState:
    """State at the CG of a rigid car from a measurement at the INS point.

        p_cg = p_ins - R(yaw) d,    v_x,cg = v_x,ins + r d_y,    v_y,cg = v_y,ins - r d_x

    d = (cg_to_ins_x, cg_to_ins_y) [m]: position of the INS point relative to the CG, positive forward and to the left.
    Source: paper, equation of the sensor offset, in which d has the opposite sign. Checked by: test_frames.py.
    """
    cosine, sine = cos(sample.yaw), sin(sample.yaw)
    return VehicleState(
        sample.x - cosine * cg_to_ins_x + sine * cg_to_ins_y, sample.y - sine * cg_to_ins_x - cosine * cg_to_ins_y,
        sample.velocity_x + sample.yaw_rate * cg_to_ins_y, sample.velocity_y - sample.yaw_rate * cg_to_ins_x,
        sample.yaw, sample.yaw_rate)


def cg_to_ins_position(x: Number, y: Number, yaw: Number, cg_to_ins_x: Number,
                       cg_to_ins_y: Number = 0.0) -> tuple[Number, Number]:
    """Position (x, y) of the INS point in the map frame [m], from the position of the CG [m] and yaw [rad]."""
    east, north = body_to_map(cg_to_ins_x, cg_to_ins_y, yaw)
    return x + east, y + north


def ins_to_cg_acceleration(acceleration_x: Number, acceleration_y: Number, yaw_rate: Number, yaw_acceleration: Number,
                           cg_to_ins_x: float, cg_to_ins_y: float = 0.0) -> tuple[Number, Number]:
    """Acceleration at the CG from the acceleration at the INS point [m/s^2], body axes.

        a_x,cg = a_x,ins + r^2 d_x + r_dot d_y,    a_y,cg = a_y,ins - r_dot d_x + r^2 d_y

    d as in `ins_to_cg`; yaw_rate r [rad/s], yaw_acceleration r_dot [rad/s^2].
    """
    return (acceleration_x + yaw_rate * yaw_rate * cg_to_ins_x + yaw_acceleration * cg_to_ins_y,
            acceleration_y - yaw_acceleration * cg_to_ins_x + yaw_rate * yaw_rate * cg_to_ins_y)
