"""Roll steer of the front wheels: delta = delta_measured - gradient a_f.

a_f is the lateral acceleration filtered by the second-order roll motion of the body:

    a_f_ddot = (2 pi f)^2 (a_y - a_f) - 2 zeta 2 pi f a_f_dot,   a_y = (F_f cos delta + F_r) / m

The change of delta acts only on the slip angle. Its effect on the direction of the force is neglected: 0.1 % of the
force for a change of 0.01 rad at delta = 0.1 rad.
"""

from math import tau

from ..ops import cos
from ._base import Effect, Parameter, register


@register
class RollSteer(Effect):
    physics = "delta = delta_measured - gradient a_y, delayed by body roll; adds gradient to the understeer gradient"
    excited_by = "sweeps, in which the roll lags; in steady cornering not separable from a softer front axle"
    kind, slot = "physics", "front axle"
    confounded_with = ("steering_compliance", "steering_ratio", "front_stiffness")
    combinations = ("front cornering stiffness over axle load", "stability factor K", "steady-state yaw gain at 20 m/s")
    extra_states = ("filtered_lateral_acceleration", "filtered_lateral_acceleration_rate")
    extra_units = ("m/s^2", "m/s^3")
    order = 60
    parameters = (
        Parameter("gradient", "rad s^2/m", null=0.0, initial=0.0005, bounds=(-0.005, 0.005),
                  meaning="steer angle to the outside per lateral acceleration, positive for understeer",
                  source="roll 0.3-0.5 deg per m/s^2, roll steer 0-10 %, of either sign in racing cars"),
        Parameter("frequency", "Hz", null=2.0, initial=2.0, bounds=(0.8, 4.0), fit=False,
                  meaning="natural frequency of body roll", source="passenger cars 1.5-2.5 Hz"),
        Parameter("damping", "1", null=0.4, initial=0.4, bounds=(0.05, 1.0), fit=False,
                  meaning="damping ratio of body roll", source="passenger cars 0.3-0.5"),
    )

    @staticmethod
    def constants(vehicle):
        return vehicle.mass

    @staticmethod
    def slip_angles(slip_front, slip_rear, extra, instant, prepared, theta):
        return slip_front + theta.gradient * extra[0], slip_rear

    @staticmethod
    def start(slips, instant, prepared, theta):
        return instant.velocity_x * instant.yaw_rate, 0.0 * instant.velocity_x

    @staticmethod
    def rates(extra, slips, forces, instant, prepared, theta):
        a_f, a_f_dot = extra
        a_y = (forces[0] * cos(instant.road_wheel_angle) + forces[1]) / theta.constants
        omega = tau * theta.frequency
        return a_f_dot, omega * (omega * (a_y - a_f) - 2.0 * theta.damping * a_f_dot)
