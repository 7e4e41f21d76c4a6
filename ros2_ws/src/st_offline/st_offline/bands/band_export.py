"""Half-widths of a band as a CasADi function of state and inputs, for constraints tightened in a controller."""

import casadi
import numpy as np
from st_core.bands import Band
from st_core.bands.conditions import magnitudes
from st_core.bands.scale import features_of_one, floor_at, interpolation
from st_core.errors import ConfigurationError
from st_core.vehicle import VehicleParameters

MAX_LOG = 60.0
"""Of a squared scale: finite in floats, far beyond any error of a prediction."""


def half_width_function(band: Band, level: float, vehicle: VehicleParameters,
                        name: str = "half_widths") -> casadi.Function:
    """(x, u, steering_activity) -> (points, 3): along, across [m] and yaw [rad] at every point of the horizon.

    x: the six states at the CG. u: road_wheel_angle [rad], velocity_x_dot [m/s^2]. steering_activity [rad/s]: root mean
    square of the road wheel's rate over the last second. The numbers are those of `Band.half_widths`; the calibration
    domain is not checked. Raises ConfigurationError for a level that is not in the band.
    """
    if level not in band.factors:
        known = ", ".join(f"{one:g}" for one in band.factors)
        raise ConfigurationError(f"level {level:g}: the bands state {known}")
    x, u, activity = casadi.SX.sym("x", 6), casadi.SX.sym("u", 2), casadi.SX.sym("steering_activity")
    velocity_x = x[2] - x[5] * vehicle.cg_to_ins_y
    phi = casadi.vertcat(*features_of_one(magnitudes(velocity_x, x[5], u[1], activity), casadi.log, casadi.fmax))
    scale = band.scale
    between, floor = interpolation(scale.knots, scale.time), floor_at(scale.floor, scale.time)
    columns = []
    for axis, coefficients in enumerate(scale.coefficients):
        at_knots = casadi.fmin(casadi.fmax(2.0 * casadi.DM(coefficients) @ phi, -MAX_LOG), MAX_LOG)
        squared = casadi.exp(casadi.DM(between) @ at_knots) + casadi.DM(np.square(floor[:, axis]))
        columns.append(band.factors[level] * casadi.sqrt(squared))
    return casadi.Function(name, [x, u, activity], [casadi.horzcat(*columns)], ["x", "u", "steering_activity"],
                           ["half_widths"])
