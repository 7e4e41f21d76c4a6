"""Converts between the messages of the predictor's topics and the types of st_core."""

import math
from array import array
from collections.abc import Iterable, Sequence

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from st_core.bands import BandCoverage
from st_core.errors import StCoreError
from st_core.evaluation import ErrorStatistics as Statistics
from st_core.evaluation import Mode, Score
from st_core.log_evaluation import PLANNED_MODES
from st_core.planned_inputs import PlannedInputs
from st_core.prediction import Start
from st_core.types import InputSequence, InsSample, Trajectory, cg_to_ins_position
from st_core.vehicle import VehicleParameters
from st_msgs.msg import ErrorStatistics, InputPlan, PlannedPrediction, Prediction, PredictionError
from st_recordings.bag_metadata import INFINITE_NS, Qos, make_qos
from st_ros.polling import from_nanoseconds, to_nanoseconds

from .map_drawing import DRAWN_MODE, Path, make_ribbon

QUATERNION_TOLERANCE = 0.01  # largest error of the squared length; rounding to float32 causes 1e-7, all zeros 1
_NEVER_NS = 9_223_372_036 * 1_000_000_000  # rmw's "infinite", rounded down to seconds; rclpy returns this or more


def read_ins_sample(message: Odometry, map_frame: str) -> InsSample | str:
    """The INS sample of an odometry message (REP 103/105), or the reason why it cannot be used: pose of the INS point
    in the map frame (ENU), twist in body axes (forward, left, up) at that point."""
    if message.header.frame_id != map_frame:
        return f"header.frame_id is {message.header.frame_id!r}, expected {map_frame!r} (parameter map_frame)"
    q, position = message.pose.pose.orientation, message.pose.pose.position
    linear, yaw_rate = message.twist.twist.linear, message.twist.twist.angular.z
    squared_norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if not all(map(math.isfinite, (position.x, position.y, squared_norm, linear.x, linear.y, yaw_rate))):
        return "NaN or infinite values"
    if abs(squared_norm - 1.0) > QUATERNION_TOLERANCE:
        return f"orientation is not a unit quaternion (squared length {squared_norm:.3g})"
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    return InsSample(to_nanoseconds(message.header.stamp), position.x, position.y, yaw, linear.x, linear.y, yaw_rate)


def list_prediction_topics(models: Iterable[str]) -> dict[tuple[Mode, str], tuple[str, type]]:
    """Topic and message type of the predictions, by mode and model."""
    kinds: dict[Mode, type] = {"forecast": Prediction, **dict.fromkeys(PLANNED_MODES, PlannedPrediction)}
    return {(mode, model): (f"predictor/{model}/{'prediction' if mode == 'forecast' else mode}", kind)
            for mode, kind in kinds.items() for model in models}


class PathBuilder:
    """One nav_msgs/Path that is refilled for every prediction; constructing its poses would take ten times as long."""

    def __init__(self, map_frame: str, points: int):
        self.message = PathMessage(poses=[PoseStamped() for _ in range(points)])
        for header in (self.message.header, *(pose.header for pose in self.message.poses)):
            header.frame_id = map_frame

    def fill(self, start_ns: int, trajectory: Trajectory, vehicle: VehicleParameters) -> PathMessage:
        """Set `message` to the path of the INS point; each pose is stamped with the time for which it is predicted."""
        x, y = cg_to_ins_position(trajectory.x, trajectory.y, trajectory.yaw, vehicle.cg_to_ins_x, vehicle.cg_to_ins_y)
        half_yaw = 0.5 * trajectory.yaw
        self.message.header.stamp = from_nanoseconds(start_ns)
        times = start_ns + np.round(trajectory.time * 1e9).astype(np.int64)
        seconds, nanoseconds = np.divmod(times, 1_000_000_000)
        columns = (c.tolist() for c in (x, y, np.sin(half_yaw), np.cos(half_yaw), seconds, nanoseconds))
        for pose, px, py, qz, qw, sec, nanosec in zip(self.message.poses, *columns, strict=True):
            position, orientation, stamp = pose.pose.position, pose.pose.orientation, pose.header.stamp
            position.x, position.y, orientation.z, orientation.w = px, py, qz, qw
            stamp.sec, stamp.nanosec = sec, nanosec
        return self.message


def make_prediction_message(start: Start, model: str, trajectory: Trajectory, vehicle: VehicleParameters,
                            map_frame: str, configuration_hash: str, planned: InputSequence | None = None,
                            plan_ns: int = 0) -> Prediction | PlannedPrediction:
    """Message of a prediction with held inputs, or with the inputs of a plan or course at half steps. plan_ns: stamp of
    the plan [ns], 0 for a course. The caller sets issued_at, compute_time and bands."""
    if planned is None:
        message = Prediction(road_wheel_angle=float(start.inputs.road_wheel_angle),
                             velocity_x_dot=float(start.inputs.velocity_x_dot))
    else:
        message = PlannedPrediction(plan_stamp=from_nanoseconds(plan_ns),
                                    road_wheel_angle=_to_array(planned.road_wheel_angle),
                                    velocity_x_dot=_to_array(planned.velocity_x_dot))
    message.header.stamp = from_nanoseconds(start.time_ns)
    message.header.frame_id = map_frame
    message.model, message.configuration_hash, message.step = model, configuration_hash, trajectory.step
    message.cg_to_ins_x, message.cg_to_ins_y = float(vehicle.cg_to_ins_x), float(vehicle.cg_to_ins_y)
    message.x, message.y, message.velocity_x, message.velocity_y, message.yaw, message.yaw_rate = map(
        _to_array, trajectory.states.T)
    return message


