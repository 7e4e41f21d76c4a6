"""Plans: inputs over the horizon, given as steering and acceleration or as speed and curvature, and their checks.

A plan gives the future inputs of the car as functions of time on the measurement clock. They replace the constant
inputs of a forecast unless `find_plan_problem` finds a problem, which is then reported.
Checked by: test_planned_inputs.py, against predictions with the measured inputs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .errors import StCoreError
from .handling import steady_state_steering
from .models import Model
from .readings import predict_wheel_angles
from .timeseries import NANOSECOND, half_step_grid, interpolate
from .types import ControlInput, InputSequence, VehicleState
from .vehicle import VehicleParameters

MAX_AGE = 0.5  # s; planners replan at 10 Hz or faster, so the planner of an older plan has stopped
MAX_SPACING = 0.5  # s, maximum time between points: half a period of the fastest steering by a driver, 1 Hz
MAX_ROAD_WHEEL_ANGLE = 0.8  # rad; passenger cars reach 0.55 to 0.75 rad at full lock
MAX_STEERING_RATE = 1.5  # rad/s at the road wheel, 24 rad/s at the steering wheel; steering robots reach 20 rad/s
MAX_ACCELERATION = 12.0  # m/s^2, longitudinal and lateral combined: friction coefficient 1.2, sports tyres
ANGLE_TOLERANCE = 0.05  # rad between planned and measured road wheel angle at the start: 45 deg at the steering wheel
ACCELERATION_TOLERANCE = 3.0  # m/s^2 between plan and measurement at the start: braking takes 0.3 s to build up
SPEED_TOLERANCE = 2.0  # m/s between planned and measured speed at the start
SLIP_FREE_ANGLE = "slip_free_angle"  # Ackermann angle: road wheel angle without tyre slip, for models without tyres


@dataclass(frozen=True, eq=False)
class PlannedInputs:
    """Inputs of a plan, linear between its n points. Raises StCoreError for invalid times or unequal lengths."""

    issued_ns: int  # time of issue on the measurement clock
    time_ns: np.ndarray  # (n,) instants of the points on the measurement clock
    road_wheel_angle: np.ndarray  # (n,) [rad], positive to the left, as the steering sensor will measure it
    velocity_x_dot: np.ndarray  # (n,) [m/s^2]
    speed: np.ndarray | None = None  # (n,) [m/s], only in a plan `from_path`
    slip_free_angle: np.ndarray | None = None  # (n,) [rad], only in a plan `from_path`

    def __post_init__(self) -> None:
        if not np.isfinite([*np.ravel(self.time_ns), self.issued_ns]).all():
            raise StCoreError("plan: a time is not finite")
        time_ns = np.asarray(self.time_ns, np.int64)
        if (time_ns != self.time_ns).any():
            raise StCoreError("plan: the times are not whole nanoseconds: multiply seconds by 1e9 and round")
        if time_ns.size < 2:
            raise StCoreError(f"plan: {time_ns.size} point(s); at least two are needed")
        if (np.diff(time_ns) <= 0).any():
            raise StCoreError("plan: the times are not increasing")
        object.__setattr__(self, "time_ns", time_ns)
        for name in ("road_wheel_angle", "velocity_x_dot", "speed", SLIP_FREE_ANGLE):
            if (values := getattr(self, name)) is not None:
                object.__setattr__(self, name, np.asarray(values, float))
                if getattr(self, name).shape != self.time_ns.shape or self.time_ns.ndim != 1:
                    raise StCoreError(f"plan: {name} has {np.size(values)} values, time has {self.time_ns.size}")

    @classmethod
    def from_path(cls, issued_ns: int, time_ns: np.ndarray, speed: np.ndarray, curvature: np.ndarray,
                  vehicle: VehicleParameters) -> "PlannedInputs":
        """The plan for a speed v [m/s] of the CG and a curvature k [1/m] of its path, positive to the left.

            delta = L (1 + K v^2) k,    velocity_x_dot = dv/dt

        L: wheelbase, K: `handling.stability_factor`. For models without tyres, delta = atan(L k). The steering angle is
        that of a steady turn: after a fast change of curvature the path lags by the response time of the car, 0.1 s.
        """
        speed, curvature = np.asarray(speed, float), np.asarray(curvature, float)
        plan = cls(issued_ns, time_ns, curvature, np.zeros_like(speed), speed)  # checks the arrays
        path = path_inputs(speed, curvature, (plan.time_ns - np.int64(issued_ns)) * NANOSECOND, vehicle)
        return replace(plan, road_wheel_angle=path.road_wheel_angle, velocity_x_dot=path.velocity_x_dot,
                       slip_free_angle=path.signals[SLIP_FREE_ANGLE])

    def sequence(self, start_ns: int, steps: int, step: float) -> InputSequence:
        """Inputs on the half-step grid from a start [ns]; NaN outside the plan. Raises StCoreError for steps < 0."""
        if steps < 0:
            raise StCoreError(f"plan: {steps} steps; at least 0 are needed")
        grid = half_step_grid(start_ns, steps, step)
        extra = {} if self.slip_free_angle is None else {SLIP_FREE_ANGLE: self._interpolate(self.slip_free_angle, grid)}
        return InputSequence(self._interpolate(self.road_wheel_angle, grid),
                             self._interpolate(self.velocity_x_dot, grid), extra)

    def _interpolate(self, values: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
        return np.interp(grid_ns - grid_ns[0], self.time_ns - grid_ns[0], values, left=np.nan, right=np.nan)


def path_inputs(speed: np.ndarray, curvature: np.ndarray, seconds: np.ndarray,
                vehicle: VehicleParameters) -> InputSequence:
    """Inputs that follow a speed [m/s] and a curvature [1/m] over time [s]; see `PlannedInputs.from_path`."""
    return InputSequence(steady_state_steering(speed, curvature, vehicle), np.gradient(speed, seconds),
                         {SLIP_FREE_ANGLE: np.arctan(vehicle.wheelbase * curvature)})


def interpolate_plan(time_ns: np.ndarray, columns: Sequence[np.ndarray], steps: int, step: float, maximum_gap: float,
                     starts_ns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Inputs of a recorded plan over the horizon of each start; see `log_evaluation.FutureInputs`.

    time_ns: increasing [ns]. columns: planned road wheel angle, velocity_x_dot and, for a path, slip-free angle at
    these instants. NaN, and gaps longer than maximum_gap [s], mean that nothing was planned.
    """
    grid = starts_ns[:, None] + half_step_grid(0, steps, step)
    return tuple(interpolate(time_ns, values, grid, round(maximum_gap / NANOSECOND)) for values in columns)


