"""Error of the longitudinal CG position in the vehicle file; axles and INS do not move relative to the body."""

from dataclasses import replace

from ._base import ANY, FORCE_COMBINATIONS, Effect, Parameter, register


@register
class CgPosition(Effect):
    physics = "l_f = l_f of the file - shift, l_r = l_r of the file + shift"
    excited_by = "cornering with measured sideslip, at two speeds"
    kind, slot = "vehicle parameters", "body"
    confounded_with = ("rear_stiffness", "front_stiffness", "sensor_lever_arm")
    combinations = FORCE_COMBINATIONS
    applies_to = ANY
    parameter = Parameter("shift", "m", null=0.0, initial=0.1, bounds=(-0.5, 0.5),
                          meaning="CG further forward than in the file",
                          source="a load in the boot moves it by 0.1-0.2 m")

    @staticmethod
    def vehicle(vehicle, theta):
        return replace(vehicle, cg_to_front_axle=vehicle.cg_to_front_axle - theta.shift,
                       cg_to_ins_x=vehicle.cg_to_ins_x - theta.shift)
