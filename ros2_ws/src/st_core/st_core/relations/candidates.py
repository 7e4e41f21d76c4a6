"""Candidate relations: the model term that a curve is added to, and the quantity it depends on."""

from dataclasses import dataclass

import numpy as np

from ..discovery.partitions import find_sites
from ..discovery.windows import Windows
from ..effects import _relation
from ..timeseries import NANOSECOND, moving_average

ODD, NO_PARITY = -1.0, 0.0  # parity of a curve
TAIL_FRACTION = 0.01  # fraction of the samples below and above the range of a curve; the curve is constant there
MIN_SPEED = 2.0  # m/s; at lower speed, slip angles are ill-defined
QUANTITIES = {"slip_front": "rad", "slip_rear": "rad", "steering": "rad", "acceleration_y": "m/s^2",
              "acceleration_x": "m/s^2", "speed": "m/s", "yaw_rate": "rad/s", "steering_rate": "rad/s",
              "lagging_steering": "rad", "lean": "m/s^2", "north": "1", "east": "1", "position_x": "m",
              "position_y": "m", "run_time": "s"}
"""Unit by quantity. acceleration_y: velocity_x times yaw_rate. lean: acceleration_y with the lag of the body roll.
north, east: sine and cosine of yaw."""
MIN_RANGES = {"slip_front": 0.005, "slip_rear": 0.005, "steering": 0.01, "acceleration_y": 0.5, "acceleration_x": 0.3,
              "speed": 1.0, "yaw_rate": 0.03, "steering_rate": 0.03, "lagging_steering": 0.01, "lean": 0.5,
              "north": 0.1, "east": 0.1, "position_x": 20.0, "position_y": 20.0, "run_time": 10.0}
"""Minimum range of a quantity or factor in the drives; smaller ranges are mostly noise and road unevenness."""
ODD_QUANTITIES = ("slip_front", "slip_rear", "steering", "acceleration_y", "yaw_rate", "steering_rate",
                  "lagging_steering", "lean")
"""Quantities that change sign in a mirrored drive; curves in them are odd."""
FILTERED_QUANTITIES = {"steering_rate": ("steering", "rate", 0.1), "lagging_steering": ("steering", "lagging", 0.2),
                       "lean": ("acceleration_y", "lagging", 0.15)}
"""(Source, kind of filter, time constant [s]) of each lagged quantity, and of each rate of change."""
ALL_TERMS = {**_relation.TERMS, "both_grip": ("1", "relative change of the lateral force of both axles")}
SENSOR_READINGS = {"sensor_yaw_rate": "yaw_rate", "sensor_acceleration_y": "acceleration_y",
                   "sensor_velocity_y": "velocity_y", "sensor_heading": "yaw"}
"""INS measurement that each sensor term acts on; also the name of its channel in `st check`."""
TYPICAL_SIZES = {"front_steer": 0.005, "rear_steer": 0.005, "front_force": 0.02, "rear_force": 0.02, "front_grip": 0.1,
                 "rear_grip": 0.1, "both_grip": 0.1, "yaw_moment": 0.05, "side_force": 0.1, "sensor_yaw_rate": 0.005,
                 "sensor_acceleration_y": 0.2, "sensor_velocity_y": 0.05, "sensor_heading": 0.005}
