"""Planner node that publishes plan/inputs ten times a second: optimal inputs along a road from the current state.

    ROS_DOMAIN_ID=7 ./st demo --scenario S6 --duration 40                         in one terminal
    ROS_DOMAIN_ID=7 ./st shell -- python examples/mpc/plan_node.py                in another: the road of S6
    ... plan_node.py --course course.yaml                                         the path of an earlier drive

Each plan is one solution of the controller of nmpc.py over 5.6 s from the measured state (ins/odometry) and steering
(vehicle/steering). The node does not drive: its plan is a good forecast only while the driver follows the same path at
the same speed. The path of a course is that of the INS point; the node uses it for the CG. docs/manual/forecast.md
explains the mode `plan`.
"""

import argparse
import os
import sys
from pathlib import Path

import numpy as np
from canedge_bridge.yaml_reader import read_text
from controller import Controller, Reference, Solution
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.utilities import remove_ros_args
from st_core.course import SPACING, Course, NearPoint, Pass
from st_core.errors import ConfigurationError, StCoreError
from st_core.models import MODELS, get_model
from st_core.types import VehicleState, ins_to_cg
from st_live.suite import make_loopback_environment
from st_msgs.msg import InputPlan, Steering
from st_predictor import convert
from st_recordings.car import read_vehicle
from st_recordings.paths import config
from st_ros import spin
from st_ros.polling import PolledSubscription, from_nanoseconds
from st_sim.scenarios import RoadPlan, load_plan

STEPS = 56  # of 0.1 s: the first one, the predictor's horizon of 5 s, and the 0.5 s for which a plan may be used
ROAD_LENGTH = 5000.0  # m, length of a scenario's road; S6 takes a quarter of an hour
MIN_SPEED = 2.0  # m/s; at lower speed the models with tyres are too stiff for the step of the controller
# m between planned and reference positions; beyond it, the solver is in another local minimum, which it does not leave.
MAX_DEVIATION = 3.0
MAX_GAP = 0.1  # s between the newest odometry and the newest steering


def make_scenario_course(name: str) -> Course:
    """The road of a scenario as a course. Raises ConfigurationError for a scenario without a fixed road."""
    plan = load_plan(name)
    if not isinstance(plan, RoadPlan):
        raise ConfigurationError(f"--road {name}: its road depends on the driver; choose a fixed road, such as S6")
    along = np.arange(-50.0, ROAD_LENGTH, SPACING)
    points = [(*plan.path.pose(s), plan.path.curvature(s), plan.speed_at(s)) for s in along.tolist()]
    return Course((Pass(name, (), np.array(points)),))


def find_next_point(course: Course, last: NearPoint, state: VehicleState) -> NearPoint | None:
    """The course point near the car that best continues the last one; None if none is near.

    The nearest point may belong to another lap, which continues differently.
    """
    return min(course.find_near(state.x, state.y, state.yaw), default=None,
               key=lambda point: (point.pass_index != last.pass_index, abs(point.row - last.row)))


def make_reference(course: Course, point: NearPoint, state: VehicleState, steps: int, step: float) -> Reference | None:
    """Road at the end of each step [s] for a car at the speed of the course; None if the road is too short."""
    points = course.passes[point.pass_index].points[point.row:]
    x, y, yaw = points[0, :3]
    along = np.arange(len(points)) * SPACING
    ahead = [float(np.cos(yaw) * (state.x - x) + np.sin(yaw) * (state.y - y))]
    for _ in range(steps):
        middle = ahead[-1] + 0.5 * step * np.interp(ahead[-1], along, points[:, 4])
        ahead.append(ahead[-1] + step * np.interp(middle, along, points[:, 4]))
    if ahead[-1] > along[-1]:
        return None
    yaws = np.unwrap(points[:, 2])
    return Reference(*(np.interp(ahead[1:], along, column)
                       for column in (points[:, 0], points[:, 1], yaws, points[:, 4])))


def make_plan_message(stamp_ns: int, measured: tuple[float, float], solution: Solution, step: float) -> InputPlan:
    """Message with a solution's plan: measured inputs at the stamp, then planned inputs in the middle of each step."""
    count = len(solution.planned)
    inputs = np.vstack([measured, solution.planned, solution.planned[-1]])
    seconds = [0.0, *((np.arange(count) + 0.5) * step), count * step]
    message = InputPlan(time=seconds, road_wheel_angle=inputs[:, 0].tolist(), velocity_x_dot=inputs[:, 1].tolist())
    message.header.stamp, message.header.frame_id = from_nanoseconds(stamp_ns), "base_link"
    return message


