"""The virtual car under an external controller, which commands road-wheel angle and acceleration."""

from math import sin

from st_core.vehicle import VehicleParameters
from st_sim.driver import MAX_BRAKING, MAX_DRIVE, MAX_STEERING_WHEEL_RATE
from st_sim.dynamics import RACK, VX, VY, YAW, YAW_RATE, X, Y
from st_sim.plant import Plant
from st_sim.settings import Settings


class ControlledCar:
    """The plant of the virtual car without its driver; `advance` simulates it under constant commands."""

    def __init__(self, car: VehicleParameters, settings: Settings, seed: int = 0):
        self.car = car
        self.plant = Plant(car, settings, seed)
        self.steering_wheel_angle = 0.0
        self._count = 0

    def place(self, x: float, y: float, yaw: float, speed: float, curvature: float = 0.0) -> None:
        """Reset time and set position [m], yaw [rad], speed [m/s] and curvature [1/m, left > 0], without slip."""
        self.plant.place(x, y, yaw, speed, curvature)
        self.steering_wheel_angle = self.plant.rack_steering_wheel_angle
        self._count = 0

    @property
    def time(self) -> float:
        """Time since place() [s]."""
        return self._count * self.plant.time_step

    @property
    def state(self) -> tuple[float, float, float, float, float, float]:
        """x, y [m], velocity_x, velocity_y [m/s, body axes], yaw [rad], yaw_rate [rad/s], at the CG."""
        s = self.plant.state
        return s[X], s[Y], s[VX], s[VY], s[YAW], s[YAW_RATE]

    def advance(self, duration: float, road_wheel_angle: float, velocity_x_dot: float) -> None:
        """Simulate a duration [s] with constant commands.

        road_wheel_angle [rad, left > 0]: converted with the nominal steering ratio to a steering-wheel angle of limited
        rate, the input of the plant's steering. velocity_x_dot [m/s^2]: converted to a drive force with the nominal
        mass; cornering resistance is compensated, but not drag, slopes and tyre limits.
        """
        car, plant, target = self.car, self.plant, road_wheel_angle * self.car.steering_ratio
        max_step = MAX_STEERING_WHEEL_RATE * plant.time_step
        for _ in range(round(duration / plant.time_step)):
            self.steering_wheel_angle += min(max(target - self.steering_wheel_angle, -max_step), max_step)
            s = plant.state
            # Cornering resistance per mass: lateral force of the front axle times the sine of the steering angle.
            resistance = abs(s[VX] * s[YAW_RATE] * sin(s[RACK])) * car.cg_to_rear_axle / car.wheelbase
            acceleration = velocity_x_dot + resistance - s[VY] * s[YAW_RATE]
            plant.step(self.steering_wheel_angle, car.mass * min(max(acceleration, -MAX_BRAKING), MAX_DRIVE))
            self._count += 1
