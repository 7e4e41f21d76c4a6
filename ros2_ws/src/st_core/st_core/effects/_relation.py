"""Empirical relation: a smooth curve of one quantity, added to one term of the model, fitted by `st_core.relations`.

    u = sum of in_i quantity_i, limited to low ... low + 5 spacing;   t(u) = (u - low) / spacing
    f(u) = sum over k of c_k (B(t(u) - k) + parity B(t(-u) - k)),   B: cubic B-spline with integer knots, k = -1 ... 6

The parameters `in_*` are the weights of the quantities in u. f is added to the terms of the model with the weights
`to_*`; for steering and body terms it may first be multiplied by a factor with the weights `by_*`. parity: -1 odd, +1
even, 0 neither. Weights, range and parity are constants, so that all relations of a kind share one compiled function.

There are three kinds. In `relation`, u consists of quantities at the same instant. In `relation_timed`, u is the time
in the run, a signal that only recordings have. In `relation_lagged`, u may also contain a quantity q after a
first-order lag (s) or the rate of s; the factor may contain this rate:

    s_dot = (q - s) / tau,   s = q at the start
"""

from functools import partial
from typing import NamedTuple

from ..ops import absolute, cos, maximum, minimum, sin
from ._base import UNLISTED_EFFECTS, Effect, Parameter, register

SPLINES, INTERVALS = 8, 5.0  # numbers of splines of a curve, and of knot intervals in its range
MAX_COEFFICIENT = 100.0  # dimensionless; the coefficients are scaled by their typical magnitude
# acceleration_y: velocity_x yaw_rate; north, east: sine and cosine of yaw; position_x, position_y: in the map frame.
INPUTS = ("slip_front", "slip_rear", "steering", "acceleration_y", "acceleration_x", "speed", "yaw_rate", "north",
          "east", "position_x", "position_y")
_register = partial(register, registry=UNLISTED_EFFECTS)
FACTOR_INPUTS = ("steering", "acceleration_y")
TERMS = {
    "front_steer": ("rad", "added to the road wheel angle, positive to the left"),
    "rear_steer": ("rad", "additional steer angle of the rear wheels, positive to the left"),
    "front_force": ("1", "additional lateral force of the front axle divided by its static load, positive to the left"),
    "rear_force": ("1", "additional lateral force of the rear axle divided by its static load, positive to the left"),
    "front_grip": ("1", "relative change of the lateral force of the front axle"),
    "rear_grip": ("1", "relative change of the lateral force of the rear axle"),
    "yaw_moment": ("rad/s^2", "additional yaw acceleration due to a moment on the body, positive to the left"),
    "side_force": ("m/s^2", "additional lateral acceleration due to a force on the body, positive to the left"),
    "sensor_yaw_rate": ("rad/s", "added to the reading of the yaw rate sensor"),
    "sensor_acceleration_y": ("m/s^2", "added to the reading of the accelerometer"),
    "sensor_velocity_y": ("m/s", "added to the lateral velocity of the INS"),
    "sensor_heading": ("rad", "added to the yaw angle of the INS"),
}
"""Terms that a curve is added to: unit, and meaning with its sign."""


class AxleLoads(NamedTuple):
    """Static loads of the axles [N]."""

    front: float
    rear: float


def compute_static_loads(vehicle) -> AxleLoads:
    return AxleLoads(2.0 * vehicle.static_tyre_load_front, 2.0 * vehicle.static_tyre_load_rear)


def spline(t):
    """Cubic B-spline: 2/3 at t = 0, 1/6 at |t| = 1, 0 for |t| >= 2."""
    far, near = maximum(2.0 - absolute(t), 0.0 * t), maximum(1.0 - absolute(t), 0.0 * t)
    return (far * far * far - 4.0 * near * near * near) / 6.0


