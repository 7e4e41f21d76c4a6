"""Closed-form handling quantities of the linear single-track model, and plausible ranges of vehicle parameters."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .types import Number
from .tyres import GRAVITY
from .vehicle import VehicleParameters


def stability_factor(car: VehicleParameters) -> float:
    """K = m (l_r C_r - l_f C_f) / (l^2 C_f C_r) [s^2/m^2]; > 0: understeer. Source: Guiggiani, ch. 6."""
    front, rear = car.cornering_stiffness_front, car.cornering_stiffness_rear
    return car.mass * (car.cg_to_rear_axle * rear - car.cg_to_front_axle * front) / (car.wheelbase**2 * front * rear)


def steady_state_steering(speed: Number, curvature: Number, car: VehicleParameters) -> Number:
    """Road wheel angle [rad] of the linear single-track car in a steady turn of curvature k [1/m] at speed v [m/s].

        delta = l (1 + K v^2) k,   l: wheelbase, K: `stability_factor`

    Source: Guiggiani, The Science of Vehicle Dynamics, ch. 6.
    """
    return car.wheelbase * (1.0 + stability_factor(car) * speed * speed) * curvature


def rear_slip_coefficient(car: VehicleParameters) -> float:
    """|rear slip angle| / |lateral acceleration| in steady cornering, m l_f / (l C_r) [rad s^2/m]."""
    return car.mass * car.cg_to_front_axle / (car.wheelbase * car.cornering_stiffness_rear)


def linear_system(speed: float, car: VehicleParameters) -> tuple[np.ndarray, np.ndarray]:
    """(A, B) of d/dt (v_y, r) = A (v_y, r) + B delta, linearised about straight driving at `speed` [m/s].

    delta: road wheel angle [rad]. The tyre terms use at least minimum_slip_speed. Source: Guiggiani, ch. 6.
    """
    front, rear = car.cornering_stiffness_front, car.cornering_stiffness_rear
    l_f, l_r, v = car.cg_to_front_axle, car.cg_to_rear_axle, max(speed, car.minimum_slip_speed)
    a = np.array([[-(front + rear) / (car.mass * v), (l_r * rear - l_f * front) / (car.mass * v) - speed],
                  [(l_r * rear - l_f * front) / (car.yaw_inertia * v),
                   -(l_f**2 * front + l_r**2 * rear) / (car.yaw_inertia * v)]])
    return a, speed / v * np.array([front / car.mass, l_f * front / car.yaw_inertia])


@dataclass(frozen=True)
class Range:
    """Plausible range of a quantity of road cars, wider than the range published in `source`."""

    key: str  # keys of the vehicle file that mainly determine the quantity
    name: str
    unit: str
    low: float
    high: float
    value: Callable[[VehicleParameters], float]  # result in `unit`
    source: str

    def describe_violation(self, car: VehicleParameters) -> str:
        """A sentence with value, range and source if the car is outside the range, else ""."""
        value = self.value(car)
        if self.low <= value <= self.high:
            return ""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return (f"{self.key}: {self.name} {value:.3g}{unit} is outside the range of road cars, {self.low:g} to "
                f"{self.high:g}{unit} ({self.source})")


_INERTIA_SOURCE = "NHTSA inertia measurements, SAE 1999-01-1336"
_TYPICAL_SOURCE = "typical vehicle parameters, SAE 840561"
UNDERSTEER = Range("cornering_stiffness_front, cornering_stiffness_rear", "understeer gradient", "deg/g", -1.0, 8.0,
                   lambda car: float(np.rad2deg(stability_factor(car) * car.wheelbase * GRAVITY)), _TYPICAL_SOURCE)
PLAUSIBLE_RANGES = (
    Range("cg_to_front_axle", "fraction of the weight on the front axle", "1", 0.35, 0.68,
          lambda car: car.cg_to_rear_axle / car.wheelbase, _INERTIA_SOURCE),
    Range("yaw_inertia", "dynamic index k^2 / (l_f l_r)", "1", 0.6, 1.4,
          lambda car: car.yaw_inertia / (car.mass * car.cg_to_front_axle * car.cg_to_rear_axle), _INERTIA_SOURCE),
    Range("cg_height", "ratio of CG height to wheelbase", "1", 0.1, 0.33, lambda car: car.cg_height / car.wheelbase,
          f"{_INERTIA_SOURCE}; racing cars from 0.1"),
    UNDERSTEER,
    Range("steering_ratio", "steering ratio", "1", 9.0, 26.0, lambda car: car.steering_ratio,
          "steering systems of passenger cars 11 to 22, vans to 25"),
    *(Range(f"cornering_stiffness_{axle}", f"ratio of cornering stiffness to load of the {axle} axle", "1/rad", 4.0,
            30.0, value, f"{_TYPICAL_SOURCE}; halved for compliance, doubled for racing tyres") for axle, value in (
                ("front", lambda car: car.cornering_stiffness_front / (2.0 * car.static_tyre_load_front)),
                ("rear", lambda car: car.cornering_stiffness_rear / (2.0 * car.static_tyre_load_rear)))),
)


def find_implausible_values(car: VehicleParameters, original: VehicleParameters | None = None,
                            complete: VehicleParameters | None = None) -> tuple[str, ...]:
    """A sentence for each quantity outside its range for the car, but not for `original`, that of the vehicle file. The
    understeer gradient, of both axles, must also be outside for `complete`, the car with all effects of an answer."""
    omitted = {UNDERSTEER} if complete and not UNDERSTEER.describe_violation(complete) else set()
    return tuple(text for quantity in PLAUSIBLE_RANGES if (text := quantity.describe_violation(car))
                 and quantity not in omitted and not (original and quantity.describe_violation(original)))
