"""Definition of a model, and the equations of the single-track car that both dynamic models share."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..ops import cos, sin
from ..tyres import slip_angle
from ..vehicle import VehicleParameters

AxleForces = Callable[[Any, Any, tuple, Any], tuple]  # (slip_front, slip_rear [rad], w, p) -> (front, rear) [N]


@dataclass(frozen=True)
class Model:
    """One vehicle model. State (x, y, velocity_x, velocity_y, yaw, yaw_rate) at the CG, as in types.VehicleState.

    parameters(vehicle) -> p: a NamedTuple of the numbers in the equations, possibly nested.
    inputs(road_wheel_angle, velocity_x_dot, p, *signals) -> w: a tuple of all quantities that depend only on the
        inputs; computed once per instant, or once per prediction with constant inputs. One argument per signal.
    rhs(state, w, p) -> time derivative of the state: six values and one for each of `extra_states`.
    start(state, w, p) -> initial extra states of a prediction, from the first six states and w; None: zeros.
    The functions use `st_core.ops` and accept floats, or arrays of equal shape for a batch.
    """

    name: str
    parameters: Callable[[VehicleParameters], Any]
    inputs: Callable[..., tuple]
    rhs: Callable[[tuple, tuple, Any], tuple]
    extra_states: tuple[str, ...] = ()  # names of the states after the six
    start: Callable[[tuple, tuple, Any], tuple] | None = None
    signals: tuple[str, ...] = ()  # names of further measured quantities that the model needs
    axle_forces: AxleForces | None = None  # lateral forces of a dynamic base model, whose rhs is from `make_rhs`

    @property
    def has_tyres(self) -> bool:
        """Whether the wheels need a slip angle to generate lateral force; False for a kinematic model."""
        return self.axle_forces is not None

    @property
    def has_steering_dynamics(self) -> bool:
        """Whether the road wheel angle depends on earlier steering; only effects can cause this."""
        return False

    def effective_vehicle(self, vehicle: VehicleParameters) -> VehicleParameters:
        """The vehicle parameters that the model uses in place of those in the vehicle file."""
        return vehicle

    def start_state(self, state: tuple, w: tuple, p: Any) -> tuple:
        """Initial state of a prediction: the six given states and the extra states."""
        if self.start is None:
            return (*state, *(0.0 * state[0] for _ in self.extra_states))
        return (*state, *self.start(state, w, p))


def slip_angles(state, w, p):
    """Slip angles (front, rear) [rad], positive when the wheel slides to its left; d: road wheel angle.

        v_x0 = v_x cos d + (v_y + l_f r) sin d,   v_sy0 = (v_y + l_f r) cos d - v_x sin d
        v_x1 = v_x,                               v_sy1 = v_y - l_r r        (0: front wheel, 1: rear)

    w: begins with sin d and cos d. p: has cg_to_front_axle, cg_to_rear_axle [m], minimum_slip_speed [m/s].
    Source: paper, wheel velocities.
    """
    velocity_x, velocity_y, yaw_rate, sine, cosine = state[2], state[3], state[5], w[0], w[1]
    lateral = velocity_y + p.cg_to_front_axle * yaw_rate
    front = slip_angle(lateral * cosine - velocity_x * sine, velocity_x * cosine + lateral * sine, p.minimum_slip_speed)
    rear = slip_angle(velocity_y - p.cg_to_rear_axle * yaw_rate, velocity_x, p.minimum_slip_speed)
    return front, rear


def motion(state, force_front, force_rear, w, p):
    """Time derivative of the state for axle forces [N], each along the lateral axis of its wheel, positive to the left.

        x_dot = v_x cos psi - v_y sin psi,  y_dot = v_x sin psi + v_y cos psi,  v_x_dot: input
        v_y_dot = (F_f cos d + F_r) / m - v_x r,  psi_dot = r,  r_dot = (l_f F_f cos d - l_r F_r) / I_z

    w: begins with sin d, cos d (d: road wheel angle) and v_x_dot [m/s^2]. p: has mass, yaw_inertia and the distances
    of both axles from the CG. Source: paper, dynamic model.
    """
    _, _, velocity_x, velocity_y, yaw, yaw_rate = state
    cosine_yaw, sine_yaw = cos(yaw), sin(yaw)
    front = force_front * w[1]
    return (velocity_x * cosine_yaw - velocity_y * sine_yaw,
            velocity_x * sine_yaw + velocity_y * cosine_yaw,
            w[2],
            (front + force_rear) / p.mass - velocity_x * yaw_rate,
            yaw_rate,
            (p.cg_to_front_axle * front - p.cg_to_rear_axle * force_rear) / p.yaw_inertia)


def make_rhs(axle_forces: AxleForces) -> Callable[[tuple, tuple, Any], tuple]:
    """The rhs of a dynamic model: `slip_angles`, then `axle_forces`, then `motion`."""
    def rhs(state, w, p):
        slip_front, slip_rear = slip_angles(state, w, p)
        force_front, force_rear = axle_forces(slip_front, slip_rear, w, p)
        return motion(state, force_front, force_rear, w, p)
    return rhs
