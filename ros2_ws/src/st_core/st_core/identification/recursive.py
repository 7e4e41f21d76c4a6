"""Steering offset, steering ratio and stiffness scale while driving: an extended Kalman filter with constant states.

States: offset o [rad] and ratio i [1] of the steering, compliance factor k = 1 / scale of both cornering stiffnesses
[1], and the sideslip error b of the INS [rad], which is not reported. From one tenth of a second of driving:

    hand wheel:  delta_h = o + i (beta_f - b + k F_f / C_f),   beta_f = atan((v_y + l_f r) / v_x)
    rear axle:   beta_r = b - k F_r / C_r,                     beta_r = atan((v_y - l_r r) / v_x)
    F_f = (m l_r a_y + I_z r_dot) / l,   F_r = (m l_f a_y - I_z r_dot) / l,   a_y = v_y_dot + v_x r

all at the CG, C and the rest from the vehicle file. Errors of neighbouring samples go together, so one second of
driving counts as one measurement. The states drift: in an hour by DRIFT. The spread is widened when residuals are
larger than assumed. A value counts as estimated when the driving was fit to tell it (COVERAGE) and its spread is below
LIMITS; as invalid when it lies where no such car is, or the residuals say the equations do not hold.
Holds for |a_y| <= 4 m/s^2 and dry, level roads. Source: Kalman filter for parameters as in Ljung, System
Identification, ch. 11. Checked by: test_recursive.py.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from ..vehicle import VehicleParameters

Status = Literal["unestimated", "estimated", "invalid"]
NAMES = ("steering_wheel_offset", "steering_ratio", "stiffness_scale")
UNITS = ("rad", "1", "1")

START = np.array([math.radians(30.0), 0.2, 0.5, math.radians(2.0)])  # deviations at the start; the ratio's is relative
DRIFT = np.array([math.radians(0.5), 0.005, 0.05, math.radians(0.1)])  # per square root of an hour; likewise
ROAD_WHEEL_ERROR = math.radians(0.15)  # of a sample: sensor, play, compliance
REAR_SLIP_ERROR = math.radians(0.15)
CORRELATION_TIME = 1.0  # s
SCATTER_TIME = 20.0  # s, over which residuals are compared with the assumed
LARGEST_SCATTER = 25.0  # of squared residuals over the assumed, beyond which the equations do not hold
LIMITS = (math.radians(0.5), 0.015, 0.06)  # of the spread; ratio and scale relative
PLAUSIBLE = (math.radians(45.0), (0.6, 1.6), (0.3, 3.0))  # offset; ratio over the file's; scale
SPEED_BINS = (4.0, 7.0, 10.0, 14.0, 20.0)  # m/s
CURVE, PULL = 0.02, 1.5  # l r / v [rad] and |a_y| [m/s^2] from which a sample counts as a bend, as tyre load
GATES = {"too slow": 4.0, "a_y": 4.0, "a_x": 2.0, "yaw acceleration": 0.6, "hand-wheel speed": 2.5}  # SI


class Moment(NamedTuple):
    """One tenth of a second, at the CG: speeds [m/s], rates [rad/s], accelerations [m/s^2, rad/s^2], hand wheel "
    "[rad]."""

    velocity_x: float
    velocity_y: float
    yaw_rate: float
    velocity_x_dot: float
    velocity_y_dot: float
    yaw_acceleration: float
    steering_wheel_angle: float
    steering_wheel_speed: float
    duration: float


@dataclass(frozen=True)
class Tracked:
    """One parameter as it stands. spread: one standard deviation. reason: why it is not (or no longer) estimated."""

    parameter: str
    value: float
    unit: str
    spread: float
    status: Status
    reason: str


@dataclass
class Seconds:
    """Driving used so far [s], by what it can tell."""

    used: float = 0.0
    straight: float = 0.0
    left: float = 0.0
    right: float = 0.0
    pull_left: float = 0.0
    pull_right: float = 0.0
    speeds: list[float] = field(default_factory=lambda: [0.0] * len(SPEED_BINS))
    rejected: dict[str, float] = field(default_factory=dict)