def read_planned_inputs(message: InputPlan, base_frame: str, vehicle: VehicleParameters) -> PlannedInputs | str:
    """The plan in a message, or the reason why it cannot be used. Speed and curvature refer to the CG."""
    if message.header.frame_id != base_frame:
        return f"plan: header.frame_id is {message.header.frame_id!r}, expected {base_frame!r} (parameter plan_frame)"
    pairs = [(message.road_wheel_angle, message.velocity_x_dot), (message.speed, message.curvature)]
    lengths = [tuple(map(len, pair)) for pair in pairs]
    n = len(message.time)
    if n == 0 or sorted(lengths) != [(0, 0), (n, n)]:
        return (f"plan: {n} time stamps, but {lengths[0]} values of road_wheel_angle and velocity_x_dot, and "
                f"{lengths[1]} of speed and curvature; expected one value per time for one pair, none for the other")
    seconds = np.asarray(message.time)
    if not np.isfinite(seconds).all():
        return "plan: time is not finite"
    issued_ns = to_nanoseconds(message.header.stamp)
    time_ns = issued_ns + np.round(seconds * 1e9).astype(np.int64)
    first, second = map(np.asarray, pairs[0] if lengths[0][0] else pairs[1])
    try:
        if lengths[0][0]:
            return PlannedInputs(issued_ns, time_ns, first, second)
        return PlannedInputs.from_path(issued_ns, time_ns, first, second, vehicle)
    except StCoreError as error:
        return str(error)


def read_trajectory(message: Prediction | PlannedPrediction) -> tuple[int, Trajectory] | str:
    """(start_ns, trajectory) of a prediction message, or why it cannot be used. Later states may be NaN or infinite."""
    columns = [message.x, message.y, message.velocity_x, message.velocity_y, message.yaw, message.yaw_rate]
    if len({len(c) for c in columns}) != 1 or len(message.x) < 2:
        return "its arrays differ in length or have fewer than two points"
    if not (math.isfinite(message.step) and message.step > 0.0):
        return f"its step is {message.step:g} s"
    states = np.array(columns).T
    if not np.isfinite(states[0]).all():
        return "its start state is not finite"
    return to_nanoseconds(message.header.stamp), Trajectory(message.step, states)


def read_ins_path(message: Prediction) -> Path:
    """The predicted path of the INS point with its forecast bands; bands of a different length are left out."""
    x, y, yaw = map(np.asarray, (message.x, message.y, message.yaw))
    x, y = cg_to_ins_position(x, y, yaw, message.cg_to_ins_x, message.cg_to_ins_y)
    bands = sorted((b for b in message.bands if b.mode == DRAWN_MODE), key=lambda b: -b.level)
    ribbons = tuple(make_ribbon(b.level, (x, y, yaw), np.asarray(b.along), np.asarray(b.across)) for b in bands
                    if len(b.along) == len(b.across) == len(x))
    return Path(to_nanoseconds(message.header.stamp), message.step, x, y, ribbons)


def make_prediction_error_message(score: Score, map_frame: str, configuration_hash: str) -> PredictionError:
    message = PredictionError(model=score.model, mode=score.mode, complete=score.complete,
                              incomplete_reason=score.incomplete_reason,
                              longitudinal_mean=float(score.longitudinal_mean), lateral_mean=float(score.lateral_mean),
                              yaw_mean=float(score.yaw_mean), configuration_hash=configuration_hash)
    message.header.stamp = from_nanoseconds(score.start_ns)
    message.header.frame_id = map_frame
    message.horizon, message.longitudinal, message.lateral, message.yaw = map(
        _to_array, (score.horizon, score.longitudinal, score.lateral, score.yaw))
    return message


def make_statistics_message(model: str, mode: str, statistics: Statistics,
                            coverage: BandCoverage | None) -> ErrorStatistics:
    """Errors of a model and mode so far; coverage: observed coverage of its bands, None before the first score."""
    errors = {f"{axis}_{statistic}": float(getattr(getattr(statistics, axis), statistic))
              for axis in ("longitudinal", "lateral", "yaw") for statistic in ("mean", "max", "rmse")}
    coverage_50, coverage_90 = (coverage.coverage_at(level) if coverage else math.nan for level in (0.5, 0.9))
    return ErrorStatistics(model=model, mode=mode, n_starts=statistics.n_starts, n_incomplete=statistics.n_incomplete,
                           n_bands=coverage.n if coverage else 0, coverage_50=coverage_50, coverage_90=coverage_90,
                           **errors)


def make_bag_qos(profile: QoSProfile) -> Qos:
    """QoS of a publisher in the form that a bag stores."""
    return make_qos(profile.reliability.name.lower(), profile.durability.name.lower(), profile.history.name.lower(),
                    profile.depth, _convert_qos_duration(profile.deadline), _convert_qos_duration(profile.lifespan),
                    profile.liveliness.name.lower(), _convert_qos_duration(profile.liveliness_lease_duration))


def _convert_qos_duration(duration: Duration) -> int:
    # 0 is rmw's "not specified", which is equivalent to "never" in an offered QoS.
    return duration.nanoseconds if 0 < duration.nanoseconds < _NEVER_NS else INFINITE_NS


def _to_array(values: Sequence[float] | np.ndarray) -> array:
    """The values as array('d'), the only type that rosidl accepts without checking each element."""
    return array("d", np.ascontiguousarray(values, np.float64).tobytes())
