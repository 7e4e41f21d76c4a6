"""Steering ratio and offset from driving, where no turntables are at hand.

    delta = (delta_h - o) / i:    L kappa + K v^2 kappa = delta

Slow bends show the ratio, fast ones add the understeer, straights the offset; so the stiffnesses are fitted beside. The
ratio comes out relative to the wheelbase: 1 % more of the one is 1 % less of the other. Checked by:
test_identification_driving.py.
"""

from collections.abc import Sequence
from dataclasses import replace

from ..log import DriveLog
from ..models import Model
from ..vehicle import VehicleParameters
from .prediction_error import PredictionErrorSettings
from .result import Identification
from .stiffness_prediction import predict_stiffness

RATIO, OFFSET = "steering_ratio", "steering_wheel_offset"


def identify_steering(logs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model = "nonlinear",
                      settings: PredictionErrorSettings | None = None, *, bootstrap: int = 200,
                      seed: int = 0) -> Identification:
    """Ratio and offset with their uncertainty, and the stiffnesses that go with them.

    Raises IdentificationError for too thin driving: two bins of speed at least.
    """
    result = predict_stiffness(logs, vehicle, base, settings, also=(RATIO, OFFSET), bootstrap=bootstrap, seed=seed)
    order = [e.parameter for e in result.estimates]
    chosen = [order.index(name) for name in (RATIO, OFFSET, *(n for n in order if n not in (RATIO, OFFSET)))]
    correlation = result.correlation[chosen][:, chosen] if result.correlation is not None else None
    return replace(result, what="steering", estimates=tuple(result.estimates[i] for i in chosen),
                   correlation=correlation)
