"""Error of the INS position in the vehicle file."""

from dataclasses import replace

from ._base import ANY, REAR_STEERING, Effect, Parameter, register


@register
class SensorLeverArm(Effect):
    physics = "INS point = point of the file + (x, y) in body axes; its v_y increases by r x, its v_x by -r y"
    excited_by = "tight turns to both sides; v_y of the INS depends on x, v_x on y"
    kind, slot = "sensors", "position"
    confounded_with = ("cg_position", "heading_misalignment")
    needs = ("velocity_y",)  # without it, yaw may be the course, which hides x and y
    imitated_by = REAR_STEERING
    applies_to = ANY
    parameters = (
        Parameter("x", "m", null=0.0, initial=0.2, bounds=(-3.0, 3.0), meaning="INS further forward than in the file",
                  source="an INS at the rear axle or the front bumper, but assumed at the CG"),
        Parameter("y", "m", null=0.0, initial=0.1, bounds=(-1.0, 1.0), odd=True,
                  meaning="INS further to the left than in the file", source="half the width of a car"),
    )

    @staticmethod
    def vehicle(vehicle, theta):
        return replace(vehicle, cg_to_ins_x=vehicle.cg_to_ins_x + theta.x, cg_to_ins_y=vehicle.cg_to_ins_y + theta.y)
