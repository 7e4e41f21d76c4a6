"""Plant and driver together: a car that drives a scenario. `advance` to a time, then read `truth`."""

from .car import Car
from .driver import Driver
from .plant import LEAN_RATE, VX, VY, YAW, YAW_RATE, Plant, X, Y, Z
from .scenarios import Plan
from .settings import Settings
from .truth import DRIVE, Truth

RUN_IN = 4.0
"""s driven unseen before the start, so that the drive begins in steady motion."""


class SimulatedCar:
    """Time 0 is the start of the drive; the car is already moving then."""

    def __init__(self, car: Car, settings: Settings, plan: Plan, seed: int = 0):
        self.car = car
        self.plant = Plant(car, settings, seed)
        self.driver = Driver(car, settings, plan, seed)
        self._step = self.plant.time_step
        before = plan.start
        for _ in range(round(RUN_IN / self._step)):
            before -= plan.speed_at(before) * self._step
        road = plan.path.pose(before)
        self.plant.place(road.x, road.y, road.yaw, plan.speed_at(before), plan.path.curvature(before))
        self.driver.take_seat(self.plant, before)
        self._count = -round(RUN_IN / self._step)
        self._hand_rate = 0.0
        self.duration: float | None = None
        self.advance(0.0)

    @property
    def time(self) -> float:
        return self._count * self._step

    def advance(self, time: float) -> None:
        """To the last step not after `time` [s]."""
        last = int(time / self._step + 1e-6)
        plant, driver, step = self.plant, self.driver, self._step
        while self._count < last:
            before = driver.steering_wheel_angle
            driver.advance(plant, self._count * step, step)
            plant.step(driver.steering_wheel_angle, driver.drive_force)
            self._hand_rate = (driver.steering_wheel_angle - before) / step
            self._count += 1

    def truth(self) -> Truth:
        plant, s = self.plant, self.plant.state
        forces = plant.observe(self.driver.drive_force)
        here = plant.here
        parked = plant.parked
        return Truth(
            time=self.time,
            x=s[X],
            y=s[Y],
            z=s[Z],
            yaw=s[YAW],
            velocity_x=s[VX],
            velocity_y=s[VY],
            yaw_rate=s[YAW_RATE],
            acceleration_x=forces.acceleration_x,
            acceleration_y=forces.acceleration_y,
            yaw_acceleration=forces.yaw_acceleration,
            velocity_z=forces.velocity_z,
            steering_wheel_angle=self.driver.steering_wheel_angle,
            steering_wheel_rate=self._hand_rate,
            road_wheel_angle=forces.road_wheel_angle,
            roll=plant.body_roll + here.bank_angle,
            pitch=plant.body_pitch + here.grade_angle,
            roll_rate=0.0 if parked else plant.settings["roll_gradient"] * s[LEAN_RATE],
            wheel_speed=forces.wheel_speed,
            gear=DRIVE,
            forces=forces,
            surroundings=here._asdict(),
        )
