"""Stiffness scale of the Magic Formula from the cornering stiffness C of an axle.

    lambda_ky = C / (2 |K|),   K: stiffness of one tyre with lambda_ky = 1 at its static load F_z
    (u(lambda) / lambda)^2 = (u(C) / C)^2 + (u(K) / K)^2 + (d ln K / d ln F_z)^2 (u(F_z) / F_z)^2

u(K) requires the tyre's flat-plank table: errors of p_ky1, p_ky2 and p_ky4 are strongly correlated and nearly cancel in
K, so it cannot be computed from their separate uncertainties. Source: paper, equation of lambda_Ky. Checked by:
test_identification_result.py.
"""

import math
from collections.abc import Mapping

from ..regression import symmetric_interval
from ..tyres import magic_formula_stiffness, stiffness_scale
from ..vehicle import TYRES, VehicleParameters
from .result import Identification, IdentificationError, ParameterEstimate, Status, get_stated_uncertainty

LOAD_STEP = 1e-4  # relative step of F_z in the numerical derivative of K


def identify_lambda_ky(vehicle: VehicleParameters, tables: Mapping[str, tuple[float, str]]) -> Identification:
    """Estimates of tyre_front.lambda_ky and tyre_rear.lambda_ky [1].

    tables: by tyre, relative standard uncertainty [1] of K at the static load, and name of the flat-plank table;
    without a table, K is assumed exact. Raises IdentificationError if an axle stiffness of the vehicle file has no
    uncertainty: the scale would then be a conversion, not an identification.
    """
    estimates, warnings = [], []
    for tyre in TYRES:
        axle = tyre.removeprefix("tyre_")
        key = f"cornering_stiffness_{axle}"
        stated = vehicle.provenance.get(key)
        if stated is None or not stated.uncertainty:
            raise IdentificationError(f"{key} of the vehicle file has no uncertainty: identify the stiffness first "
                                      "and use the resulting vehicle.yaml. (If a file has no lambda_ky, it is derived "
                                      "from the stiffness.)")
        stiffness = getattr(vehicle, key)
        load = getattr(vehicle, f"static_tyre_load_{axle}")
        formula = getattr(vehicle, tyre)
        value = stiffness_scale(stiffness, load, formula)
        table_uncertainty, table_name = tables.get(tyre, (0.0, ""))
        up, down = (math.log(abs(magic_formula_stiffness(load * (1.0 + step), formula)))
                    for step in (LOAD_STEP, -LOAD_STEP))
        # Relative standard uncertainty of F_z, which is proportional to m l_r (front) or m l_f (rear), with fixed l.
        distance = vehicle.cg_to_rear_axle if axle == "front" else vehicle.cg_to_front_axle
        load_uncertainty = math.hypot(*(
            get_stated_uncertainty(vehicle, key) / size
            for key, size in (("mass", vehicle.mass), ("cg_to_front_axle", distance))))
        load_sensitivity = (up - down) / (2.0 * LOAD_STEP)  # d ln K / d ln F_z
        relative_uncertainty = math.hypot(stated.uncertainty / stiffness, table_uncertainty,
                                          load_sensitivity * load_uncertainty)
        uncertainty = value * relative_uncertainty
        cause = ("a possible cause is steering and suspension compliance." if value < 1.0 else "compliance cannot "
                 "make an axle stiffer than its tyres, so surface, temperature or inflation pressure differs.")
        verdict = (f"The {axle} axle is {value:.3f} times as stiff as its two tyres on the flat plank at {load:.0f} N: "
                   f"{cause}")
        status: Status = "identified" if value <= 1.0 + 2.0 * relative_uncertainty else "doubtful"
        runs = tuple(filter(None, (stated.data, table_name)))
        method = f"C / (2 K) at the static load {load:.0f} N, C {stiffness:.0f} N/rad"
        estimates.append(ParameterEstimate(f"{tyre}.lambda_ky", value, "1", uncertainty,
                                           symmetric_interval(value, uncertainty), method, runs, verdict, status))
        if tyre not in tables:
            warnings.append(f"No table of {tyre} was given: its flat-plank stiffness is assumed exact.")
    used = tuple(dict.fromkeys(run for e in estimates for run in e.runs))
    return Identification("lambda", tuple(estimates), used, (), None, (), tuple(warnings))
