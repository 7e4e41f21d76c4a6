"""Error of the front cornering stiffness in the vehicle file."""

from dataclasses import replace

from ._base import Effect, Parameter, register


def make_stiffness_parameter(initial):
    """Parameter for the factor of a cornering stiffness. initial: its start value in a fit."""
    return Parameter("factor", "1", null=1.0, initial=initial, bounds=(0.3, 3.0),
                     meaning="ratio of true stiffness to the file's", model_error=0.04,
                     source="tyres of one size differ by a factor of 2; openpilot limits a common factor to 0.2-5")


def scale_axles(coefficient, *axles, entry=""):
    """The hook `vehicle` that multiplies a tyre coefficient of each given axle ("front", "rear") by the parameter
    `factor`; also the vehicle parameter <entry>_<axle>, if `entry` is given."""
    def scale(vehicle, theta):
        changes = {f"{entry}_{axle}": getattr(vehicle, f"{entry}_{axle}") * theta.factor for axle in axles if entry}
        for name in (f"tyre_{axle}" for axle in axles):
            tyre = getattr(vehicle, name)
            changes[name] = tyre._replace(**{coefficient: getattr(tyre, coefficient) * theta.factor})
        return replace(vehicle, **changes)
    return staticmethod(scale)


@register
class FrontStiffness(Effect):
    physics = "C_f = factor * C_f of the file, peak force unchanged"
    excited_by = "cornering at two speeds, or transients; at one steady speed not separable from a steering gain"
    kind, slot = "vehicle parameters", "front axle"
    confounded_with = ("steering_compliance", "steering_ratio", "roll_steer", "mass", "friction", "tyre_stiffness")
    combinations = ("front cornering stiffness over axle load", "stability factor K", "steady-state yaw gain at 20 m/s")
    ratio_to = ("mass", "cg_to_front_axle")
    parameter = make_stiffness_parameter(0.9)
    vehicle = scale_axles("lambda_ky", "front", entry="cornering_stiffness")
