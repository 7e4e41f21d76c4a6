"""Cornering stiffness of the rear axle other than the vehicle file's."""

from dataclasses import replace

from ._base import Effect, Parameter, register


@register
class RearStiffness(Effect):
    name = "rear_stiffness"
    physics = "C_r = factor C_r of the file, the peak force unchanged"
    excited_by = "cornering with the sideslip measured, and sweeps; it sets the damping in yaw"
    kind, slot = "vehicle parameters", "rear axle"
    twins = ("front_stiffness", "cg_position", "friction", "tyre_stiffness")
    combinations = ("rear cornering stiffness over mass", "understeer gradient K", "steady-state yaw gain at 20 m/s")
    ratio_to = "mass"
    parameters = (
        Parameter("factor", "1", null=1.0, initial=0.85, bounds=(0.3, 3.0), meaning="true stiffness over the file's",
                  source="tyres of one size spread by 2; openpilot learns 0.2-5 for both axles together",
                  model_error=0.04),
    )

    @staticmethod
    def vehicle(vehicle, theta):
        tyre = vehicle.tyre_rear
        return replace(vehicle, cornering_stiffness_rear=vehicle.cornering_stiffness_rear * theta.factor,
                       tyre_rear=tyre._replace(lambda_ky=tyre.lambda_ky * theta.factor))
