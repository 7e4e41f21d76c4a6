"""The drives a discovery may suggest, simulated with the models at hand: what sensors would record of them."""

import numpy as np

from ..augmented import AugmentedModel
from ..channels import CHANNELS, FURTHER
from ..handling import understeer_coefficient
from ..log import DriveLog
from ..manoeuvres import Manoeuvre
from ..prediction import predict
from ..readings import corrected_steering, true_readings
from ..types import InputSequence, VehicleState
from ..vehicle import VehicleParameters
from .windows import STEP, added_acceleration

PERIOD = STEP / 2
"""s, of the simulated log."""
LEAD = 4.0
"""s before the start in which the hands come to where they are at the start, so that the drive begins steadily."""


def drive(manoeuvre: Manoeuvre, model: AugmentedModel, vehicle: VehicleParameters) -> DriveLog:
    """What sensors without noise would record if the car were the model: `duration` seconds at 1 / PERIOD.

    Hands as the understeer of the vehicle file requires, so that the lateral acceleration aimed at is reached.
    """
    lead, steps = round(LEAD / PERIOD), round(manoeuvre.duration / PERIOD)
    times = 0.5 * PERIOD * np.arange(-2 * lead, 2 * steps + 1)
    understeer = max(vehicle.wheelbase * understeer_coefficient(vehicle), 0.0)
    begun = np.maximum(times, 0.0)
    angle = manoeuvre.steering(begun, vehicle.wheelbase, understeer) * np.clip(2.0 + times / LEAD * 2.0, 0.0, 1.0)
    forward = np.where(times < 0.0, 0.0, manoeuvre.forward(begun))
    start = VehicleState(0.0, 0.0, manoeuvre.speed, 0.0, 0.0, 0.0)
    times_ns = np.round((times + LEAD) * 1e9).astype(np.int64)
    wheels = np.interp(times_ns, *corrected_steering(model, times_ns, angle, 0.1))
    path = predict(model, vehicle, start, InputSequence(wheels, forward), (lead + steps) * PERIOD, PERIOD)
    states = tuple(path.states[lead:].T)
    true = true_readings(model, vehicle, states)
    a_y = np.gradient(true.velocity_y, PERIOD) + true.velocity_x * true.yaw_rate
    kept = slice(2 * lead, None, 2)
    felt = added_acceleration(model, vehicle, states, wheels[kept], forward[kept])
    true = true._replace(acceleration_x=0.0 * a_y, acceleration_y=a_y + felt)
    seen = model.observe(true)
    time_ns = times_ns[kept] - times_ns[2 * lead]
    further = {name: CHANNELS[name].shown(seen, true) for name in FURTHER}
    return DriveLog(manoeuvre.name, time_ns, seen.x, seen.y, seen.yaw, seen.velocity_x, seen.velocity_y, seen.yaw_rate,
                    time_ns, angle[kept].copy(), acceleration_x=seen.acceleration_x, acceleration_y=seen.acceleration_y,
                    **further)
