"""Misalignment of the INS: its forward axis is rotated by `angle` to the left of the car's forward axis."""

from ..ops import cos, sin
from ._base import ANY, Effect, Parameter, register


@register
class HeadingMisalignment(Effect):
    physics = "measured yaw = yaw + angle, velocity and acceleration in the rotated axes; position unchanged"
    excited_by = "straight driving: v_y of the INS is -angle v_x"
    kind, slot = "sensors", "heading"
    confounded_with = ("steering_offset", "sensor_lever_arm")
    needs = ("velocity_y",)  # without it, yaw may be the direction of motion, which hides the misalignment
    applies_to = ANY
    order = 10
    parameter = Parameter("angle", "rad", null=0.0, initial=0.005, bounds=(-0.1, 0.1), odd=True,
                          meaning="reported heading too far to the left", source="mounting by eye: 1-2 deg",
                          identity="heading_misaligned")

    @staticmethod
    def observe(measured, theta):
        cosine, sine = cos(theta.angle), sin(theta.angle)
        return measured._replace(
            yaw=measured.yaw + theta.angle, velocity_x=cosine * measured.velocity_x + sine * measured.velocity_y,
            velocity_y=cosine * measured.velocity_y - sine * measured.velocity_x,
            acceleration_x=cosine * measured.acceleration_x + sine * measured.acceleration_y,
            acceleration_y=cosine * measured.acceleration_y - sine * measured.acceleration_x)
