"""What a fit to driving may change: parameters of the vehicle file, and two of the recording itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..augmented import AugmentedModel, augment
from ..effects.steering_delay import SteeringDelay
from ..effects.steering_offset import SteeringOffset
from ..effects.steering_ratio import SteeringRatio
from ..effects.tyre_relaxation import TyreRelaxation
from ..models import Model
from ..tyres import stiffness_scale
from ..vehicle import VehicleParameters
from .result import IdentificationError

MISALIGNMENT, DELAY, RELAXATION = "ins_misalignment", SteeringDelay.name, TyreRelaxation.name


@dataclass(frozen=True)
class FreeParameter:
    """unit as in the vehicle file (SI); scale: a usual change, in which a fit counts; bounds: absolute, or shares of
    the vehicle file's value where `relative`.
    """

    unit: str
    scale: float
    bounds: tuple[float, float]
    relative: bool = False

    def limits(self, start: float) -> tuple[float, float]:
        return (self.bounds[0] * start, self.bounds[1] * start) if self.relative else self.bounds

    def step(self, start: float) -> float:
        return self.scale * start if self.relative else self.scale


FREE: Mapping[str, FreeParameter] = {
    "cornering_stiffness_front": FreeParameter("N/rad", 0.1, (0.2, 5.0), relative=True),
    "cornering_stiffness_rear": FreeParameter("N/rad", 0.1, (0.2, 5.0), relative=True),
    "yaw_inertia": FreeParameter("kg m^2", 0.1, (0.4, 2.5), relative=True),
    "steering_ratio": FreeParameter("1", 0.05, (0.5, 2.0), relative=True),
    "steering_wheel_offset": FreeParameter("rad", 0.02, (-1.0, 1.0)),
    "cg_to_ins_x": FreeParameter("m", 0.1, (-5.0, 5.0)),
    # Heading the unit reports too far to the left, as the effect heading_misalignment.
    MISALIGNMENT: FreeParameter("rad", 0.005, (-0.1, 0.1)),
    # The wheels after the measured angle, as the effect steering_delay.
    DELAY: FreeParameter("s", 0.02, (-0.2, 0.4)),
    # Way rolled until 63 % of a slip step is force, as the effect of that name.
    RELAXATION: FreeParameter("m", 0.1, (0.0, 1.5)),
}


def check_names(names: Sequence[str]) -> None:
    """Raises IdentificationError for a parameter that driving cannot show, or one named twice."""
    for name in names:
        if name not in FREE:
            raise IdentificationError(f"{name}: not found from driving; there are {', '.join(FREE)}")
    if len(set(names)) != len(names):
        raise IdentificationError(f"{', '.join(names)}: a parameter is named twice")


def start_value(name: str, vehicle: VehicleParameters) -> float:
    """Value of the vehicle file; 0 for what it does not hold."""
    return float(getattr(vehicle, name, 0.0))


def with_stiffness(vehicle: VehicleParameters, front: float, rear: float) -> VehicleParameters:
    """The car with other axle cornering stiffnesses [N/rad]; lambda_ky of both tyres follows at static load."""
    return replace(
        vehicle, cornering_stiffness_front=front, cornering_stiffness_rear=rear,
        tyre_front=vehicle.tyre_front._replace(
            lambda_ky=stiffness_scale(front, vehicle.static_tyre_load_front, vehicle.tyre_front)),
        tyre_rear=vehicle.tyre_rear._replace(
            lambda_ky=stiffness_scale(rear, vehicle.static_tyre_load_rear, vehicle.tyre_rear)))


class Applied:
    """A car and a model as functions of the values of some parameters.

    The steering of the logs was computed with the vehicle file's ratio and offset; the model's effects undo that:

        delta = (delta_file i_file + o_file - o) / i  =  delta_file / (i / i_file) + (o_file - o) / i
    """

    def __init__(self, vehicle: VehicleParameters, base: str | Model, names: Sequence[str]):
        check_names(names)
        self.vehicle, self.names = vehicle, tuple(names)
        effects = {SteeringRatio.name: {"factor": 1.0}, SteeringOffset.name: {"angle": 0.0}}
        if DELAY in names:
            effects[DELAY] = {"time": 0.0}
        if RELAXATION in names:
            effects[RELAXATION] = {"length": 0.0}
        self._model = augment(base, effects)

    def __call__(self, values: Sequence[float] | np.ndarray) -> tuple[AugmentedModel, VehicleParameters, float]:
        """(model, car, ins_misalignment [rad]) for values of `names`, SI."""
        given, file = dict(zip(self.names, map(float, values), strict=True)), self.vehicle
        car = with_stiffness(file, given.get("cornering_stiffness_front", file.cornering_stiffness_front),
                             given.get("cornering_stiffness_rear", file.cornering_stiffness_rear))
        car = replace(car, yaw_inertia=given.get("yaw_inertia", car.yaw_inertia),
                      cg_to_ins_x=given.get("cg_to_ins_x", car.cg_to_ins_x))
        ratio = given.get("steering_ratio", file.steering_ratio)
        offset = given.get("steering_wheel_offset", file.steering_wheel_offset)
        effects = {SteeringRatio.name: {"factor": ratio / file.steering_ratio},
                   SteeringOffset.name: {"angle": (file.steering_wheel_offset - offset) / ratio}}
        if DELAY in given:
            effects[DELAY] = {"time": given[DELAY]}
        if RELAXATION in given:
            effects[RELAXATION] = {"length": given[RELAXATION]}
        return self._model.with_values(effects), car, given.get(MISALIGNMENT, 0.0)


def identified_vehicle(vehicle: VehicleParameters, values: Mapping[str, float]) -> VehicleParameters:
    """The vehicle file's car with new values (SI) of any of its parameters; lambda_ky follows the stiffnesses."""
    own: dict[str, Any] = {name: value for name, value in values.items() if hasattr(vehicle, name)}
    car = replace(vehicle, **{n: v for n, v in own.items() if not n.startswith("cornering_stiffness")})
    return with_stiffness(car, own.get("cornering_stiffness_front", vehicle.cornering_stiffness_front),
                          own.get("cornering_stiffness_rear", vehicle.cornering_stiffness_rear))