def _largest_deviation(solution: Solution, road: Reference) -> float:
    """Largest distance between planned and reference positions [m]."""
    return float(np.hypot(solution.predicted[:, 0] - road.x, solution.predicted[:, 1] - road.y).max())


class Planner(Node):
    """Publishes a plan in every step of the controller, unless the car is slow, not measured, or not on the course."""

    def __init__(self, controller: Controller, course: Course):
        super().__init__("planner")
        self._controller, self._course = controller, course
        qos = QoSProfile(depth=200)
        self._odometry = PolledSubscription(self, Odometry, "ins/odometry", qos)
        self._steering = PolledSubscription(self, Steering, "vehicle/steering", qos)
        self._publisher = self.create_publisher(InputPlan, "plan/inputs", QoSProfile(depth=10))
        self._point = NearPoint(0, 0, 0.0)
        self._sample = None
        self._angle, self._angle_ns = 0.0, 0
        self._counts = {"published": 0, "no road ahead": 0, "not solved": 0, "slow or not measured": 0}
        self._longest_solution = 0.0
        self.create_timer(controller.tuning.step, self._plan)

    def _plan(self) -> None:
        self._counts[self._publish_plan()] += 1

    def _publish_plan(self) -> str:
        """Publish a plan if possible; returns the count to increase."""
        previous = self._sample
        for message, _, _ in self._odometry.take():
            sample = convert.read_ins_sample(message, "map")
            if not isinstance(sample, str):
                self._sample = sample
        for message, _, _ in self._steering.take():
            if message.valid:
                self._angle, self._angle_ns = message.road_wheel_angle, convert.to_nanoseconds(message.header.stamp)
        newest, car = self._sample, self._controller.vehicle
        if newest is None or previous is None or newest.time_ns <= previous.time_ns or newest.velocity_x < MIN_SPEED \
                or abs(newest.time_ns - self._angle_ns) * 1e-9 > MAX_GAP:
            self._controller.reset()
            return "slow or not measured"
        state = ins_to_cg(newest, car.cg_to_ins_x, car.cg_to_ins_y)
        step = self._controller.tuning.step
        point = find_next_point(self._course, self._point, state)
        road = make_reference(self._course, point, state, self._controller.steps, step) if point else None
        self._point = point or self._point
        if road is None:
            self._controller.reset()
            return "no road ahead"
        acceleration = (newest.velocity_x - previous.velocity_x) / ((newest.time_ns - previous.time_ns) * 1e-9)
        measured = self._angle, acceleration
        solution = self._controller.control(state.as_tuple(), road, measured=measured)
        self._longest_solution = max(self._longest_solution, solution.wall)
        if not solution.solved or _largest_deviation(solution, road) > MAX_DEVIATION:
            self._controller.reset()
            return "not solved"
        self._publisher.publish(make_plan_message(newest.time_ns, measured, solution, step))
        return "published"

    def close(self) -> None:
        counts = ", ".join(f"{count} {name}" for name, count in self._counts.items())
        print(f"plans: {counts}; longest solution {self._longest_solution * 1000:.0f} ms", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--road", default="S6", help="a scenario of the virtual Leaf with a fixed road")
    parser.add_argument("--course", type=Path, help="course.yaml of st course build, instead of --road")
    parser.add_argument("--model", default="linear", choices=[*MODELS])
    parser.add_argument("--vehicle", type=Path, default=config("vehicle/leaf.yaml"))
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    try:
        vehicle = read_vehicle(options.vehicle)
        course = make_scenario_course(options.road) if options.course is None else Course.from_yaml(
            read_text(options.course), str(options.course))
    except StCoreError as error:
        print(f"plan_node.py: {error}", file=sys.stderr)
        return 2
    os.environ.update(make_loopback_environment(os.environ))  # as the nodes of st demo and st live
    controller = Controller(get_model(options.model), vehicle, STEPS)
    return spin.run(lambda: Planner(controller, course))


if __name__ == "__main__":
    raise SystemExit(main())
