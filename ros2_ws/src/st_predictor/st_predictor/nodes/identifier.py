"""Node identifier: steering offset, ratio and stiffness scale estimated while driving; published, never applied."""

import math
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from st_core.identification.online import NAMES, OnlineFit, OnlineIdentifier, Tracked, fit_recent
from st_msgs.msg import Steering, TrackedParameter, TrackedParameters
from st_ros import diagnostics, parameters, spin
from st_ros.diagnostics import Check, Diagnostics
from st_ros.parameters import ConfigurationError
from st_ros.polling import PolledSubscription, to_nanoseconds

from .. import convert, params

DRAIN_PERIOD = 0.1  # s
PUBLISH_PERIOD = 1.0  # s
QUEUE_DEPTH = 1000
STATUS = {"unestimated": TrackedParameter.UNESTIMATED, "estimated": TrackedParameter.ESTIMATED,
          "invalid": TrackedParameter.INVALID}
LEVELS = {"unestimated": diagnostics.OK, "estimated": diagnostics.OK, "invalid": diagnostics.WARN}
FAR_OFF = 3.0  # standard deviations from the vehicle file's value, beyond which an estimate is a warning


class IdentifierNode(Node):
    def __init__(self) -> None:
        super().__init__("identifier")
        self._values = parameters.declare(self, params.IDENTIFIER)
        self._file = Path(self._values.vehicle_file)
        self._vehicle = vehicle = params.load_vehicle(self._values)
        self._text = self._file.read_text()
        self._problem = ""
        self._core = OnlineIdentifier(vehicle)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="fit")
        self._fit: Future[OnlineFit] | None = None
        self._status: dict[str, str] = {}
        self._resets = 0
        self._received = {"INS": 0, "steering": 0}
        qos = QoSProfile(depth=QUEUE_DEPTH)
        self._odometry = PolledSubscription(self, Odometry, "ins/odometry", qos)
        self._steering = PolledSubscription(self, Steering, "vehicle/steering", qos)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = self.create_publisher(TrackedParameters, "identifier/parameters", latched)
        self.create_timer(DRAIN_PERIOD, self._drain, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.create_timer(PUBLISH_PERIOD, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._diagnostics = Diagnostics(self, vehicle.name, self._checks)
        self.get_logger().info(f"tracks {', '.join(NAMES)} of {vehicle.name}; nothing is applied")

    def _drain(self) -> None:
        for message, _, _ in self._odometry.take(QUEUE_DEPTH):
            sample = convert.ins_sample(message, self._values.map_frame)
            self._received["INS"] += not isinstance(sample, str) and self._core.add_ins(sample)
        for message, _, _ in self._steering.take(QUEUE_DEPTH):
            usable = message.valid and math.isfinite(message.steering_wheel_angle)
            self._received["steering"] += usable and self._core.add_steering(
                to_nanoseconds(message.header.stamp), message.steering_wheel_angle)
        self._fit_in_background()

    def _fit_in_background(self) -> None:
        """One fit at a time, in its thread; the samples go on being received."""
        if self._fit is not None and self._fit.done():
            self._core.take(self._fit.result())
            self._fit = None
            self._log_changes()
        if self._fit is None and self._core.due:
            self._fit = self._pool.submit(fit_recent, *self._core.snapshot())

    def _log_changes(self) -> None:
        for one in self._core.tracked():
            if one.status != self._status.get(one.parameter, "unestimated"):
                value = f"{one.value:.4g} +/- {one.deviation:.2g} {one.unit}"
                text = value if one.status == "estimated" else one.reason
                self.get_logger().info(f"{one.parameter} {one.status}: {text}")
            self._status[one.parameter] = one.status

    def _publish(self) -> None:
        self._reload_vehicle_file()
        vehicle, seconds = self._vehicle, self._core.seconds
        message = TrackedParameters(vehicle=vehicle.name, vehicle_hash=vehicle.hash, resets=self._resets,
                                    seconds_used=seconds.used, seconds_rejected=float(sum(seconds.rejected.values())))
        message.header.stamp = self.get_clock().now().to_msg()
        message.parameters = [TrackedParameter(
            parameter=one.parameter, unit=one.unit, value=one.value, standard_deviation=one.deviation,
            vehicle_file_value=self._file_value(one), status=STATUS[one.status], reason=one.reason)
            for one in self._core.tracked()]
        self._publisher.publish(message)

    def _reload_vehicle_file(self) -> None:
        """Reset the estimates when the values of the vehicle file have changed; an unreadable file changes nothing."""
        try:
            text = self._file.read_text()
            if text == self._text:
                self._problem = ""
                return
            vehicle = params.load_vehicle(self._values)
        except (OSError, UnicodeDecodeError, ConfigurationError) as error:
            self._problem = " ".join(str(error).split())
            return
        changed = vehicle.hash != self._vehicle.hash
        self._vehicle, self._text, self._problem = vehicle, text, ""
        if changed:
            self._core.reset(vehicle)
            self._fit = None  # a fit that still runs is of the old file
            self._status = {}
            self._resets += 1
            self.get_logger().info(f"{self._file} has changed: all estimates are reset")

    def _file_value(self, one: Tracked) -> float:
        return float(getattr(self._vehicle, one.parameter, 1.0))

    def _checks(self) -> list[Check]:
        seconds = self._core.seconds
        used = {"used [s]": round(seconds.used, 1), **{f"left out, {why} [s]": round(time, 1)
                                                      for why, time in seconds.rejected.items()}, **self._received}
        checks = [Check("driving", diagnostics.OK, f"{seconds.used:.0f} s of driving used", used)]
        for one in self._core.tracked():
            known, level = self._file_value(one), LEVELS[one.status]
            text = f"{one.value:.4g} +/- {one.deviation:.2g} {one.unit}, vehicle file {known:.4g}"
            words = {"unestimated": f"not estimated yet: {one.reason}", "estimated": text,
                     "invalid": f"invalid: {one.reason}"}[one.status]
            if one.status == "estimated" and abs(one.value - known) > FAR_OFF * one.deviation:
                level, words = diagnostics.WARN, f"{text}: the file does not fit the driving"
            checks.append(Check(one.parameter, level, words, {
                "value": one.value, "standard deviation": one.deviation, "vehicle file": known, "status": one.status}))
        file = Check("vehicle file", diagnostics.WARN, f"{self._problem}; the previous values are kept", {})
        return [*checks, file if self._problem else Check("vehicle file", diagnostics.OK, "as at the start", {
            "resets": self._resets})]

    def close(self) -> None:
        self._drain()
        self._publish()
        self._pool.shutdown(wait=False, cancel_futures=True)


def main() -> int:
    return spin.run(IdentifierNode)
