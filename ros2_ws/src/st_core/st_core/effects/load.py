"""Passengers and luggage, modelled as a mass over the rear axle, in addition to the car of the vehicle file.

    m' = m + load,  b = load l_r / m',  l_f' = l_f + b,  l_r' = l_r - b,  I_z' = I_z + m b^2 + load (l_r - b)^2

A load further forward acts like a smaller load over the rear axle. The axle loads change the tyre forces of the
nonlinear model, but not the stiffnesses of the linear model.
"""

from dataclasses import replace

from ._base import FORCE_COMBINATIONS, Effect, Parameter, register


@register
class Load(Effect):
    physics = "m = m of the file + a load over the rear axle, which also changes CG and yaw inertia"
    excited_by = "cornering with measured sideslip, at two speeds; weigh the laden car to confirm it"
    kind, slot = "vehicle parameters", "body"
    confounded_with = ("mass", "cg_position", "rear_stiffness", "tyre_stiffness", "yaw_inertia")
    combinations = FORCE_COMBINATIONS
    parameter = Parameter("mass", "kg", null=0.0, initial=150.0, bounds=(0.0, 800.0),
                          meaning="mass of a load over the rear axle",
                          source="payload: passenger cars 400-550 kg (2 sigma), vans 800 kg", deviation=250.0)

    @staticmethod
    def vehicle(vehicle, theta):
        mass = vehicle.mass + theta.mass
        to_rear = vehicle.cg_to_rear_axle
        shift = theta.mass * to_rear / mass
        return replace(
            vehicle, mass=mass, cg_to_front_axle=vehicle.cg_to_front_axle + shift,
            cg_to_ins_x=vehicle.cg_to_ins_x + shift,
            yaw_inertia=vehicle.yaw_inertia + vehicle.mass * shift**2 + theta.mass * (to_rear - shift) ** 2)
