"""Identification of one tyre's Magic Formula from flat-plank tables: lateral force versus slip angle at several loads.

The equations are in `tyres.py`, with scale factors lambda of 1 and p_ey3 from the vehicle file (0 in the paper). A
shift added to the slip angle, common to all loads, absorbs conicity and plysteer and is then dropped.

As in the paper, stage 1 fits p_cy1, p_dy1, p_ey1 and the stiffness K at the load nearest to nominal_load, and stage 2
their load dependence p_dy2, p_ey2, p_ky2, p_ky4 (p_ky1 follows from K). Stage 2 treats the values of stage 1 as exact.
Therefore the reported values and intervals are from a simultaneous fit, started from the result of stage 2 and from
STARTS. With two loads, p_ky4 is taken from the vehicle file; with one load, p_dy2, p_ey2 and p_ky2 as well.

Slip angle [rad] and force [N] of one tyre in steady state may have either sign convention (`check_table`). Source:
paper, parameter identification and appendix. Checked by: test_identification_experiments.py.

The stiffness scale of the Magic Formula follows from the cornering stiffness C of an axle:

    lambda_ky = C / (2 |K|),   K: stiffness of one tyre with lambda_ky = 1 at its static load F_z
    (u(lambda) / lambda)^2 = (u(C) / C)^2 + (u(K) / K)^2 + (d ln K / d ln F_z)^2 (u(F_z) / F_z)^2

u(K) requires the tyre's flat-plank table, since the errors of p_ky1, p_ky2 and p_ky4 are strongly correlated and nearly
cancel in K. Source: paper, equation of lambda_Ky. Checked by: test_identification_result.py.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..regression import correlation_matrix, symmetric_interval
from ..tyres import MagicFormula, magic_formula_stiffness, stiffness_scale, tyre_force
from ..vehicle import TYRE_QUANTITIES, TYRES, VehicleParameters
from .bounded_fit import BoundedFit, Residuals, find_interval_end, fit_within_bounds
from .result import (
    Coverage,
    Identification,
    IdentificationError,
    ParameterEstimate,
    Status,
    describe_correlations,
    get_stated_uncertainty,
)

MIN_SLIP, MAX_SLIP = math.radians(3.0), math.radians(40.0)  # limits of the largest |slip angle| of a table
LEVEL_GAP = 0.04  # relative; loads closer than this are one level, since the load varies during a sweep
MIN_POINTS = 7  # minimum number of rows, and of slip angles at the nominal load, where five parameters are fitted
SLIP_BINS = np.radians([0.0, 0.75, 1.5, 3.0, 5.0, 8.0, 12.0, 20.0])  # rad; edges for the coverage of |slip angle|
MIN_FILLED_BINS = 3
SHIFT = "slip_shift"
# With p_ky4 < 1 the stiffness never reaches its maximum p_ky1 F_z0; with p_ky4 > 2 it changes its sign at some load.
FIT_BOUNDS = {SHIFT: (-math.radians(2.0), math.radians(2.0)), "p_ky4": (1.0, 2.0)}
NOMINAL_PARAMETERS = ("p_cy1", "p_dy1", "p_ey1")
STARTS = ((1.1, -0.5), (1.3, 0.2), (1.6, -0.5), (1.3, -3.0))  # start values (C, E) of the fit at the nominal load
FITTED_PARAMETERS = {"p_cy1": "Shape", "p_dy1": "Peak friction", "p_dy2": "Load dependence of peak friction",
                     "p_ey1": "Curvature", "p_ey2": "Load dependence of curvature", "p_ky1": "Stiffness",
                     "p_ky2": "Load at maximum stiffness", "p_ky4": "Curvature of stiffness versus load"}
LOAD_STEP = 1e-4  # relative step of F_z in the numerical derivative of K


@dataclass(frozen=True)
class FlatPlank:
    """A flat-plank table, (n,) each, in either sign convention."""

    tyre: str  # tyre_front or tyre_rear
    load: np.ndarray  # N
    slip: np.ndarray  # slip angle [rad]
    force: np.ndarray  # lateral force [N]
    name: str  # name of the data


def find_load_levels(data: FlatPlank) -> tuple[np.ndarray, np.ndarray]:
    """(mean load of each level (m,), ascending [N], level index of each row (n,)). Raises IdentificationError."""
    count = int((np.isfinite(data.load) & (data.load > 0.0)).sum())
    if count < max(MIN_POINTS, len(data.load)):
        raise IdentificationError(f"{data.tyre}: {count} of {len(data.load)} rows have a finite load above 0; at least "
                                  f"{MIN_POINTS} rows are needed, all with such a load: are load and force exchanged?")
    loads = np.sort(data.load)
    level = np.searchsorted(loads[1:][np.diff(loads) > LEVEL_GAP * loads[:-1]], data.load, side="right")
    return np.array([data.load[level == k].mean() for k in range(level.max() + 1)]), level


def check_table(data: FlatPlank, levels: np.ndarray, level: np.ndarray, nominal_load: float) -> tuple[FlatPlank, bool]:
    """(the table with slip angle and force of opposite signs, whether the sign of the slip angle was changed).

    levels, level: from `find_load_levels`. nominal_load [N]. Raises IdentificationError for an unusable table.
    """
    if not (np.isfinite(data.slip).all() and np.isfinite(data.force).all()):
        raise IdentificationError(f"{data.tyre}: every row needs a slip angle and a lateral force")
    if len(levels) > max(3, len(data.load) // 4):
        raise IdentificationError(f"{data.tyre}: {len(levels)} different loads in {len(data.load)} rows; a flat-plank "
                                  "test has a few loads. Are load and lateral force exchanged?")
    for k, value in enumerate(levels):
        if (level == k).sum() < 3:
            raise IdentificationError(f"{data.tyre}: {(level == k).sum()} rows at {value:.0f} N, but at least 3 are "
                                      "needed: add or remove rows; or are load and lateral force exchanged?")
    largest = float(np.abs(data.slip).max())
    if largest > MAX_SLIP:
        raise IdentificationError(f"{data.tyre}: slip angle reaches {largest:.4g} rad = {math.degrees(largest):.0f} "
                                  "deg, limit 40 deg: if the column is in degrees, name it slip_angle_deg")
    if largest < MIN_SLIP:
        raise IdentificationError(f"{data.tyre}: slip angle reaches only {math.degrees(largest):.3g} deg, at least 3 "
                                  "deg are needed; if the column is in radians, name it slip_angle_rad")
    ratio = float((np.abs(data.force) / data.load).max())
    if not 0.2 < ratio < 3.0:
        raise IdentificationError(f"{data.tyre}: the lateral force reaches {ratio:.3g} times the load, expected 0.2 to "
                                  "3 for a tyre: are the units in the header correct, or two columns exchanged?")
    nominal = int(np.argmin(np.abs(levels - nominal_load)))
    if abs(levels[nominal] - nominal_load) > 0.1 * nominal_load:
        raise IdentificationError(f"{data.tyre}: no load near nominal_load {nominal_load:.0f} N of the vehicle file, "
                                  f"the nearest is {levels[nominal]:.0f} N: test at that load, or change nominal_load")
    angle_count = len(np.unique(np.round(np.degrees(data.slip[level == nominal]), 2)))
    if angle_count < MIN_POINTS:
        raise IdentificationError(f"{data.tyre}: {angle_count} different slip angles at {levels[nominal]:.0f} N, at "
                                  f"least {MIN_POINTS} are needed")
    coverage = measure_slip_coverage(data, levels, level)[nominal]
    if not coverage.sufficient:
        raise IdentificationError(f"{data.tyre}: {coverage.describe()}")
    correlation = float(data.slip @ data.force / np.sqrt((data.slip @ data.slip) * (data.force @ data.force)))
    if abs(correlation) < 0.5:
        raise IdentificationError(f"{data.tyre}: the correlation of lateral force and slip angle is only "
                                  f"{correlation:+.2f}: are two columns exchanged, or is a sign missing?")
    return (replace(data, slip=-data.slip), True) if correlation > 0.0 else (data, False)


def measure_slip_coverage(data: FlatPlank, levels: np.ndarray, level: np.ndarray) -> tuple[Coverage, ...]:
    """Coverage of |slip angle|, one entry per load."""
    return tuple(Coverage(f"slip angle at {load:.0f} N", "deg", np.degrees(SLIP_BINS),
                          np.histogram(np.abs(data.slip[level == k]), SLIP_BINS)[0], 1, MIN_FILLED_BINS)
                 for k, load in enumerate(levels))


@dataclass(frozen=True)
class TyreFit:
    """A tyre fitted to a flat-plank table."""

    tyre: MagicFormula  # fitted Magic Formula
    names: tuple[str, ...]  # fitted parameters, SHIFT last
    fit: BoundedFit  # simultaneous fit, with the parameters in this order
    two_stage_tyre: MagicFormula  # the tyre after the paper's two stages, or after stage 1 with one load
    levels: np.ndarray  # mean load of each level [N]
    level: np.ndarray  # index of the level of each row
    sign_changed: bool  # whether the sign of the slip angles of the table was changed for the fit

    def compute_stiffness(self, load: float) -> tuple[float, float]:
        """K [N/rad], < 0, of one tyre at a load [N], and its standard uncertainty from the covariance of the fit."""
        value = magic_formula_stiffness(load, self.tyre)
        gradient = np.zeros(len(self.names))
        for k, name in enumerate(self.names):
            if name in ("p_ky1", "p_ky2", "p_ky4"):
                step = 1e-5 * abs(getattr(self.tyre, name))
                up = self.tyre._replace(**{name: getattr(self.tyre, name) + step})
                gradient[k] = (magic_formula_stiffness(load, up) - value) / step
        return float(value), float(math.sqrt(max(gradient @ self.fit.covariance @ gradient, 0.0)))


def fit_tyre(data: FlatPlank, start: MagicFormula) -> TyreFit:
    """Fit of a tyre in two stages, followed by a simultaneous fit. Raises IdentificationError for an unsuitable table.

    start: source of nominal_load and of all parameters that are not fitted; its scale factors are replaced by 1.
    """
    levels, level = find_load_levels(data)
    data, sign_changed = check_table(data, levels, level, start.nominal_load)
    base = start._replace(lambda_ky=1.0, lambda_cy=1.0, lambda_muy=1.0)
    nominal = int(np.argmin(np.abs(levels - start.nominal_load)))
    at_nominal = {key: getattr(data, key)[level == nominal] for key in ("load", "slip", "force")}
    two_stage_tyre = _fit_nominal_load(replace(data, **at_nominal), base)
    names: tuple[str, ...] = (*NOMINAL_PARAMETERS, "p_ky1", SHIFT)
    if len(levels) > 1:
        free = ("p_dy2", "p_ey2", "p_ky2") + (("p_ky4",) if len(levels) > 2 else ())
        two_stage_tyre = _fit_load_dependence(data, two_stage_tyre, free)
        names = (*(name for name in FITTED_PARAMETERS if name in (*NOMINAL_PARAMETERS, "p_ky1", *free)), SHIFT)
    # Shape and curvature are confounded, and the stages may end in a local minimum.
    others = [two_stage_tyre._replace(p_cy1=shape, p_ey1=curvature, p_ey2=-1.0) for shape, curvature in STARTS]
    fit = _fit(data, (two_stage_tyre, *others), names)
    tyre = _with_values(two_stage_tyre, names, fit.values.tolist())
    return TyreFit(tyre, names, fit, two_stage_tyre, levels, level, sign_changed)


def identify_magic_formula(data: FlatPlank, start: MagicFormula) -> Identification:
    """Estimates from `fit_tyre` (same exceptions), named as in the vehicle file, such as "tyre_front.p_ky1"."""
    tyre_fit = fit_tyre(data, start)
    fit, tyre = tyre_fit.fit, tyre_fit.tyre
    levels, level = tyre_fit.levels, tyre_fit.level
    data = replace(data, slip=-data.slip) if tyre_fit.sign_changed else data
    function = _make_residuals(data, tyre_fit.two_stage_tyre, tyre_fit.names)
    peak = float(np.abs(data.force).max())
    method = (f"flat plank, {len(data.load)} points at {', '.join(f'{x:.0f}' for x in levels)} N, nominal load first, "
              f"then all loads simultaneously, profile likelihood; residual {100 * fit.residual_deviation / peak:.2f} "
              "% of the largest force")
    estimates = []
    for k, name in enumerate(tyre_fit.names[:-1]):
        (low, low_open), (high, high_open) = (find_interval_end(function, fit, k, side) for side in (-1.0, 1.0))
        key = f"{data.tyre}.{name}"
        # For a normal distribution the interval is 3.92 standard errors wide; the covariance ignores bounds.
        value, uncertainty = float(fit.values[k]), (high - low) / 3.92
        open_ends = low_open + high_open
        verdict = [f"{FITTED_PARAMETERS[name]}."]
        status: Status = "doubtful" if fit.is_at_bound(k) or open_ends else "identified"
        if fit.is_at_bound(k):
            end = min(fit.lower[k], fit.upper[k], key=lambda bound: abs(bound - value))
            verdict.append(f"{key} is at a limit of its range, {end:g}: the limit, not the data, determines the value.")
        elif open_ends == 1:
            end = low if low_open else high
            verdict.append(f"The data determine only one end of the interval; the other is the limit {end:g}.")
        if open_ends == 2:
            verdict.append(f"The data do not determine {key} within {low:g} to {high:g}; the value is written because, "
                           "with the other parameters, it reproduces the forces at the tested loads.")
            uncertainty = (high - low) / math.sqrt(12.0)  # of a uniform distribution in the range
        estimates.append(ParameterEstimate(key, value, "1", uncertainty, (low, high), method, (data.name,),
                                           " ".join(verdict), status))
    correlation = correlation_matrix(fit.covariance)[:-1, :-1]
    grid = np.linspace(data.slip.min(), data.slip.max(), 121)
    figure = {"tyre": data.tyre, "slip": data.slip, "force": data.force, "levels": levels, "level": level,
              "residuals": fit.residuals, "grid": grid,
              "curves": np.stack([tyre_force(grid + fit.values[-1], load, tyre) for load in levels]),
              "stiffness": np.array([tyre_fit.compute_stiffness(load) for load in levels])}
    warnings = [*_make_warnings(data, tyre_fit, peak),
                *describe_correlations([e.parameter for e in estimates], correlation, 0.98)]
    return Identification("tyre", tuple(estimates), (data.name,), (), correlation,
                          measure_slip_coverage(data, levels, level), tuple(warnings), figure)


def _fit_nominal_load(data: FlatPlank, base: MagicFormula) -> MagicFormula:
    """The tyre after stage 1. The load dependence of `base` corrects for small differences from the nominal load."""
    inner = np.abs(data.slip) <= max(math.radians(2.0), np.sort(np.abs(data.slip))[min(3, len(data.slip) - 1)])
    slope = float(data.slip[inner] @ data.force[inner]) / float(data.slip[inner] @ data.slip[inner])
    mean_load = float(data.load.mean())
    start_p_ky1 = slope / abs(float(magic_formula_stiffness(mean_load, base._replace(p_ky1=-1.0))))
    friction = float(np.abs(data.force).max()) / mean_load
    names = (*NOMINAL_PARAMETERS, "p_ky1", SHIFT)
    starts = [base._replace(p_cy1=shape, p_dy1=friction, p_ey1=curvature, p_ky1=start_p_ky1)
              for shape, curvature in STARTS]
    return _with_values(base, names, _fit(data, starts, names).values.tolist())


def _fit_load_dependence(data: FlatPlank, nominal_tyre: MagicFormula, names: Sequence[str]) -> MagicFormula:
    """The tyre after stage 2. K at the nominal load is fixed, which determines p_ky1 from p_ky2 and p_ky4."""
    stiffness = float(magic_formula_stiffness(nominal_tyre.nominal_load, nominal_tyre))

    def make_tyre(values: Any) -> MagicFormula:
        changed_tyre = _with_values(nominal_tyre, names, values)
        unit_stiffness = magic_formula_stiffness(nominal_tyre.nominal_load, changed_tyre._replace(p_ky1=-1.0))
        return changed_tyre._replace(p_ky1=-stiffness / unit_stiffness)

    def compute_residuals(values: np.ndarray) -> np.ndarray:
        return tyre_force(data.slip, data.load, make_tyre(values)) - data.force

    low, high = _get_bounds(names)
    start = {"p_dy2": -0.1, "p_ey2": 0.0, "p_ky2": 2.0, "p_ky4": 2.0}
    return make_tyre(fit_within_bounds(compute_residuals, [[start[k] for k in names]], low, high).values.tolist())


def _fit(data: FlatPlank, starts: Sequence[MagicFormula], names: Sequence[str]) -> BoundedFit:
    low, high = _get_bounds(names)
    start_vectors = [[0.0 if name == SHIFT else getattr(start, name) for name in names] for start in starts]
    return fit_within_bounds(_make_residuals(data, starts[0], names), start_vectors, low, high)


def _make_residuals(data: FlatPlank, start: MagicFormula, names: Sequence[str]) -> Residuals:
    def compute_residuals(values: np.ndarray) -> np.ndarray:
        return tyre_force(data.slip + values[-1], data.load, _with_values(start, names, values)) - data.force

    return compute_residuals


def _with_values(tyre: MagicFormula, names: Sequence[str], values: Any) -> MagicFormula:
    """The tyre with values in the order of names, without SHIFT."""
    return tyre._replace(**{name: value for name, value in zip(names, values, strict=True) if name != SHIFT})


def _get_bounds(names: Sequence[str]) -> tuple[list[float], list[float]]:
    """Lower and upper bounds from FIT_BOUNDS, or else the limits of a vehicle file."""
    limits = [FIT_BOUNDS.get(name) or (TYRE_QUANTITIES[name].minimum, TYRE_QUANTITIES[name].maximum) for name in names]
    return [low for low, _ in limits], [high for _, high in limits]


def _make_warnings(data: FlatPlank, tyre_fit: TyreFit, peak: float) -> Iterator[str]:
    if tyre_fit.sign_changed:
        yield "Force and slip angle have equal signs in the table: the sign of the slip angle was changed."
    if (loads := len(tyre_fit.levels)) < 3:
        fixed_parameters = "p_ky4 is" if loads == 2 else "p_dy2, p_ey2, p_ky2 and p_ky4 are"
        yield f"The table has only {loads} load{'s' * (loads > 1)}: {fixed_parameters} taken from the vehicle file."
    shift, uncertainty = tyre_fit.fit.values[-1], tyre_fit.fit.standard_errors[-1]
    if abs(shift) > 3.0 * uncertainty and abs(shift) > math.radians(0.02):
        yield (f"The curves are shifted by {math.degrees(shift):+.2f} deg of slip angle (conicity, plysteer, or a "
               "wrong zero of the wheel angle); the models' tyre is symmetric.")
    grid = np.linspace(data.slip.min(), data.slip.max(), 61)
    largest = max(float(np.abs(tyre_force(grid, load, tyre_fit.two_stage_tyre)
                               - tyre_force(grid, load, tyre_fit.tyre)).max()) for load in tyre_fit.levels)
    if largest > 0.01 * peak:
        yield (f"The two-stage and the simultaneous fit differ by up to {largest:.0f} N, {100 * largest / peak:.1f} % "
               "of the largest force: the load dependence of the formula does not fit all loads equally well.")


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
        provenance = vehicle.provenance.get(key)
        if provenance is None or not provenance.uncertainty:
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
        relative_uncertainty = math.hypot(provenance.uncertainty / stiffness, table_uncertainty,
                                          load_sensitivity * load_uncertainty)
        uncertainty = value * relative_uncertainty
        cause = ("a possible cause is steering and suspension compliance." if value < 1.0 else "compliance cannot "
                 "make an axle stiffer than its tyres: the stiffness is wrong, or the surface or the pressure differs.")
        verdict = (f"The {axle} axle is {value:.3f} times as stiff as its two tyres on the flat plank at {load:.0f} N: "
                   f"{cause}")
        status: Status = "identified" if value <= 1.0 + 2.0 * relative_uncertainty else "doubtful"
        runs = tuple(filter(None, (provenance.data, table_name)))
        method = f"C / (2 K) at the static load {load:.0f} N, C {stiffness:.0f} N/rad"
        estimates.append(ParameterEstimate(f"{tyre}.lambda_ky", value, "1", uncertainty,
                                           symmetric_interval(value, uncertainty), method, runs, verdict, status))
        if tyre not in tables:
            warnings.append(f"No table of {tyre} was given: its flat-plank stiffness is assumed exact.")
    used = tuple(dict.fromkeys(run for e in estimates for run in e.runs))
    return Identification("lambda", tuple(estimates), used, (), None, (), tuple(warnings))