class RecursiveIdentifier:
    """Takes moments in order, tells what is known. Nothing it finds is applied to the vehicle."""

    def __init__(self, vehicle: VehicleParameters):
        self.reset(vehicle)

    def reset(self, vehicle: VehicleParameters) -> None:
        """Begin anew with this vehicle: nothing is known."""
        self.vehicle = vehicle
        self.seconds = Seconds()
        ratio = vehicle.steering_ratio
        self._scales = np.array([1.0, ratio, 1.0, 1.0])
        self._state = np.array([vehicle.steering_wheel_offset, ratio, 1.0, 0.0])
        self._covariance = np.diag((START * self._scales) ** 2)
        self._scatter = 1.0

    def add(self, moment: Moment) -> str:
        """Take one moment; returns why it was left out, or an empty text."""
        why = self._why_not(moment)
        if why:
            self.seconds.rejected[why] = self.seconds.rejected.get(why, 0.0) + moment.duration
            return why
        self._count(moment)
        self._covariance += np.diag((DRIFT * self._scales) ** 2) * moment.duration / 3600.0
        self._update(moment)
        return ""

    def tracked(self) -> tuple[Tracked, ...]:
        """The three parameters in the order of NAMES."""
        offset, ratio, softness, _ = self._state.tolist()
        deviations = np.sqrt(np.diag(self._covariance) * max(1.0, self._scatter))
        scale = 1.0 / softness if softness > 0.0 else math.inf
        values = (offset, ratio, scale)
        spreads = (float(deviations[0]), float(deviations[1]), float(deviations[2]) * scale**2)
        relative = (spreads[0], spreads[1] / ratio, spreads[2] / scale if math.isfinite(scale) else math.inf)
        lacking, trouble = self._lacking(), self._trouble(values)
        rows = []
        for k, name in enumerate(NAMES):
            reason = lacking[name]
            if not reason and relative[k] > LIMITS[k]:
                reason = "the driving so far leaves it too wide"
            status: Status = "unestimated" if reason else "estimated"
            if not lacking[name] and trouble.get(name):
                status, reason = "invalid", trouble[name]
            rows.append(Tracked(name, values[k], UNITS[k], spreads[k], status, reason))
        return tuple(rows)

    def _why_not(self, moment: Moment) -> str:
        if not all(map(math.isfinite, moment)):
            return "not finite"
        if moment.velocity_x < max(GATES["too slow"], self.vehicle.minimum_slip_speed):
            return "too slow"
        lateral = moment.velocity_y_dot + moment.velocity_x * moment.yaw_rate
        for name, value in (("a_y", lateral), ("a_x", moment.velocity_x_dot),
                            ("yaw acceleration", moment.yaw_acceleration),
                            ("hand-wheel speed", moment.steering_wheel_speed)):
            if abs(value) > GATES[name]:
                return name
        return ""

    def _count(self, moment: Moment) -> None:
        seconds, time = self.seconds, moment.duration
        bend = self.vehicle.wheelbase * moment.yaw_rate / moment.velocity_x
        pull = moment.velocity_x * moment.yaw_rate
        seconds.used += time
        seconds.straight += time * (abs(bend) < 0.25 * CURVE)
        seconds.left += time * (bend > CURVE)
        seconds.right += time * (bend < -CURVE)
        seconds.pull_left += time * (pull > PULL)
        seconds.pull_right += time * (pull < -PULL)
        seconds.speeds[sum(moment.velocity_x >= edge for edge in SPEED_BINS[1:])] += time

    def _update(self, moment: Moment) -> None:
        car, (v, v_y, r) = self.vehicle, moment[:3]
        front_slip = math.atan((v_y + car.cg_to_front_axle * r) / v)
        rear_slip = math.atan((v_y - car.cg_to_rear_axle * r) / v)
        lateral = moment.velocity_y_dot + v * r
        yaw_moment = car.yaw_inertia * moment.yaw_acceleration
        front = (car.mass * car.cg_to_rear_axle * lateral + yaw_moment) / car.wheelbase / car.cornering_stiffness_front
        rear = (car.mass * car.cg_to_front_axle * lateral - yaw_moment) / car.wheelbase / car.cornering_stiffness_rear
        offset, ratio, softness, error = self._state
        road_wheel = front_slip - error + softness * front
        residual = np.array([moment.steering_wheel_angle - offset - ratio * road_wheel,
                             rear_slip - error + softness * rear])
        slopes = np.array([[1.0, road_wheel, ratio * front, -ratio], [0.0, 0.0, -rear, 1.0]])
        single = np.array([ratio * ROAD_WHEEL_ERROR, REAR_SLIP_ERROR]) ** 2
        expected = slopes @ self._covariance @ slopes.T
        share = min(1.0, moment.duration / SCATTER_TIME)
        normal = float(residual @ np.linalg.solve(expected + np.diag(single), residual)) / 2.0
        self._scatter += share * (normal - self._scatter)
        noise = np.diag(single * max(1.0, CORRELATION_TIME / moment.duration))
        gain = np.linalg.solve(expected + noise, slopes @ self._covariance).T
        self._state = self._state + gain @ residual
        keep = np.eye(4) - gain @ slopes
        # Joseph form: stays symmetric and positive over hours.
        self._covariance = keep @ self._covariance @ keep.T + gain @ noise @ gain.T

    def _lacking(self) -> Mapping[str, str]:
        """What driving is missing, by parameter; an empty text where nothing is."""
        s = self.seconds
        both = min(s.left, s.right)
        filled = sum(time >= 5.0 for time in s.speeds)
        needs = {
            "steering_wheel_offset": [(s.used, 10.0, "driving"), (max(s.straight, both), 5.0, "straights")],
            "steering_ratio": [(s.left, 5.0, "left bends"), (s.right, 5.0, "right bends")],
            "stiffness_scale": [(s.pull_left, 3.0, "left bends above 1.5 m/s^2"),
                                (s.pull_right, 3.0, "right bends above 1.5 m/s^2"), (filled, 2, "speeds, 5 s each")],
        }
        return {name: "; ".join(f"{have:.0f} of {wanted:g}{'' if isinstance(wanted, int) else ' s'} {what}"
                                for have, wanted, what in rows if have < wanted) for name, rows in needs.items()}

    def _trouble(self, values: tuple[float, float, float]) -> Mapping[str, str]:
        """Why values are not to be believed, by parameter."""
        offset, ratio, scale = values
        if self._scatter > LARGEST_SCATTER:
            why = (f"residuals are {math.sqrt(self._scatter):.1f} times as large as assumed: another road, load or "
                   "sensor than the equations know")
            return dict.fromkeys(NAMES, why)
        relative = ratio / self.vehicle.steering_ratio
        troubles = {}
        if abs(offset) > PLAUSIBLE[0]:
            troubles["steering_wheel_offset"] = f"{math.degrees(offset):.0f} deg is beyond 45 deg"
        for name, value, (low, high) in (("steering_ratio", relative, PLAUSIBLE[1]), (NAMES[2], scale, PLAUSIBLE[2])):
            if not low < value < high:
                troubles[name] = f"{value:.2f} times the vehicle file's is outside {low:g} to {high:g}"
        return troubles
