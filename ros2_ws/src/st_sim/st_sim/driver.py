"""A driver model, which steers along the road with preview and controls the speed, and the car that it drives."""

import math

import numpy as np
from st_core.manoeuvres import UNDERSTEER_GRADIENT
from st_core.vehicle import VehicleParameters

from .dynamics import RACK, VX, VY, YAW, YAW_RATE, X, Y
from .path import Pose
from .plant import Plant, Truth, make_normal_source
from .scenarios import Plan
from .settings import Settings

SAMPLING_TIME = 0.01  # s
PREVIEW_TIME, MIN_PREVIEW = 0.8, 4.0  # s, m
ANTICIPATION_TIME = 0.18  # s; the driver steers for the curvature this far ahead, to compensate for lags
STEERING_TIME = 0.08  # s, time constant of the driver's steering movement
MAX_STEERING_WHEEL_RATE = 8.0  # rad/s; 460 deg/s is fast for a person
MAX_STEERING_WHEEL_ANGLE = 9.5  # rad; about the end stop at 540 deg
TREMOR_TIME = 0.4  # s, correlation time of random steering
OFFSET_INTEGRAL_GAIN, OFFSET_INTEGRAL_LIMIT = 0.015, 0.03  # 1/(m^2 s), 1/m
SPEED_GAIN, SPEED_INTEGRAL_GAIN, SPEED_INTEGRAL_LIMIT = 1.2, 0.5, 1.0  # 1/s, 1/s^2, m/s^2
STEADY_ACCELERATION = 0.5  # m/s^2; above it the speed integral is constant, so that it does not wind up
MIN_STEERING_SPEED = 0.5  # m/s; below it the steering wheel is held, because the direction of motion is undefined
MAX_PEDAL_JERK = 10.0  # m/s^3
MAX_BRAKING, MAX_DRIVE, HOLDING_BRAKE = 7.0, 3.5, 2.0  # m/s^2, longitudinal force per mass
RUN_IN_TIME = 4.0  # s, simulated before time 0, so that the drive begins in steady motion


