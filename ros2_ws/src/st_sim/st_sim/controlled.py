"""The virtual car with a controller at the wheel instead of its driver: road-wheel angle and acceleration in."""

from math import sin

from .car import Car
from .plant import RACK, VX, VY, YAW, YAW_RATE, Plant, X, Y
from .settings import Settings

FASTEST_HAND = 8.0
"""rad/s at the hand wheel, of the motor that turns it."""
HARDEST_BRAKING, HARDEST_DRIVE = 7.0, 3.5
"""m/s^2 of the drive force over the mass."""


class ControlledCar:
    """Time 0 is where `place` was called. The state is the truth; no sensor is between."""

    def __init__(self, car: Car, settings: Settings, seed: int = 0):
        self.car = car
        self.plant = Plant(car, settings, seed)
        self.steering_wheel_angle = 0.0
        self._count = 0

    def place(self, x: float, y: float, yaw: float, speed: float, curvature: float = 0.0) -> None:
        """Start there [m, rad, m/s], on a circle of that curvature [1/m, left +], without slip, hands where they are
        for it."""
        self.plant.place(x, y, yaw, speed, curvature)
        self.steering_wheel_angle = self.plant.steering_wheel_for
        self._count = 0

    @property
    def time(self) -> float:
        """s since `place`."""
        return self._count * self.plant.time_step

    @property
    def state(self) -> tuple[float, float, float, float, float, float]:
        """x, y [m], velocity_x, velocity_y [m/s, body axes], yaw [rad], yaw_rate [rad/s], at the CG."""
        s = self.plant.state
        return s[X], s[Y], s[VX], s[VY], s[YAW], s[YAW_RATE]

    def advance(self, duration: float, road_wheel_angle: float, velocity_x_dot: float) -> None:
        """Drive on for a duration [s] with both commands held.

        road_wheel_angle [rad, left +]: by the nominal steering ratio; the hand wheel turns there at its own speed, and
        the plant's steering makes of it what it does. velocity_x_dot [m/s^2]: by the nominal mass, with what a bend
        costs added; drag, slopes and tyres take their part.
        """
        plant, wanted = self.plant, road_wheel_angle * self.car.steering_ratio
        fastest = FASTEST_HAND * plant.time_step
        for _ in range(round(duration / plant.time_step)):
            self.steering_wheel_angle += min(max(wanted - self.steering_wheel_angle, -fastest), fastest)
            plant.step(self.steering_wheel_angle, self._drive_force(velocity_x_dot))
            self._count += 1

    def _drive_force(self, velocity_x_dot: float) -> float:
        # As a driver does it: in a bend the front tyres pull backwards by their side force times the steer angle.
        s = self.plant.state
        bend = abs(s[VX] * s[YAW_RATE] * sin(s[RACK])) * self.car.cg_to_rear_axle / self.car.wheelbase
        target = velocity_x_dot + bend - s[VY] * s[YAW_RATE]
        return self.car.mass * min(max(target, -HARDEST_BRAKING), HARDEST_DRIVE)
