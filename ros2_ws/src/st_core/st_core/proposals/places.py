"""Where a law may act and what it may depend on."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..discovery.windows import Windows
from ..effects._law import COUNT, INTERVALS, PLACES, bump
from ..vehicle import VehicleParameters

ODD, NEITHER = -1.0, 0.0
EDGE = 0.01  # share of the driving beyond either end of the range: the curve is constant there
SLOWEST = 2.0  # m/s; slip angles are not defined below
QUANTITIES = {"slip_front": "rad", "slip_rear": "rad", "steering": "rad", "acceleration_y": "m/s^2",
              "acceleration_x": "m/s^2", "speed": "m/s", "yaw_rate": "rad/s"}
USUAL = {"front_steer": 0.005, "rear_steer": 0.005, "front_force": 0.02, "rear_force": 0.02, "front_grip": 0.1,
         "rear_grip": 0.1, "yaw_moment": 0.05, "side_force": 0.1, "sensor_yaw_rate": 0.005,
         "sensor_acceleration_y": 0.2, "sensor_velocity_y": 0.05, "sensor_heading": 0.005}
"""Usual size of a law, by place, in its unit."""
ASKED: Mapping[str, tuple[tuple[str, float], ...]] = {
    "front_steer": (("steering", ODD), ("acceleration_y", ODD), ("speed", NEITHER), ("acceleration_x", NEITHER)),
    "rear_steer": (("acceleration_y", ODD), ("steering", ODD), ("speed", NEITHER), ("acceleration_x", NEITHER)),
    "front_force": (("slip_front", ODD),),
    "rear_force": (("slip_rear", ODD),),
    "front_grip": (("speed", NEITHER), ("acceleration_x", NEITHER)),
    "rear_grip": (("speed", NEITHER), ("acceleration_x", NEITHER)),
    "yaw_moment": (("yaw_rate", ODD), ("acceleration_y", ODD), ("speed", NEITHER), ("acceleration_x", NEITHER)),
    "side_force": (("acceleration_y", ODD), ("speed", NEITHER), ("acceleration_x", NEITHER)),
    "sensor_yaw_rate": (("acceleration_y", ODD), ("yaw_rate", ODD), ("speed", NEITHER)),
    "sensor_acceleration_y": (("acceleration_y", ODD), ("speed", NEITHER)),
    "sensor_velocity_y": (("yaw_rate", ODD), ("acceleration_y", ODD), ("speed", NEITHER)),
    "sensor_heading": (("acceleration_y", ODD), ("speed", NEITHER)),
}
"""What a law at each place may depend on, and whether left and right are mirror images there."""


@dataclass(frozen=True)
class Candidate:
    """place: of PLACES; quantity: of QUANTITIES; parity -1 for an odd curve, 0 for any. low, high: range driven [unit
    of the quantity]."""

    place: str
    quantity: str
    parity: float
    low: float
    high: float

    @property
    def name(self) -> str:
        return f"{self.place} over {self.quantity}"

    @property
    def changes_sides(self) -> bool:
        """Whether its mirror image has the other sign: a push to one side whichever way the car turns."""
        return self.parity == NEITHER and not self.place.endswith("_grip")

    @property
    def constants(self) -> dict[str, float]:
        """Of the effect `law`."""
        return {"low": self.low, "spacing": (self.high - self.low) / INTERVALS, "parity": self.parity,
                f"in_{self.quantity}": 1.0, f"to_{self.place}": USUAL[self.place]}

    def splines(self, u: np.ndarray) -> np.ndarray:
        """(COUNT, ...) what each coefficient adds at u [unit of the place]."""
        t, s = ((np.clip(v, self.low, self.high) - self.low) * INTERVALS / (self.high - self.low) for v in (u, -u))
        return USUAL[self.place] * np.stack([bump(t - k) + self.parity * bump(s - k) for k in range(-1, COUNT - 1)])


def driven(windows: Windows, vehicle: VehicleParameters) -> dict[str, np.ndarray]:
    """Every quantity at the samples of the INS, where the car is not nearly standing; slip angles as measured."""
    log = windows.joined
    moving = log.velocity_x > SLOWEST
    speed, rate = log.velocity_x[moving], log.yaw_rate[moving]
    time, steered = log.ins_time_ns[moving].astype(float), log.steering_time_ns.astype(float)
    angle = np.interp(time, steered, log.road_wheel_angle)
    across = log.velocity_y[moving] - vehicle.cg_to_ins_x * rate
    return {"slip_front": (across + vehicle.cg_to_front_axle * rate) / speed - angle,
            "slip_rear": (across - vehicle.cg_to_rear_axle * rate) / speed, "steering": angle,
            "acceleration_y": speed * rate, "acceleration_x": np.gradient(speed, time * 1e-9), "speed": speed,
            "yaw_rate": rate}


def candidates(windows: Windows, vehicle: VehicleParameters) -> list[Candidate]:
    """What these drives can ask: not of a channel that was not measured, nor over a quantity that hardly moves."""
    values, found = driven(windows, vehicle), []
    for place, quantities in ASKED.items():
        channel = place.removeprefix("sensor_")
        if place.startswith("sensor_") and channel != "heading" and channel not in windows.columns:
            continue
        for quantity, parity in quantities:
            u = values[quantity][np.isfinite(values[quantity])]
            low, high = np.quantile(u, [EDGE, 1.0 - EDGE])
            if parity == ODD:
                high = np.quantile(np.abs(u), 1.0 - EDGE)
                low = -high
            if high - low > 1e-6 * max(abs(high), abs(low), 1e-6):
                found.append(Candidate(place, quantity, parity, float(low), float(high)))
    return found


def unit_of(place: str) -> str:
    return PLACES[place][0]
