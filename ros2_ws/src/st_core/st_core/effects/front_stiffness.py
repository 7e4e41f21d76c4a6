"""Error of the front cornering stiffness in the vehicle file."""

from dataclasses import replace

from ._base import Effect, Parameter, register


def make_stiffness_parameter(initial):
    """Parameter for the factor of a cornering stiffness. initial: its start value in a fit."""
    return Parameter("factor", "1", null=1.0, initial=initial, bounds=(0.3, 3.0),
                     meaning="ratio of true stiffness to the file's", model_error=0.04,
                     source="tyres of one size differ by a factor of 2; openpilot limits a factor of both to 0.2-5")


def scale_stiffness(vehicle, axle, factor):
    """The vehicle with the cornering stiffness of one axle, "front" or "rear", multiplied by a factor."""
    stiffness, tyre = getattr(vehicle, f"cornering_stiffness_{axle}"), getattr(vehicle, f"tyre_{axle}")
    return replace(vehicle, **{f"cornering_stiffness_{axle}": stiffness * factor,
                               f"tyre_{axle}": tyre._replace(lambda_ky=tyre.lambda_ky * factor)})


@register
class FrontStiffness(Effect):
    physics = "C_f = factor C_f of the file, peak force unchanged"
    excited_by = "cornering at two speeds, or transients; at one steady speed not separable from a steering gain"
    kind, slot = "vehicle parameters", "front axle"
    confounded_with = ("steering_compliance", "steering_ratio", "roll_steer", "mass", "friction", "tyre_stiffness")
    combinations = ("front cornering stiffness over mass", "stability factor K", "steady-state yaw gain at 20 m/s")
    ratio_to = ("mass", "cg_to_front_axle")
    parameter = make_stiffness_parameter(0.9)

    @staticmethod
    def vehicle(vehicle, theta):
        return scale_stiffness(vehicle, "front", theta.factor)
