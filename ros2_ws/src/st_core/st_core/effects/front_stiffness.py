"""Cornering stiffness of the front axle other than the vehicle file's."""

from dataclasses import replace

from ._base import Effect, Parameter, register


@register
class FrontStiffness(Effect):
    name = "front_stiffness"
    physics = "C_f = factor C_f of the file, the peak force unchanged"
    excited_by = "cornering at two speeds, or transients; one steady speed makes it a steering gain"
    kind, slot = "vehicle parameters", "front axle"
    twins = ("steering_compliance", "steering_ratio", "roll_steer", "mass", "friction", "tyre_stiffness")
    combinations = ("front cornering stiffness over mass", "understeer gradient K", "steady-state yaw gain at 20 m/s")
    ratio_to = "mass"
    parameters = (
        Parameter("factor", "1", null=1.0, initial=0.9, bounds=(0.3, 3.0), meaning="true stiffness over the file's",
                  source="tyres of one size spread by 2; openpilot learns 0.2-5 for both axles together",
                  model_error=0.04),
    )

    @staticmethod
    def vehicle(vehicle, theta):
        tyre = vehicle.tyre_front
        return replace(vehicle, cornering_stiffness_front=vehicle.cornering_stiffness_front * theta.factor,
                       tyre_front=tyre._replace(lambda_ky=tyre.lambda_ky * theta.factor))
