"""Twelve relations outside the library, and six effects removed from it: how each is hidden, where it acts, its shape.

Relations of the car change its equations (`relation_equations`, or a setting of the plant); those between steering
sensor and wheels, or in another sensor, change the recording.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters

from ..plants import relation_equations
from ..plants.leaf import NO_RELATION
from ..plants.record import LEAF
from ..plants.relation_equations import Relation

FRONT, REAR = ("front_force", "front_grip"), ("rear_force", "rear_grip", "rear_steer")
GRIP = ("both_grip", "front_grip", "rear_grip", "front_force", "rear_force")
AXLES = ("front axle", "rear axle", "both axles")
Change = Callable[[DriveLog, VehicleParameters, float], DriveLog]


def _add_kink(log: DriveLog, vehicle: VehicleParameters, size: float) -> DriveLog:
    """Above 0.04 rad, the wheels turn by the fraction `size` more than recorded."""
    true, edge = log.road_wheel_angle, 0.04
    beyond = np.maximum(np.abs(true) - edge, 0.0)
    angle = np.sign(true) * (np.minimum(np.abs(true), edge) + beyond / (1.0 + size))
    return replace(log, road_wheel_angle=angle, steering_wheel_angle=vehicle.steering_wheel_angle(angle))


def _add_growing_delay(log: DriveLog, vehicle: VehicleParameters, size: float) -> DriveLog:
    """The wheels lag behind the recorded angle by 0.06 s at 10 m/s, and by `size` [s] more for each m/s."""
    time = log.steering_time_ns * 1e-9
    speed = np.interp(log.steering_time_ns.astype(float), log.ins_time_ns.astype(float), log.velocity_x)
    angle = np.interp(time + 0.06 + size * (speed - 10.0), time, log.road_wheel_angle)
    return replace(log, road_wheel_angle=angle, steering_wheel_angle=vehicle.steering_wheel_angle(angle))


def _add_g_sensitivity(log: DriveLog, vehicle: VehicleParameters, size: float) -> DriveLog:
    return replace(log, yaw_rate=log.yaw_rate + size * log.acceleration_y)


@dataclass(frozen=True)
class Hidden:
    """A hidden relation, or a hidden effect that is removed from the library."""

    name: str
    places: tuple[str, ...]  # correct places of a proposal
    shapes: tuple[str, ...]  # correct shapes of its first formula; empty if none is correct
    slots: tuple[str, ...]  # slots of the library in which it acts
    settings: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))  # added to those of the plant
    relation: Relation = NO_RELATION  # change of the equations
    change: Change | None = None  # change of the recording, with its size
    size: float = 0.0
    # For the multi-body cars, in place of settings that only the virtual Leaf has.
    multibody_relation: Relation | None = None
    removed: str = ""  # effect that is removed from the library, together with similar ones

    def relation_in(self, plant: str) -> Relation:
        return self.relation if plant == LEAF or self.multibody_relation is None else self.multibody_relation

    def settings_in(self, plant: str) -> Mapping[str, float]:
        return self.settings if plant == LEAF or self.multibody_relation is None else {}


STRAIGHT = ("linear", "straight line")
RELATIONS = (
    Hidden("rear roll steer", REAR, ("linear",), AXLES, {"rear_roll_steer": 0.25},
           multibody_relation=Relation(relation_equations.REAR_STEER, 0.0012)),
    Hidden("camber thrust", (*FRONT, *REAR, "side_force"), ("linear",), (*AXLES, "body"), {"camber_thrust": 1.0},
           multibody_relation=Relation(relation_equations.CAMBER, 0.06)),
    Hidden("steering map with a kink", ("front_steer",), ("dead zone",), ("steering", "front axle"), change=_add_kink,
           size=0.25),
    Hidden("rear axle with another curve", REAR, ("cubic", "linear and cubic", "dead zone", "square"),
           ("rear axle", "both axles"), relation=Relation(relation_equations.REAR_CURVE, 0.3)),
    Hidden("lift of the front axle with v^2", FRONT, ("square", *STRAIGHT), ("front axle", "both axles"),
           relation=Relation(relation_equations.LIFT, 0.0012)),
    Hidden("gusts", ("side_force", "yaw_moment"), (), ("body",), {"gust_speed": 10.0}),
    Hidden("friction patch", GRIP, (), AXLES, {"friction_patch": -0.4}),
    Hidden("aerodynamic yaw moment with v^2", ("yaw_moment",), ("square", *STRAIGHT), ("body",),
           relation=Relation(relation_equations.AIR_MOMENT, 0.0006)),
    Hidden("torque steer with a_x", ("yaw_moment",), STRAIGHT, ("body", "front axle"),
           relation=Relation(relation_equations.TORQUE_STEER, 0.05)),
    Hidden("gyroscope with g-sensitivity", ("sensor_yaw_rate",), ("linear",), ("yaw rate",), change=_add_g_sensitivity,
           size=0.004),
    Hidden("steering delay that grows with speed", ("front_steer",), STRAIGHT, ("steering",), change=_add_growing_delay,
           size=0.012),
    Hidden("tyres that warm up", GRIP, ("saturating", "inverse", *STRAIGHT), AXLES,
           relation=Relation(relation_equations.WARM_UP, 0.25)),
)
"""Units of the sizes, in this order (setting and relation): 1 and rad s^2/m; 1 and 1; 1; 1; s^2/m^2; m/s; 1; rad/m^2;
rad/m; rad s/m; s^2/m; 1."""
REMOVED = (
    Hidden("steering lag", ("front_steer",), ("linear",), ("steering",), {"steering_lag": 0.08},
           removed="steering_lag"),
    Hidden("yaw rate scale", ("sensor_yaw_rate",), ("linear",), ("yaw rate",), {"yaw_rate_scale": 0.05},
           removed="yaw_rate_scale"),
    Hidden("heading misalignment", ("sensor_velocity_y", "sensor_heading"), ("linear", "constant"),
           ("heading", "velocity"), {"ins_misalignment": 0.01}, removed="heading_misalignment"),
    Hidden("lever arm", ("sensor_velocity_y",), ("linear",), ("position", "velocity"), {"ins_lever_error": 0.3},
           removed="sensor_lever_arm"),
    Hidden("road bank", ("side_force",), ("constant",), ("body",), {"bank_angle": 0.03}, removed="road_bank"),
    Hidden("steering offset", ("front_steer", "yaw_moment"), ("constant",), ("steering", "front axle", "body"),
           {"steering_offset": 0.008}, removed="steering_offset"),
)
BY_NAME = {hidden.name: hidden for hidden in (*RELATIONS, *REMOVED)}