def evaluate_curve(u, theta):
    """f(u) of the module docstring, times `share`."""
    high = theta.low + INTERVALS * theta.spacing
    t = (minimum(maximum(u, theta.low + 0.0 * u), high + 0.0 * u) - theta.low) / theta.spacing
    s = (minimum(maximum(-u, theta.low + 0.0 * u), high + 0.0 * u) - theta.low) / theta.spacing
    p = theta.parity
    f = (theta.c0 * _basis(t, s, p, -1.0) + theta.c1 * _basis(t, s, p, 0.0) + theta.c2 * _basis(t, s, p, 1.0)
         + theta.c3 * _basis(t, s, p, 2.0) + theta.c4 * _basis(t, s, p, 3.0) + theta.c5 * _basis(t, s, p, 4.0)
         + theta.c6 * _basis(t, s, p, 5.0) + theta.c7 * _basis(t, s, p, 6.0))
    return theta.share * f


def _basis(t, s, parity, k):
    return spline(t - k) + parity * spline(s - k)


def compute_argument(instant, theta):
    """Argument u without the slip angles, which not all hooks receive."""
    return (theta.in_steering * instant.road_wheel_angle
            + theta.in_acceleration_y * instant.velocity_x * instant.yaw_rate
            + theta.in_acceleration_x * instant.velocity_x_dot + theta.in_speed * instant.velocity_x
            + theta.in_yaw_rate * instant.yaw_rate
            + theta.in_north * sin(instant.yaw) + theta.in_east * cos(instant.yaw)
            + theta.in_position_x * instant.x + theta.in_position_y * instant.y)


def compute_factor(instant, theta):
    """Factor by which the curve is multiplied."""
    return (theta.by_one + theta.by_steering * instant.road_wheel_angle
            + theta.by_acceleration_y * instant.velocity_x * instant.yaw_rate)


def add_to_readings(measured, sign, theta):
    """The readings plus `sign` times the curve f, evaluated at these readings."""
    u = (theta.in_acceleration_y * measured.velocity_x * measured.yaw_rate + theta.in_speed * measured.velocity_x
         + theta.in_yaw_rate * measured.yaw_rate)
    y = sign * evaluate_curve(u, theta)
    return measured._replace(
        yaw=measured.yaw + theta.to_sensor_heading * y, yaw_rate=measured.yaw_rate + theta.to_sensor_yaw_rate * y,
        velocity_y=measured.velocity_y + theta.to_sensor_velocity_y * y,
        acceleration_y=measured.acceleration_y + theta.to_sensor_acceleration_y * y)


def _make_constant(name: str, meaning: str, null: float = 0.0) -> Parameter:
    return Parameter(name, "1", null, null, (-1e6, 1e6), source="relation", meaning=meaning, fit=False)


def _make_parameters(*constants: Parameter) -> tuple[Parameter, ...]:
    """Parameters of a kind of relation: coefficients, range, parity, weights, and the given `constants`."""
    return (
        *(Parameter(f"c{k}", "1", null=0.0, initial=1.0, bounds=(-MAX_COEFFICIENT, MAX_COEFFICIENT),
                    meaning=f"coefficient of spline {k}", source="fit of the relation") for k in range(SPLINES)),
        _make_constant("low", "smallest value of u"), _make_constant("spacing", "spacing of the knots of u", 1.0),
        _make_constant("parity", "-1 odd, +1 even, 0 neither"), _make_constant("share", "fraction of the curve", 1.0),
        *(_make_constant(f"in_{name}", "weight in u") for name in INPUTS),
        _make_constant("by_one", "constant part of the factor", 1.0),
        *(_make_constant(f"by_{name}", "weight in the factor") for name in FACTOR_INPUTS),
        *(_make_constant(f"to_{name}", f"{meaning}, {unit}") for name, (unit, meaning) in TERMS.items()), *constants)


def fix_curve(kind: type[Effect], odd: bool = False, **values: float) -> tuple[Parameter, ...]:
    """Parameters of an effect with a fixed curve, of which only the factor `share` is fitted. kind: relation that
    provides the hooks of the effect. odd: see `Parameter`. values: parameters of `kind`, by name; rest null."""
    share = Parameter("share", "1", null=0.0, initial=1.0, bounds=(-3.0, 3.0), meaning="fraction of the fitted curve",
                      source="st discover --propose", odd=odd)
    return share, *(_make_constant(p.name, p.meaning, values.get(p.name, p.null))
                    for p in kind.parameters if p.name != share.name)


class _Relation(Effect):
    kind, slot, costly, order = "physics", "body", True, 90


