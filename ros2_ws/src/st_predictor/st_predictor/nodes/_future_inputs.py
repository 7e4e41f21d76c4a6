"""Provides future inputs instead of held ones: from a motion planner's newest plan or from a recorded course."""

import time

from oxts_bridge.geometry import compute_origin_offset
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import NavSatFix
from st_core.course import Course, CourseForecast, CourseTracker, EgoMotion
from st_core.errors import StCoreError
from st_core.planned_inputs import PlannedInputs
from st_core.prediction import Predictor, Start
from st_core.types import InputSequence
from st_core.vehicle import VehicleParameters
from st_msgs.msg import InputPlan
from st_ros import diagnostics
from st_ros.diagnostics import Check
from st_ros.polling import LATCHED, PolledSubscription

from .. import convert

QUEUE_DEPTH = 10  # queued plans, of which only the newest is used
PLAN_TIMEOUT = 10.0  # s without a new plan after which an unusable plan is discarded, because the planner has stopped
NO_PREDICTION_TEXT = "not used: no predictions are being made"


class PlanInput:
    """Subscribes to plan/inputs. While the newest plan is unusable, inputs are held, and `problem` is the reason."""

    def __init__(self, node: Node, frame: str, vehicle: VehicleParameters):
        self._subscription = PolledSubscription(node, InputPlan, "plan/inputs", QoSProfile(depth=QUEUE_DEPTH))
        self._frame, self._vehicle = frame, vehicle
        self._plan: PlannedInputs | str | None = None
        self._received_at = float("-inf")
        self.problem = ""
        self._counts = {"received": 0, "used": 0, "unusable": 0}

    def drain(self) -> None:
        for message, _, _ in self._subscription.take(QUEUE_DEPTH):
            self._counts["received"] += 1
            self._plan = convert.read_planned_inputs(message, self._frame, self._vehicle)
            self._received_at = time.monotonic()

    def find_inputs(self, core: Predictor, start: Start) -> tuple[InputSequence, int] | None:
        """(inputs in the horizon, stamp of the plan [ns]) for a start; None without a usable plan."""
        if self._plan is None:
            return None
        inputs = self._plan if isinstance(self._plan, str) else core.plan_inputs(self._plan, start)
        if isinstance(inputs, str):
            self.problem = inputs
            self._counts["unusable"] += 1
            if time.monotonic() - self._received_at > PLAN_TIMEOUT:
                self._plan, self.problem = None, ""
            return None
        assert isinstance(self._plan, PlannedInputs)
        self.problem = ""
        self._counts["used"] += 1
        return inputs, self._plan.issued_ns

    def make_check(self, is_predicting: bool) -> Check:
        """Diagnostic check. is_predicting: whether the newest tick made predictions."""
        if not is_predicting:
            return Check("plan", diagnostics.OK, NO_PREDICTION_TEXT, self._counts)
        if self._plan is None:
            return Check("plan", diagnostics.OK, f"none on {self._subscription.topic}: inputs are held", self._counts)
        if self.problem:
            return Check("plan", diagnostics.WARN, f"not used, inputs are held: {self.problem}", self._counts)
        return Check("plan", diagnostics.OK, "used", self._counts)


class CourseInput:
    """Predicts inputs from a recorded course (None: no `course_file`). horizon, step: of a prediction [s]. If both map
    origins are known, the course is shifted into the map of this run; a course of a different site is not used."""

    def __init__(self, node: Node, course: Course | None, vehicle: VehicleParameters, horizon: float, step: float):
        self._course, self._tracker = course, None
        self._forecast = CourseForecast(None, reason="no prediction yet")
        self._origin_problem = ""
        self._counts = {"used": 0, "held": 0}
        if course is None:
            return
        self._tracker = CourseTracker(_build_search_tree(course), vehicle, horizon, step)
        node.create_subscription(NavSatFix, "ins/origin", self._shift_course, LATCHED)

    def _shift_course(self, message: NavSatFix) -> None:
        assert self._course is not None and self._tracker is not None
        if self._course.origin is None:
            return
        try:
            offset = compute_origin_offset((message.latitude, message.longitude), *self._course.origin)
            self._tracker.course, self._origin_problem = _build_search_tree(self._course.shift(*offset)), ""
        except StCoreError as error:
            self._origin_problem = str(error)
        self._tracker.restart()

    def find_inputs(self, core: Predictor, start: Start) -> InputSequence | None:
        """Inputs in the horizon for a start; None if the course is not used."""
        if self._tracker is None or self._origin_problem:
            return None
        sample = core.history.ins_at(start.time_ns)
        assert sample is not None  # a start is an instant with INS data
        self._forecast = self._tracker.update(
            EgoMotion(*sample, float(start.inputs.velocity_x_dot), float(start.inputs.road_wheel_angle)))
        self._counts["held" if self._forecast.inputs is None else "used"] += 1
        return self._forecast.inputs

    @property
    def is_used(self) -> bool:
        """Whether the newest start used inputs of the course."""
        return not self._origin_problem and self._forecast.inputs is not None

    def make_check(self, is_predicting: bool) -> Check:
        """Diagnostic check. is_predicting: whether the newest tick made predictions."""
        forecast = self._forecast
        if self._tracker is None:
            return Check("course", diagnostics.OK, "off (course_file is empty)")
        if self._origin_problem:
            return Check("course", diagnostics.WARN, f"not used, inputs are held: {self._origin_problem}", self._counts)
        if not is_predicting:
            return Check("course", diagnostics.OK, NO_PREDICTION_TEXT, self._counts)
        if forecast.inputs is None:
            return Check("course", diagnostics.OK, f"inputs are held: {forecast.reason}", self._counts)
        weights = {"weight in curvature": forecast.curvature_weight, "weight in speed": forecast.speed_weight}
        text = ", ".join(f"{name} {100 * weight:.0f} %" for name, weight in weights.items())
        return Check("course", diagnostics.OK, f"used, {text}; remaining weight: held inputs", self._counts | weights)


def _build_search_tree(course: Course) -> Course:
    """The course after a first lookup, which builds its search tree, so that no tick has to wait for it."""
    course.find_near(*course.passes[0].points[0, :3].tolist())
    return course
