"""Plans of a motion planner as the predictor receives them: the newest one, and whether it can be used."""

import time

from rclpy.node import Node
from rclpy.qos import QoSProfile
from st_core.planned_inputs import PlannedInputs
from st_core.prediction import Predictor, Start
from st_core.types import InputSequence
from st_core.vehicle import VehicleParameters
from st_ros import diagnostics
from st_ros.diagnostics import Check
from st_ros.polling import PolledSubscription

from .. import convert

QUEUE_DEPTH = 10  # only the newest plan is used
# Without a plan for this long the planner has ended and its absence is not a warning any more [s].
FORGET_AFTER = 10.0


class PlanInput:
    """Subscribes to plan/inputs. A plan that cannot be used is refused with its reason; forecasts then hold inputs."""

    def __init__(self, node: Node, frame: str, vehicle: VehicleParameters):
        self._subscription = None
        if convert.PLAN:
            self._subscription = PolledSubscription(node, convert.PLAN, "plan/inputs", QoSProfile(depth=QUEUE_DEPTH))
        self._frame, self._vehicle = frame, vehicle
        self._plan: PlannedInputs | str | None = None
        self._received_at = float("-inf")
        self._problem = ""
        self._counts = {"received": 0, "used": 0, "refused": 0}

    def drain(self) -> None:
        """Take the waiting messages."""
        for message, _, _ in self._subscription.take(QUEUE_DEPTH) if self._subscription else ():
            self._counts["received"] += 1
            self._plan = convert.planned_inputs(message, self._frame, self._vehicle)
            self._received_at = time.monotonic()

    def at(self, core: Predictor, start: Start) -> tuple[InputSequence, int] | None:
        """(inputs over the horizon, stamp of the plan [ns]) for a start; None without a plan that can be used."""
        if self._plan is None:
            return None
        inputs = self._plan if isinstance(self._plan, str) else core.planned(self._plan, start)
        if isinstance(inputs, str):
            self._problem = inputs
            self._counts["refused"] += 1
            if time.monotonic() - self._received_at > FORGET_AFTER:
                self._plan, self._problem = None, ""
            return None
        assert isinstance(self._plan, PlannedInputs)
        self._problem = ""
        self._counts["used"] += 1
        return inputs, self._plan.issued_ns

    @property
    def problem(self) -> str:
        """Why the newest plan is not used; empty while it is used, and without one."""
        return self._problem

    def check(self) -> Check:
        if self._subscription is None:
            return Check("plan", diagnostics.OK, "off: st_msgs was built without InputPlan; build the workspace")
        if self._plan is None:
            return Check("plan", diagnostics.OK, f"none on {self._subscription.topic}: inputs are held", self._counts)
        if self._problem:
            return Check("plan", diagnostics.WARN, f"refused, inputs are held: {self._problem}", self._counts)
        return Check("plan", diagnostics.OK, "used", self._counts)
