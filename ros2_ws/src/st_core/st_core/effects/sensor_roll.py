"""Motion of the INS point as the body rolls: an antenna on the roof moves to the outside of the bend.

    y_point = y - shift a_y,   v_y_point = v_y - shift v_x r_dot,   v_x_point = v_x + shift a_y r,   a_y = v_x r

shift is the height of the point above the roll axis times the roll angle per lateral acceleration. Roll is
quasi-static: its delay of about 50 ms is neglected, as is v_x_dot. Without yaw acceleration, as for a single live
sample, the lateral velocity is not corrected. Source: rigid-body kinematics, velocity of a point.
"""

from ..ops import cos, sin
from ._base import ANY, Effect, Parameter, register


def displace(measured, shift, speed):
    """Readings of a point displaced outwards by shift a_y; a_y: `speed` times yaw rate. speed: v_x of the car [m/s]."""
    yaw, to_left = measured.yaw, -shift * speed * measured.yaw_rate
    return measured._replace(x=measured.x - sin(yaw) * to_left, y=measured.y + cos(yaw) * to_left,
                             velocity_x=measured.velocity_x - to_left * measured.yaw_rate,
                             velocity_y=measured.velocity_y - shift * speed * measured.yaw_acceleration)


@register
class SensorRoll(Effect):
    physics = "body roll moves the INS point by shift a_y to the outside of the bend: v_y changes by -shift v_x r_dot"
    excited_by = "sweeps and fast corner entries, which cause a step in v_y of the INS"
    kind, slot = "sensors", "position"
    confounded_with = ("yaw_inertia", "tyre_relaxation")
    needs = ("velocity_y",)
    applies_to = ANY
    forward_only = True
    order = 5  # the point moves before the errors of its readings are added
    parameter = Parameter("shift", "m s^2/m", null=0.0, initial=0.005, bounds=(-0.005, 0.04),
                          meaning="outward shift per lateral acceleration: height above roll axis times roll gradient",
                          source="roll 0.3-0.8 deg per m/s^2; 0.3 m above the roll axis (seat) to 1.5 m (roof of a "
                                 "van)")

    @staticmethod
    def observe(measured, theta):
        return displace(measured, theta.shift, measured.velocity_x)

    @staticmethod
    def correct(measured, theta):
        speed = measured.velocity_x / (1.0 + theta.shift * measured.yaw_rate**2)
        return displace(measured, -theta.shift, speed)