"""Typical magnitude of a relation by term, in the unit of the term; scale of its coefficients."""
SMOOTHING_NS = 400_000_000  # ns, smoothing of the forward speed before differentiation, because of INS noise
FACTORS = {"steering": 0.1, "acceleration_y": 3.0, "steering_rate": 0.3}
"""Typical magnitudes of the quantities that may multiply a curve."""
RELATIONS = {
    ("front_steer", "steering", ""): "a steering ratio that depends on the angle, play, or a nonlinear angle sensor",
    ("front_steer", "acceleration_y", ""): "roll steer or compliance steer of the front axle",
    ("front_steer", "speed", ""): "toe that changes with speed; a steering offset that depends on load",
    ("front_steer", "acceleration_x", ""): "brake or drive steer of the front axle, torque steer",
    ("front_steer", "steering_rate", ""): "damping or play in the steering, a delayed or advanced angle signal",
    ("front_steer", "lagging_steering", ""): "a nonlinear steering ratio with a lag, compliance of the column",
    ("front_steer", "lean", ""): "roll steer of the front suspension",
    ("front_steer", "run_time", ""): "an angle sensor that drifts, a linkage that settles",
    ("rear_steer", "acceleration_y", ""): "roll steer or compliance steer of the rear axle",
    ("rear_steer", "steering", ""): "rear-wheel steering, torsional compliance of the body",
    ("rear_steer", "speed", ""): "lift that raises the rear and changes its toe",
    ("rear_steer", "acceleration_x", ""): "brake or drive steer of the rear axle",
    ("rear_steer", "lagging_steering", ""): "rear-wheel steering with a lag, torsional compliance of the body",
    ("rear_steer", "lean", ""): "roll steer of the rear suspension",
    ("front_force", "slip_front", ""): "front tyres with different characteristics, camber thrust",
    ("rear_force", "slip_rear", ""): "rear tyres with different characteristics, camber thrust",
    ("front_grip", "speed", ""): "lift or downforce at the front axle (with v^2), tyre grip that changes with speed",
    ("front_grip", "acceleration_x", ""): "load transfer, combined slip of a driven or braked front axle",
    ("rear_grip", "speed", ""): "lift or downforce at the rear axle (with v^2), tyre grip that changes with speed",
    ("rear_grip", "acceleration_x", ""): "load transfer, combined slip of a driven or braked rear axle",
    ("both_grip", "run_time", ""): "tyres that warm up or wear, a road that dries",
    ("both_grip", "position_x", ""): "a road with friction that varies from place to place",
    ("both_grip", "position_y", ""): "a road with friction that varies from place to place",
    ("yaw_moment", "yaw_rate", ""): "yaw damping, scrub of twin wheels, a locked differential",
    ("yaw_moment", "acceleration_y", ""): "load transfer on steered or driven wheels, a differential",
    ("yaw_moment", "speed", ""): "aerodynamic yaw moment (with v^2), unequal drag of the wheels",
    ("yaw_moment", "acceleration_x", ""): "torque steer, unequal brakes, a differential",
    ("side_force", "acceleration_y", ""): "camber thrust of both axles, roll of the body",
    ("side_force", "speed", ""): "aerodynamic side force (with v^2), wind, banked road",
    ("side_force", "acceleration_x", ""): "drive or brake force with a lateral component",
    ("side_force", "north", ""): "wind or a slope, whose effect depends on the heading",
    ("side_force", "east", ""): "wind or a slope, whose effect depends on the heading",
    ("side_force", "position_x", ""): "a banked road or wind in one place",
    ("side_force", "position_y", ""): "a banked road or wind in one place",
    ("sensor_yaw_rate", "acceleration_y", ""): "g-sensitivity of the gyroscope",
    ("sensor_yaw_rate", "yaw_rate", ""): "a nonlinear scale factor of the gyroscope",
    ("sensor_yaw_rate", "speed", ""): "",
    ("sensor_acceleration_y", "acceleration_y", ""): "an accelerometer that rolls with the body",
    ("sensor_acceleration_y", "speed", ""): "",
    ("sensor_velocity_y", "yaw_rate", ""): "an error of the longitudinal INS lever arm",
    ("sensor_velocity_y", "acceleration_y", ""): "a velocity measured at a different point, or axes rotated by roll",
    ("sensor_velocity_y", "speed", ""): "a misaligned INS",
    ("sensor_heading", "acceleration_y", ""): "a heading affected by body roll",
    ("sensor_heading", "speed", ""): "",
    ("front_steer", "speed", "steering_rate"): "a steering delay that changes with speed (negative: longer delay)",
    ("front_steer", "speed", "steering"): "a steering ratio that changes with speed, power steering, an active rack",
    ("rear_steer", "speed", "acceleration_y"): "roll or compliance steer of the rear axle that changes with speed",
    ("yaw_moment", "acceleration_x", "steering"): "torque steer of steered wheels, a differential",
}
"""Textbook causes ("" if none is known) of each relation that is searched for, by (term, quantity, factor or "")."""