@_register
class RelationEffect(_Relation):
    name = "relation"
    physics = "a smooth curve of one quantity, added to one term of the model"
    excited_by = "driving that covers the range of the quantity"
    parameters = _make_parameters()

    constants = staticmethod(compute_static_loads)

    @staticmethod
    def slip_angles(slip_front, slip_rear, extra, instant, prepared, theta):
        u = compute_argument(instant, theta) + theta.in_slip_front * slip_front + theta.in_slip_rear * slip_rear
        y = evaluate_curve(u, theta) * compute_factor(instant, theta)
        # Steering to the left reduces the slip angle, which is positive when the wheel slides to its left.
        return slip_front - theta.to_front_steer * y, slip_rear - theta.to_rear_steer * y

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, instant, prepared, theta):
        u = compute_argument(instant, theta) + theta.in_slip_front * slip_front + theta.in_slip_rear * slip_rear
        return change_forces(forces, slip_front, slip_rear, instant, evaluate_curve(u, theta), theta)

    @staticmethod
    def acceleration(instant, prepared, theta):
        y = evaluate_curve(compute_argument(instant, theta), theta) * compute_factor(instant, theta)
        return 0.0 * y, theta.to_side_force * y, theta.to_yaw_moment * y

    @staticmethod
    def observe(measured, theta):
        return add_to_readings(measured, 1.0, theta)

    @staticmethod
    def correct(measured, theta):
        return add_to_readings(measured, -1.0, theta)


@_register
class LaggedRelationEffect(_Relation):
    name = "relation_lagged"
    physics = "a smooth curve of a lagged quantity or its rate, possibly times this rate, added to an axle's steering"
    excited_by = "transients that cover the range of the quantity"
    extra_states = ("lagging",)
    parameters = _make_parameters(
        *(_make_constant(f"of_{name}", "weight in q") for name in FACTOR_INPUTS),
        _make_constant("tau", "time constant, s", 0.1),
        _make_constant("in_lagging", "weight of s in u"), _make_constant("in_rate", "weight of the rate in u"),
        _make_constant("by_rate", "weight of the rate in the factor"))

    @staticmethod
    def slip_angles(slip_front, slip_rear, extra, instant, prepared, theta):
        rate = (compute_lag_input(instant, theta) - extra[0]) / theta.tau
        y = evaluate_curve(compute_argument(instant, theta) + theta.in_lagging * extra[0] + theta.in_rate * rate, theta)
        y = y * (compute_factor(instant, theta) + theta.by_rate * rate)
        return slip_front - theta.to_front_steer * y, slip_rear - theta.to_rear_steer * y

    @staticmethod
    def start(slips, instant, prepared, theta):
        return (compute_lag_input(instant, theta),)

    @staticmethod
    def rates(extra, slips, forces, instant, prepared, theta):
        return ((compute_lag_input(instant, theta) - extra[0]) / theta.tau,)


@_register
class TimedRelationEffect(_Relation):
    name = "relation_timed"
    physics = "a smooth curve of the time in the run, added to the steering or to the grip of an axle"
    excited_by = "long runs"
    signals = ("run_time",)
    parameters = _make_parameters()

    constants = staticmethod(compute_static_loads)

    @staticmethod
    def slip_angles(slip_front, slip_rear, extra, instant, prepared, theta):
        y = evaluate_curve(prepared[0], theta)
        return slip_front - theta.to_front_steer * y, slip_rear - theta.to_rear_steer * y

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, instant, prepared, theta):
        return change_forces(forces, slip_front, slip_rear, instant, evaluate_curve(prepared[0], theta), theta)


def compute_lag_input(instant, theta):
    """Quantity q of a lagged relation, before the lag."""
    return (theta.of_steering * instant.road_wheel_angle
            + theta.of_acceleration_y * instant.velocity_x * instant.yaw_rate)


def change_forces(forces, slip_front, slip_rear, instant, y, theta):
    """Axle forces [N] changed by a curve with value y."""
    front, rear = forces(slip_front, slip_rear, instant)
    return (front * (1.0 + theta.to_front_grip * y) + theta.to_front_force * theta.constants.front * y,
            rear * (1.0 + theta.to_rear_grip * y) + theta.to_rear_force * theta.constants.rear * y)
