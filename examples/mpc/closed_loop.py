"""Drives the virtual car along a path with the controller, and measures the tracking error at the CG."""

import math
from dataclasses import asdict, dataclass

import numpy as np
from controlled_car import ControlledCar
from controller import Controller, Reference
from st_core.vehicle import VehicleParameters
from st_sim.scenarios import Plan
from st_sim.settings import Settings

MAX_DEVIATION = 4.0  # m; limit of the lateral deviation from the path, above which the drive ends
SAMPLING_TIME = 0.02  # s between measurements of the tracking error


@dataclass(frozen=True)
class DriveResults:
    """Results of one drive."""

    error_rms: float  # lateral deviation of the CG from the path [m]
    error_max: float
    speed_rms: float  # rms speed error [m/s]
    # Elapsed (wall) and processor time of the solver per problem [ms], without the first, which has no warm start.
    wall_median: float
    wall_p95: float
    wall_max: float
    cpu_median: float
    cpu_p95: float
    cpu_max: float
    iterations: float  # median, without the first problem
    solutions: int  # number of control steps
    unsolved: int  # number of control steps without a solution
    duration: float  # time driven [s]
    finished: bool  # False if the car left the path

    def as_dict(self) -> dict:
        return asdict(self)


class ReferencePath:
    """Reference path of a plan. distance: position of the car along the path [m]."""

    def __init__(self, plan: Plan):
        self.plan, self.distance = plan, 0.0

    def track(self, x: float, y: float) -> float:
        """Update `distance` for a car at (x, y) [m]; returns its lateral deviation [m], positive to the left."""
        for _ in range(3):
            point = self.plan.path.pose(self.distance)
            self.distance += math.cos(point.yaw) * (x - point.x) + math.sin(point.yaw) * (y - point.y)
        point = self.plan.path.pose(self.distance)
        return math.cos(point.yaw) * (y - point.y) - math.sin(point.yaw) * (x - point.x)

    def make_reference(self, steps: int, step: float) -> Reference:
        """Path ahead at the end of each of the `steps`, for a car at the speed of the plan. step: duration [s]."""
        rows, distance = [], self.distance
        for _ in range(steps):
            middle = distance + 0.5 * step * self.plan.speed_at(distance)
            distance += step * self.plan.speed_at(middle)
            rows.append((*self.plan.path.pose(distance), self.plan.speed_at(distance)))
        return Reference(*np.array(rows).T)


def drive(controller: Controller, car: VehicleParameters, settings: Settings, plan: Plan, duration: float,
          seed: int = 0) -> tuple[DriveResults, np.ndarray]:
    """Drive a plan; returns its results, and rows (time, x, y, lateral deviation, speed error, road-wheel angle).

    The solver time is measured, but commands take effect without this delay.
    """
    path, plant = ReferencePath(plan), ControlledCar(car, settings, seed)
    start = plan.path.pose(0.0)
    plant.place(start.x, start.y, start.yaw, plan.speed_at(0.0), plan.path.curvature(0.0))
    step, rows, solutions = controller.tuning.step, [], []
    finished = True
    while finished and plant.time < duration - 1e-9:
        path.track(*plant.state[:2])
        solution = controller.control(plant.state, path.make_reference(controller.steps, step))
        solutions.append(solution)
        for _ in range(round(step / SAMPLING_TIME)):
            plant.advance(SAMPLING_TIME, *solution.inputs)
            x, y, speed, *_ = plant.state
            offset = path.track(x, y)
            rows.append((plant.time, x, y, offset, speed - plan.speed_at(path.distance), solution.inputs[0]))
        finished = abs(offset) < MAX_DEVIATION
    table = np.array(rows)
    # The first solution has no warm start.
    wall = 1e3 * np.array([s.wall for s in solutions[1:]])
    cpu = 1e3 * np.array([s.cpu for s in solutions[1:]])
    results = DriveResults(
        error_rms=float(np.sqrt(np.mean(table[:, 3] ** 2))), error_max=float(np.max(np.abs(table[:, 3]))),
        speed_rms=float(np.sqrt(np.mean(table[:, 4] ** 2))), wall_median=float(np.median(wall)),
        wall_p95=float(np.percentile(wall, 95)), wall_max=float(np.max(wall)), cpu_median=float(np.median(cpu)),
        cpu_p95=float(np.percentile(cpu, 95)), cpu_max=float(np.max(cpu)),
        iterations=float(np.median([s.iterations for s in solutions[1:]])), solutions=len(solutions),
        unsolved=sum(not s.solved for s in solutions), duration=float(plant.time), finished=finished)
    return results, table
