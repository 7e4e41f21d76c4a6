"""Definition of a model: its name and functions."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..vehicle import VehicleParameters


@dataclass(frozen=True)
class Axles:
    """The rhs of a dynamic model in three parts: slip angles, tyre forces, motion; composed they equal the rhs exactly.

    slip_angles(state, w, p) -> (front, rear) [rad], forces(slip_front, slip_rear, w, p) -> (front, rear) [N],
    motion(state, force_front, force_rear, w, p) -> time derivative of the state.
    """

    slip_angles: Callable[[tuple, tuple, Any], tuple]
    forces: Callable[[Any, Any, tuple, Any], tuple]
    motion: Callable[[tuple, Any, Any, tuple, Any], tuple]


@dataclass(frozen=True)
class Model:
    """One vehicle model. State (x, y, velocity_x, velocity_y, yaw, yaw_rate) at the CG, as types.VehicleState.

    parameters(vehicle) -> p: a NamedTuple of the numbers the equations need, possibly nested.
    inputs(road_wheel_angle, velocity_x_dot, p, *signals) -> w: a tuple of all quantities that depend on the inputs
        only; computed once per instant, or once per prediction with constant inputs. One argument per signal.
    rhs(state, w, p) -> time derivative of the state, a tuple of six and one for each of `extra_states`.
    extra_states: names of the states that follow the six. start(state, w, p) -> their values at the start of a
        prediction, from the six states and w there; None: zeros.
    signals: names of further measured quantities that the model needs.
    axles: for a dynamic model, None for the kinematic one.

    The functions are written over `st_core.ops` and take floats, or arrays of equal shape for a batch.
    """

    name: str
    parameters: Callable[[VehicleParameters], Any]
    inputs: Callable[..., tuple]
    rhs: Callable[[tuple, tuple, Any], tuple]
    extra_states: tuple[str, ...] = ()
    start: Callable[[tuple, tuple, Any], tuple] | None = None
    signals: tuple[str, ...] = ()
    axles: Axles | None = None

    def effective_vehicle(self, vehicle: VehicleParameters) -> VehicleParameters:
        """The vehicle with the parameters of the model, for the lever arm between INS and CG.

        vehicle: as in its file, also for `parameters`.
        """
        return vehicle

    def specific_force(self, state: tuple, w: tuple, p: Any) -> tuple:
        """Specific force at the CG (a_x, a_y) [m/s^2], body axes: a_x = v_x_dot - v_y r, a_y = v_y_dot + v_x r.

        r is the derivative of yaw, so that it is valid for the kinematic model as well.
        """
        derivative = self.rhs(state, w, p)
        return derivative[2] - state[3] * derivative[4], derivative[3] + state[2] * derivative[4]

    def start_state(self, state: tuple, w: tuple, p: Any) -> tuple:
        """Initial state of a prediction: the six given states and the extra ones."""
        if self.start is None:
            return (*state, *(0.0 * state[0] for _ in self.extra_states))
        return (*state, *self.start(state, w, p))