@dataclass(frozen=True)
class Candidate:
    """A relation to be tested: a curve of one quantity, added to one term of the model."""

    term: str  # one of ALL_TERMS
    quantity: str  # one of QUANTITIES
    parity: float  # -1 for an odd curve, 0 for any curve
    low: float  # lower end of the curve: quantile TAIL_FRACTION of the quantity in the drives
    high: float  # quantile 1 - TAIL_FRACTION; for an odd curve, of the magnitude, and low is -high
    factor: str = ""  # one of FACTORS that multiplies the curve, or ""

    @property
    def name(self) -> str:
        return f"{self.term}({self.quantity}){f' * {self.factor}' if self.factor else ''}"

    @property
    def effect(self) -> str:
        """Name of the effect that implements the relation."""
        if self.quantity == "run_time":
            return _relation.TimedRelationEffect.name
        is_filtered = self.quantity in FILTERED_QUANTITIES or self.factor in FILTERED_QUANTITIES
        return _relation.LaggedRelationEffect.name if is_filtered else _relation.RelationEffect.name

    @property
    def is_sensor_error(self) -> bool:
        """Whether the relation acts on a sensor, not on the motion of the car."""
        return self.term.startswith("sensor_")

    @property
    def is_one_sided(self) -> bool:
        """Whether the relation acts to the same side in left and right turns, so that the car is not symmetric."""
        return self.parity == NO_PARITY and not self.factor and not self.term.endswith("_grip")

    @property
    def unit(self) -> str:
        """Unit of the curve."""
        unit = ALL_TERMS[self.term][0]
        return f"{unit} per {QUANTITIES[self.factor]}" if self.factor else unit

    @property
    def typical_size(self) -> float:
        """Typical magnitude of the curve [unit]."""
        return TYPICAL_SIZES[self.term] / (FACTORS[self.factor] if self.factor else 1.0)

    @property
    def constants(self) -> dict[str, float]:
        """Fixed parameters of the effect."""
        terms = ("front_grip", "rear_grip") if self.term == "both_grip" else (self.term,)
        values = {"low": self.low, "spacing": (self.high - self.low) / _relation.INTERVALS, "parity": self.parity,
                  **{f"to_{term}": self.typical_size for term in terms}}
        for quantity, prefix in ((self.quantity, "in"), (self.factor, "by")):
            if quantity in FILTERED_QUANTITIES:
                source, kind, tau = FILTERED_QUANTITIES[quantity]
                values |= {f"of_{source}": 1.0, "tau": tau, f"{prefix}_{kind}": 1.0}
            elif quantity and quantity != "run_time":
                values[f"{prefix}_{quantity}"] = 1.0
        return values | ({"by_one": 0.0} if self.factor else {})

    def compute_splines(self, u: np.ndarray) -> np.ndarray:
        """Basis splines (SPLINES, ...) [unit of the curve] at u [unit of the quantity]; the curve is a weighted sum."""
        t, s = ((np.clip(v, self.low, self.high) - self.low) * _relation.INTERVALS / (self.high - self.low)
                for v in (u, -u))
        return self.typical_size * np.stack([
            _relation.spline(t - k) + self.parity * _relation.spline(s - k) for k in range(-1, _relation.SPLINES - 1)])


def split_name(name: str) -> tuple[str, str, str]:
    """(term, quantity, factor) of a `Candidate.name`; the factor is "" if there is none."""
    function, _, factor = name.partition(" * ")
    term, _, quantity = function.removesuffix(")").partition("(")
    return term, quantity, factor


def compute_quantities(windows: Windows) -> dict[str, np.ndarray]:
    """Each quantity at the INS samples above MIN_SPEED, by name; slip angles in small-angle approximation, from the
    measured velocity. Filters are approximated by centred averages over twice their time constants."""
    log, vehicle = windows.joined_log, windows.vehicle
    is_moving = log.velocity_x > MIN_SPEED
    stamps, speed, rate = log.ins_time_ns, log.velocity_x, log.yaw_rate
    time = stamps.astype(float)
    angle = np.interp(time, log.steering_time_ns.astype(float), log.road_wheel_angle)
    velocity_y = log.velocity_y - vehicle.cg_to_ins_x * rate
    with np.errstate(all="ignore"):
        quantities = {"slip_front": (velocity_y + vehicle.cg_to_front_axle * rate) / speed - angle,
                      "slip_rear": (velocity_y - vehicle.cg_to_rear_axle * rate) / speed, "steering": angle,
                      "acceleration_y": speed * rate,
                      "acceleration_x": np.gradient(moving_average(stamps, speed, SMOOTHING_NS), time * NANOSECOND),
                      "speed": speed, "yaw_rate": rate, "north": np.sin(log.yaw), "east": np.cos(log.yaw),
                      "position_x": log.x, "position_y": log.y, "run_time": windows.run_time}
        for name, (source, kind, tau) in FILTERED_QUANTITIES.items():
            smoothed = moving_average(stamps, quantities[source], round(2.0 * tau / NANOSECOND))
            quantities[name] = np.gradient(smoothed, time * NANOSECOND) if kind == "rate" else smoothed
    return {name: values[is_moving] for name, values in quantities.items()}


def find_candidates(windows: Windows) -> list[Candidate]:
    """Candidates that these drives excite. Quantities and factors must vary by more than MIN_RANGES, and the channel of
    a sensor term must be measured. Relations that depend on position need drives at a single site, because the maps of
    different sites may have different origins."""
    values, candidates = compute_quantities(windows), []
    is_single_site = int(find_sites(windows).max()) == 0
    for term, quantity, factor in RELATIONS:
        channel = term.removeprefix("sensor_")
        if term.startswith("sensor_") and channel != "heading" and channel not in windows.columns:
            continue
        if quantity.startswith("position_") and not is_single_site:
            continue
        parity = ODD if quantity in ODD_QUANTITIES else NO_PARITY
        low, high = _find_range(values[quantity])
        if parity == ODD:
            high = _find_range(np.abs(values[quantity]))[1]
            low = -high
        is_factor_excited = not factor or np.ptp(_find_range(values[factor])) > MIN_RANGES[factor]
        if high - low > MIN_RANGES[quantity] and is_factor_excited:
            candidates.append(Candidate(term, quantity, parity, float(low), float(high), factor))
    return candidates


def _find_range(values: np.ndarray) -> np.ndarray:
    return np.quantile(values[np.isfinite(values)], [TAIL_FRACTION, 1.0 - TAIL_FRACTION])