def find_plan_problem(plan: PlannedInputs, start_ns: int, state: VehicleState, inputs: ControlInput, horizon: float,
                      vehicle: VehicleParameters) -> str:
    """Reason, in one line, why a plan cannot be used for a forecast from a start [ns] over a horizon [s]; "" if it can.

    state, inputs: measured at the start. Order of the checks: finite values, age, coverage, spacing, feasibility,
    agreement with the measurements.
    """
    return _check_timing(plan, start_ns, horizon) or _check_demand(plan, start_ns, state, inputs, vehicle)


def _check_timing(plan: PlannedInputs, start_ns: int, horizon: float) -> str:
    for name in ("road_wheel_angle", "velocity_x_dot", "speed"):
        values = getattr(plan, name)
        if values is not None and not np.isfinite(values).all():
            return f"plan: {name} is not finite at point {int(np.flatnonzero(~np.isfinite(values))[0])}"
    age = (start_ns - plan.issued_ns) * NANOSECOND
    if age > MAX_AGE:
        return f"plan: issued {age:.2f} s before the start (limit {MAX_AGE:g} s)"
    if age < -MAX_AGE:
        return f"plan: issued {-age:.2f} s after the start; the clocks disagree"
    first, last = ((int(plan.time_ns[k]) - start_ns) * NANOSECOND for k in (0, -1))
    if first > 0.0 or last < horizon - 1.0e-6:
        return f"plan: covers {first:.2f} to {last:.2f} s after the start, not the whole horizon, 0 to {horizon:g} s"
    longest = float(np.diff(plan.time_ns).max()) * NANOSECOND
    return f"plan: points are up to {longest:.2f} s apart (limit {MAX_SPACING:g} s)" if longest > MAX_SPACING else ""


