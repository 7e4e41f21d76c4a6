"""The virtual car with a driver model that follows a scenario."""

from .car import Car
from .driver import Driver
from .plant import Plant, Truth
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
        driver = self.driver
        return self.plant.observe(driver.drive_force, self.time, driver.steering_wheel_angle, self._steering_wheel_rate)
