"""Names, axes and signs of relations in terms of vehicle dynamics."""

from collections.abc import Iterable

from st_core.relations import Candidate
from st_core.vehicle import VehicleParameters

PLACES = {
    "front_steer": "steering of the front wheels", "rear_steer": "steering of the rear wheels",
    "front_force": "lateral force of the front axle", "rear_force": "lateral force of the rear axle",
    "front_grip": "grip of the front axle", "rear_grip": "grip of the rear axle", "both_grip": "grip of both axles",
    "yaw_moment": "yaw moment on the body", "side_force": "side force on the body",
    "sensor_yaw_rate": "error of the yaw rate sensor", "sensor_acceleration_y": "error of the lateral accelerometer",
    "sensor_velocity_y": "error of the lateral velocity of the INS",
    "sensor_heading": "error of the heading of the INS",
}
AXES = {
    "front_steer": "front wheels turned further to the left by", "rear_steer": "rear wheels turned to the left by",
    "front_force": "lateral force of the front axle, to the left, divided by its static load",
    "rear_force": "lateral force of the rear axle, to the left, divided by its static load",
    "front_grip": "lateral force of the front axle larger by", "rear_grip": "lateral force of the rear axle larger by",
    "both_grip": "lateral force of both axles larger by",
    "yaw_moment": "yaw moment to the left, divided by the yaw inertia",
    "side_force": "side force to the left, divided by the mass", "sensor_yaw_rate": "yaw rate is shown too large by",
    "sensor_acceleration_y": "lateral acceleration is shown too large by",
    "sensor_velocity_y": "lateral velocity is shown too large by", "sensor_heading": "heading is shown too large by",
}
"""The vertical axis of the curve; left +."""
QUANTITIES = {
    "slip_front": "slip angle of the front axle", "slip_rear": "slip angle of the rear axle",
    "steering": "road-wheel angle", "acceleration_y": "lateral acceleration", "acceleration_x": "forward acceleration",
    "speed": "speed", "yaw_rate": "yaw rate", "steering_rate": "rate of the road-wheel angle",
    "lagging_steering": "road-wheel angle, lagging by 0.2 s",
    "lean": "lateral acceleration, lagging by 0.15 s as the body rolls", "north": "sine of the course",
    "east": "cosine of the course", "position_x": "position to the east", "position_y": "position to the north",
    "run_time": "time in the run",
}
SIGNS = {"acceleration_x": " (derivative of the forward speed, also where a bend slows the car; braking −)",
         "steering": " (left +)", "lagging_steering": " (left +)",
         "acceleration_y": " (left +)", "lean": " (left +)", "yaw_rate": " (left +)",
         "steering_rate": " (to the left +)", "slip_front": " (axle moving to its left +)",
         "slip_rear": " (axle moving to its left +)"}
"""Positive direction of a quantity."""
SHAPES = {"linear": "in proportion", "straight line": "straight line with an offset"}
"""Longer names of shapes."""


def place(c: Candidate) -> str:
    return PLACES[c.place]


def quantity(c: Candidate) -> str:
    return QUANTITIES[c.quantity]


def axis(c: Candidate) -> str:
    """Label of the vertical axis."""
    return f"{AXES[c.place]}{f', for each unit of {QUANTITIES[c.by]}' if c.by else ''}"


def in_newtons(c: Candidate, vehicle: VehicleParameters) -> str:
    """y as a force or moment of that car; "" for other places."""
    sizes = {"yaw_moment": f"1 rad/s² is a moment of {vehicle.yaw_inertia:.4g} N m, by the yaw inertia",
             "side_force": f"1 m/s² is a force of {vehicle.mass:.4g} N, by the mass",
             "front_force": f"1 is a force of {2.0 * vehicle.static_tyre_load_front:.4g} N, by the axle load",
             "rear_force": f"1 is a force of {2.0 * vehicle.static_tyre_load_rear:.4g} N, by the axle load"}
    return f"y = {sizes[c.place]} of the vehicle file" if c.place in sizes and not c.by else ""


def title(c: Candidate, constant: bool = False) -> str:
    by = f", for each {QUANTITIES[c.by]}" if c.by else ""
    if constant:
        return f"{place(c)}{by}, the same at every {quantity(c)}"
    return f"{place(c)}{by}, as a function of the {quantity(c)}"


def named(name: str) -> str:
    """A relation by `Candidate.name`, written out."""
    where, _, rest = name.partition(" over ")
    what, _, by = rest.partition(" times ")
    if where not in PLACES or what not in QUANTITIES:
        return name
    return f"{PLACES[where]} as a function of the {QUANTITIES[what]}" + (f" times {QUANTITIES[by]}" if by else "")


def in_words(text: str, names: Iterable[str]) -> str:
    """A sentence with the names of relations written out."""
    for name in sorted(names, key=len, reverse=True):  # the name of one may begin with that of another
        text = text.replace(name, named(name))
    return text