class Driver:
    """Driver of one car. advance(), called before every step of the plant, updates the inputs of the plant:
    steering_wheel_angle (true [rad], > 0: left) and drive_force (of all wheels [N]). distance: along the road [m]."""

    def __init__(self, plant: Plant, plan: Plan, distance: float, seed: int):
        """The driver starts at a distance along the road [m] with the steering-wheel angle of the plant."""
        self.car, self.plan, self.distance = plant.car, plan, distance
        self.steering_wheel_angle = self._target_angle = plant.rack_steering_wheel_angle
        self.drive_force = 0.0
        self._tremor_sigma = plant.settings["driver_tremor"]
        self._draw = make_normal_source(np.random.default_rng([seed, 2]))
        self._tremor = self._offset_integral = self._speed_integral = self._pedal_acceleration = 0.0
        self._next_decision = -math.inf
        self._is_holding = False

    def advance(self, plant: Plant, time: float, step: float) -> None:
        if time >= self._next_decision - 1e-9:
            # Decision times are relative to the first call, so that a drive does not depend on its start time.
            self._next_decision = time + SAMPLING_TIME
            self._decide(plant, time)
        move = (self._target_angle + self._tremor - self.steering_wheel_angle) * step / STEERING_TIME
        max_step = MAX_STEERING_WHEEL_RATE * step
        self.steering_wheel_angle += min(max(move, -max_step), max_step)

    def _decide(self, plant: Plant, time: float) -> None:
        s, speed = plant.state, plant.state[VX]
        self.distance += speed * SAMPLING_TIME
        for _ in range(2):  # to the road point nearest to the car
            road = self.plan.path.pose(self.distance)
            self.distance += math.cos(road.yaw) * (s[X] - road.x) + math.sin(road.yaw) * (s[Y] - road.y)
        demand = self.plan.make_demand(time, self.distance, speed)
        if callable(demand.steering):
            self._target_angle = float(demand.steering(self.car.wheelbase)) * self.car.steering_ratio
        elif demand.steering == "hold":
            self._is_holding = True
        elif speed > MIN_STEERING_SPEED:
            if self._is_holding:
                # The steering wheel was held: move the road to the car, so that the steering angle does not jump.
                self.plan.path.anchor(self.distance, Pose(s[X], s[Y], s[YAW] + math.atan2(s[VY], s[VX])))
                self._offset_integral, self._is_holding = 0.0, False
            angle = self._steer_along(s, speed) * self.car.steering_ratio
            self._target_angle = min(max(angle, -MAX_STEERING_WHEEL_ANGLE), MAX_STEERING_WHEEL_ANGLE)
        self._control_speed(plant, demand.speed, demand.acceleration)
        if self._tremor_sigma:
            memory = math.exp(-SAMPLING_TIME / TREMOR_TIME)
            self._tremor = memory * self._tremor + self._tremor_sigma * math.sqrt(1 - memory**2) * self._draw()

    def _steer_along(self, s: tuple[float, ...], speed: float) -> float:
        """Road-wheel angle [rad] to follow the curvature ahead and return to the road within the preview distance."""
        road = self.plan.path.pose(self.distance)
        offset = math.cos(road.yaw) * (s[Y] - road.y) - math.sin(road.yaw) * (s[X] - road.x)
        direction = math.remainder(s[YAW] + math.atan2(s[VY], speed) - road.yaw, 2 * math.pi)
        preview = max(MIN_PREVIEW, PREVIEW_TIME * speed)
        self._offset_integral += OFFSET_INTEGRAL_GAIN * offset * SAMPLING_TIME
        self._offset_integral = min(max(self._offset_integral, -OFFSET_INTEGRAL_LIMIT), OFFSET_INTEGRAL_LIMIT)
        road_curvature = self.plan.path.curvature(self.distance + ANTICIPATION_TIME * speed)
        curvature = road_curvature - 2 * (offset + preview * math.sin(direction)) / preview**2 - self._offset_integral
        return math.atan(self.car.wheelbase * curvature) + UNDERSTEER_GRADIENT * speed**2 * curvature

    def _control_speed(self, plant: Plant, target_speed: float, acceleration: float) -> None:
        s = plant.state
        if plant.is_at_rest and acceleration <= 0.0:
            self.drive_force, self._pedal_acceleration, self._speed_integral = -HOLDING_BRAKE * plant.mass, 0.0, 0.0
            return
        speed_error = target_speed - s[VX]
        if abs(acceleration) < STEADY_ACCELERATION:
            integral = self._speed_integral + SPEED_INTEGRAL_GAIN * speed_error * SAMPLING_TIME
            self._speed_integral = min(max(integral, -SPEED_INTEGRAL_LIMIT), SPEED_INTEGRAL_LIMIT)
        # Cornering resistance per mass: lateral force of the front axle times the sine of the road-wheel angle.
        cornering = abs(s[VX] * s[YAW_RATE] * math.sin(s[RACK])) * plant.to_rear / self.car.wheelbase
        target = acceleration + SPEED_GAIN * speed_error + self._speed_integral + cornering - s[VY] * s[YAW_RATE]
        target = min(max(target, -MAX_BRAKING), MAX_DRIVE)
        max_change = MAX_PEDAL_JERK * SAMPLING_TIME
        self._pedal_acceleration += min(max(target - self._pedal_acceleration, -max_change), max_change)
        self.drive_force = plant.mass * self._pedal_acceleration


class SimulatedCar:
    """Car and driver in a scenario. Call advance(), then make_truth(); the car is already moving at time 0."""

    def __init__(self, car: VehicleParameters, settings: Settings, plan: Plan, seed: int = 0):
        self.car = car
        self.plant = Plant(car, settings, seed)
        self._step = self.plant.time_step
        distance = 0.0
        for _ in range(round(RUN_IN_TIME / self._step)):
            distance -= plan.speed_at(distance) * self._step
        road = plan.path.pose(distance)
        self.plant.place(road.x, road.y, road.yaw, plan.speed_at(distance), plan.path.curvature(distance))
        self.driver = Driver(self.plant, plan, distance, seed)
        self._step_count = -round(RUN_IN_TIME / self._step)
        self._steering_wheel_rate = 0.0
        self.duration: float | None = None
        self.advance(0.0)

    def advance(self, time: float) -> None:
        """Simulate up to the last step at or before `time` [s]."""
        last = int(time / self._step + 1e-6)
        plant, driver, step = self.plant, self.driver, self._step
        while self._step_count < last:
            previous_angle = driver.steering_wheel_angle
            driver.advance(plant, self._step_count * step, step)
            plant.step(driver.steering_wheel_angle, driver.drive_force)
            self._steering_wheel_rate = (driver.steering_wheel_angle - previous_angle) / step
            self._step_count += 1

    def make_truth(self) -> Truth:
        driver = self.driver
        return self.plant.observe(driver.drive_force, self._step_count * self._step, driver.steering_wheel_angle,
                                  self._steering_wheel_rate)