def _check_demand(plan: PlannedInputs, start_ns: int, state: VehicleState, inputs: ControlInput,
                  vehicle: VehicleParameters) -> str:
    angle, seconds = plan.road_wheel_angle, np.diff(plan.time_ns) * NANOSECOND
    if (largest := float(np.abs(angle).max())) > MAX_ROAD_WHEEL_ANGLE:
        return f"plan: road wheel angle of {largest:.2f} rad (limit {MAX_ROAD_WHEEL_ANGLE:g} rad)"
    if (rate := float(np.abs(np.diff(angle) / seconds).max())) > MAX_STEERING_RATE:
        return f"plan: steering rate of {rate:.2f} rad/s at the road wheel (limit {MAX_STEERING_RATE:g} rad/s)"
    speed = plan.speed
    if speed is None:
        # Trapezoidal rule, without scipy because the live nodes do not import it.
        mean = 0.5 * (plan.velocity_x_dot[1:] + plan.velocity_x_dot[:-1])
        speed = state.velocity_x + np.cumsum([0.0, *(mean * seconds)])
    lateral = speed * speed * angle / steady_state_steering(speed, np.ones_like(speed), vehicle)
    demand = float(np.hypot(plan.velocity_x_dot, lateral).max())
    if demand > MAX_ACCELERATION:
        return f"plan: acceleration of {demand:.1f} m/s^2 (limit {MAX_ACCELERATION:g} m/s^2)"
    for name, measured, tolerance, unit in (
            ("road_wheel_angle", inputs.road_wheel_angle, ANGLE_TOLERANCE, "rad"),
            ("velocity_x_dot", inputs.velocity_x_dot, ACCELERATION_TOLERANCE, "m/s^2"),
            ("speed", state.velocity_x, SPEED_TOLERANCE, "m/s")):
        values = getattr(plan, name)
        planned = math.nan if values is None else float(plan._interpolate(values, np.array([start_ns]))[0])
        if abs(planned - measured) > tolerance:
            return (f"plan: {name} is {planned:.3g} {unit} at the start, but {measured:.3g} {unit} was measured "
                    f"(tolerance {tolerance:g} {unit}); check sign, frame and unit")
    return ""


def select_inputs(model: Model, planned: InputSequence) -> InputSequence:
    """Planned inputs for a model. A model without tyres gets the slip-free angle, if a path was planned."""
    if not model.has_tyres and SLIP_FREE_ANGLE in planned.signals:
        return InputSequence(planned.signals[SLIP_FREE_ANGLE], planned.velocity_x_dot)
    return planned


def apply_steering_dynamics(model: Model, planned: InputSequence, start_ns: int, step: float,
                            steering_ns: np.ndarray, steering: np.ndarray, maximum_gap: float) -> InputSequence:
    """Inputs of a model on the half-step grid from start_ns, with delay, play and lag of its steering.

    steering_ns [ns], steering [rad]: recorded road wheel angle up to the start. maximum_gap, step [s].
    """
    planned = select_inputs(model, planned)
    if not model.has_steering_dynamics:
        return planned
    grid = half_step_grid(start_ns, len(planned.road_wheel_angle) // 2, step)
    angle = predict_wheel_angles(model, steering_ns, steering, grid, planned.road_wheel_angle, maximum_gap)
    return InputSequence(angle, planned.velocity_x_dot, planned.signals)
