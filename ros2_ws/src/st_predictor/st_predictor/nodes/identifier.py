"""Node identifier: estimates steering offset, steering ratio and stiffness scale while driving; never applies them."""

import math
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache

from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile
from st_core.identification.online import NAMES, OnlineEstimate, OnlineFit, OnlineIdentifier, fit_recent
from st_core.vehicle import VehicleParameters
from st_msgs.msg import Steering, TrackedParameter, TrackedParameters
from st_ros import diagnostics, parameters, spin
from st_ros.diagnostics import Check, Diagnostics
from st_ros.parameters import ConfigurationError
from st_ros.polling import LATCHED, PolledSubscription, create_steady_timer, to_nanoseconds

from .. import convert, params

DRAIN_PERIOD, PUBLISH_PERIOD = 0.1, 1.0  # s
QUEUE_DEPTH = 1000
MAX_DIFFERENCE = 3.0  # between estimate and vehicle file, in standard deviations; a larger difference causes a warning


class IdentifierNode(Node):
    def __init__(self) -> None:
        super().__init__("identifier")
        self._values = parameters.declare(self, params.IDENTIFIER)
        self._parse_vehicle = lru_cache(1)(VehicleParameters.from_yaml)  # the file is read once a second
        self._vehicle = vehicle = params.load_vehicle(self._values, self._parse_vehicle)
        self._problem = ""
        self._core = OnlineIdentifier(vehicle)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="fit")
        self._fit: Future[OnlineFit] | None = None
        self._statuses: dict[str, str] = {}
        self._resets = 0
        self._accepted_counts = {"INS samples": 0, "steering samples": 0}
        qos = QoSProfile(depth=QUEUE_DEPTH)
        self._odometry = PolledSubscription(self, Odometry, "ins/odometry", qos)
        self._steering = PolledSubscription(self, Steering, "vehicle/steering", qos)
        self._publisher = self.create_publisher(TrackedParameters, "identifier/parameters", LATCHED)
        create_steady_timer(self, DRAIN_PERIOD, self._drain)
        create_steady_timer(self, PUBLISH_PERIOD, self._publish)
        self._diagnostics = Diagnostics(self, vehicle.name, self._make_checks)
        self.get_logger().info(f"estimating {', '.join(NAMES)} of {vehicle.name}; the estimates are not applied")

    def _drain(self) -> None:
        for message, _, _ in self._odometry.take(QUEUE_DEPTH):
            sample = convert.read_ins_sample(message, self._values.map_frame)
            if not isinstance(sample, str):
                self._accepted_counts["INS samples"] += self._core.add_ins(sample)
        for message, _, _ in self._steering.take(QUEUE_DEPTH):
            if message.valid and math.isfinite(message.steering_wheel_angle):
                self._accepted_counts["steering samples"] += self._core.add_steering(
                    to_nanoseconds(message.header.stamp), message.steering_wheel_angle)
        self._update_fit()

    def _update_fit(self) -> None:
        """Use a finished fit, and start the next in a thread, so that the node can receive samples in the meantime."""
        if self._fit is not None and self._fit.done():
            self._core.fit = self._fit.result()
            self._fit = None
            for estimate in self._core.make_estimates():
                if estimate.status != self._statuses.get(estimate.parameter, "unestimated"):
                    value = f"{estimate.value:.4g} +/- {estimate.deviation:.2g} {estimate.unit}"
                    text = value if estimate.status == "estimated" else estimate.reason
                    self.get_logger().info(f"{estimate.parameter} {estimate.status}: {text}")
                self._statuses[estimate.parameter] = estimate.status
        if self._fit is None and self._core.is_fit_due:
            self._fit = self._pool.submit(fit_recent, *self._core.take_snapshot())

    def _publish(self) -> None:
        self._reload_vehicle_file()
        vehicle, driving_time = self._vehicle, self._core.driving_time
        message = TrackedParameters(vehicle=vehicle.name, vehicle_hash=vehicle.hash, resets=self._resets,
                                    seconds_used=driving_time.used,
                                    seconds_rejected=float(sum(driving_time.rejected.values())))
        message.header.stamp = self.get_clock().now().to_msg()
        message.parameters = [TrackedParameter(
            parameter=estimate.parameter, unit=estimate.unit, value=estimate.value,
            standard_deviation=estimate.deviation, vehicle_file_value=self._find_file_value(estimate),
            status=getattr(TrackedParameter, estimate.status.upper()), reason=estimate.reason)
            for estimate in self._core.make_estimates()]
        self._publisher.publish(message)

    def _reload_vehicle_file(self) -> None:
        """Reset the estimates if values in the vehicle file have changed; an invalid file is only reported."""
        try:
            vehicle = params.load_vehicle(self._values, self._parse_vehicle)
        except ConfigurationError as error:
            self._problem = " ".join(str(error).split())
            return
        previous, self._vehicle, self._problem = self._vehicle, vehicle, ""
        if vehicle.hash != previous.hash:
            self._core.reset(vehicle)
            self._fit = None  # a fit still in progress uses the previous values
            self._statuses = {}
            self._resets += 1
            self.get_logger().info(f"{self._values.vehicle_file} has changed: all estimates are reset")

    def _find_file_value(self, estimate: OnlineEstimate) -> float:
        """Value in the vehicle file; 1 for the stiffness scale, which is relative to the file."""
        return float(getattr(self._vehicle, estimate.parameter, 1.0))

    def _make_checks(self) -> list[Check]:
        driving_time = self._core.driving_time
        rejected_times = {f"not used, {reason} [s]": round(time, 1) for reason, time in driving_time.rejected.items()}
        values = {"used [s]": round(driving_time.used, 1), **rejected_times, **self._accepted_counts}
        checks = [Check("driving", diagnostics.OK, f"{driving_time.used:.0f} s of driving used", values)]
        for estimate in self._core.make_estimates():
            value, deviation, file_value = estimate.value, estimate.deviation, self._find_file_value(estimate)
            level = diagnostics.WARN if estimate.status == "invalid" else diagnostics.OK
            if estimate.status == "estimated":
                text = f"{value:.4g} +/- {deviation:.2g} {estimate.unit}, vehicle file {file_value:.4g}"
                if abs(value - file_value) > MAX_DIFFERENCE * deviation:
                    level, text = diagnostics.WARN, f"{text}: the estimate contradicts the vehicle file"
            else:
                state = "invalid" if estimate.status == "invalid" else "not estimated yet"
                text = f"{state}: {estimate.reason}"
            checks.append(Check(estimate.parameter, level, text, {
                "value": value, "standard deviation": deviation, "vehicle file": file_value,
                "status": estimate.status}))
        if self._problem:
            checks.append(Check("vehicle file", diagnostics.WARN, f"{self._problem}; the previous values are kept"))
        else:
            text = "values changed, estimates reset" if self._resets else "values unchanged since the start"
            checks.append(Check("vehicle file", diagnostics.OK, text, {"resets": self._resets}))
        return checks

    def close(self) -> None:
        self._drain()
        self._publish()
        self._pool.shutdown(wait=False, cancel_futures=True)


def main() -> int:
    return spin.run(IdentifierNode)
