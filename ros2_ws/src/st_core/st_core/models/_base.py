"""What a model is: three plain functions and a name."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..vehicle import VehicleParameters


@dataclass(frozen=True)
class Model:
    """One vehicle model. State (x, y, velocity_x, velocity_y, yaw, yaw_rate) at the CG, as types.VehicleState.

    parameters(vehicle) -> p: a NamedTuple of the numbers the equations need.
    inputs(road_wheel_angle, velocity_x_dot, p) -> w: everything that depends on the inputs alone, a tuple; computed
        once per instant, or once per prediction when the inputs are held.
    rhs(state, w, p) -> time derivative of the state, a tuple of six.

    The functions are written over `st_core.ops` and take floats, or arrays of equal shape for a batch.
    """

    name: str
    parameters: Callable[[VehicleParameters], Any]
    inputs: Callable[[Any, Any, Any], tuple]
    rhs: Callable[[tuple, tuple, Any], tuple]
