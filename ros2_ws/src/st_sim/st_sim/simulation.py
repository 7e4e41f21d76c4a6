"""The virtual car with a driver model that follows a scenario."""

from .car import Car
from .driver import Driver
from .dynamics import A_Y_RATE, VX, VY, YAW, YAW_RATE, X, Y, Z
from .plant import DRIVE, Plant, Truth
from .scenarios import Plan
from .settings import Settings

RUN_IN_TIME = 4.0  # s simulated before time 0, so that the drive begins in steady motion


class SimulatedCar:
    """Car and driver in a scenario. Call advance(), then make_truth(); the car is already moving at time 0."""

    def __init__(self, car: Car, settings: Settings, plan: Plan, seed: int = 0):
        self.car = car
        self.plant = Plant(car, settings, seed)
        self.driver = Driver(car, settings, plan, seed)
        self._step = self.plant.time_step
        distance = plan.start
        for _ in range(round(RUN_IN_TIME / self._step)):
            distance -= plan.speed_at(distance) * self._step
        road = plan.path.pose(distance)
        self.plant.place(road.x, road.y, road.yaw, plan.speed_at(distance), plan.path.curvature(distance))
        self.driver.place(self.plant, distance)
        self._count = -round(RUN_IN_TIME / self._step)
        self._steering_wheel_rate = 0.0
        self.duration: float | None = None
        self.advance(0.0)

    @property
    def time(self) -> float:
        return self._count * self._step

    def advance(self, time: float) -> None:
        """Simulate up to the last step not after `time` [s]."""
        last = int(time / self._step + 1e-6)
        plant, driver, step = self.plant, self.driver, self._step
        while self._count < last:
            previous_angle = driver.steering_wheel_angle
            driver.advance(plant, self._count * step, step)
            plant.step(driver.steering_wheel_angle, driver.drive_force)
            self._steering_wheel_rate = (driver.steering_wheel_angle - previous_angle) / step
            self._count += 1

    def make_truth(self) -> Truth:
        plant, s = self.plant, self.plant.state
        outputs = plant.observe(self.driver.drive_force)
        return Truth(time=self.time, x=s[X], y=s[Y], z=s[Z], yaw=s[YAW], velocity_x=s[VX], velocity_y=s[VY],
                     yaw_rate=s[YAW_RATE], acceleration_x=outputs.acceleration_x, acceleration_y=outputs.acceleration_y,
                     yaw_acceleration=outputs.yaw_acceleration, velocity_z=outputs.velocity_z,
                     steering_wheel_angle=self.driver.steering_wheel_angle,
                     steering_wheel_rate=self._steering_wheel_rate,
                     road_wheel_angle=outputs.road_wheel_angle, roll=plant.body_roll + plant.surroundings.bank_angle,
                     pitch=plant.body_pitch + plant.surroundings.grade_angle, gear=DRIVE,
                     roll_rate=0.0 if plant.parked else plant.settings["roll_gradient"] * s[A_Y_RATE],
                     wheel_speed=outputs.wheel_speed, outputs=outputs, surroundings=plant.surroundings._asdict())
