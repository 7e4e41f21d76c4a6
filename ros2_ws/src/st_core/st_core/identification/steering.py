"""Ratio and offset of the steering from experiments.

Turntables measure the angles of both front wheels versus the steering-wheel angle, which yields the steering ratio:

    delta = (left + right) / 2,    delta_k = a_j + b delta_h,k + e_k,    i = 1 / b,    u(i) = i^2 u(b)

All J sweeps have a common slope b; sweep j has the intercept a_j and the mean x_j (`fit_line`, n points):

    u(b)^2 = s^2 / sum (x - x_j)^2,    s^2 = sum e^2 / (n - J - 1)

Turntables do not determine the steering-wheel offset, because their zero is not the direction of straight driving. A
cubic is fitted to the residuals and, if significant (F test, 1 %), reported as the nonlinearity of the steering. Angles
are in rad, positive to the left. Source: paper, parameter identification.

The offset of the steering wheel sensor is estimated from straight driving by two methods. Method of the paper: the
offset with which the predicted yaw rate agrees best with the measured one. Direct method: the mean reading in windows
of nearly constant steering, corrected for the remaining curvature kappa,

    o = mean(delta_h) - i L kappa (1 + K v_x^2),    kappa = change of heading / distance,    K: stability factor

A crowned road, crosswind or worn tyres bias both results. Checked by: test_identification_experiments.py (ratio),
test_identification_driving.py (offset).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as fisher

from ..handling import steady_state_steering
from ..log import DriveLog
from ..regression import Spread, make_blocks, symmetric_interval
from ..timeseries import filtered_derivative
from ..vehicle import VEHICLE_QUANTITIES, VehicleParameters
from .driving_fit import DrivingFitSettings, fit_driving
from .result import Coverage, Identification, IdentificationError, ParameterEstimate, describe_contradiction
from .run_samples import MAXIMUM_GAP, RunSamples, prepare_drives, sample_run

MIN_VARIATION = 1e-6  # minimum RMS of x about its group means, as a fraction of its RMS
MIN_ROWS = 5  # minimum number of rows of a turntable table
MIN_RANGE = math.radians(90.0)  # rad; minimum range of the steering wheel angle on turntables
MAX_STEERING_WHEEL_ANGLE = math.radians(1200.0)
MAX_ROAD_WHEEL_ANGLE = math.radians(60.0)
ANGLE_BIN_WIDTH = math.radians(90.0)
OFFSET, DIRECT_OFFSET = "steering_wheel_offset", "steering_wheel_offset_direct"
SETTINGS = DrivingFitSettings(horizon=2.0, maximum_acceleration=0.5, min_windows=40, channels=("yaw_rate",))
WINDOW = 2.0  # s; length of a window of the direct method
MIN_RADIUS = 500.0  # m; minimum radius of the path in a window, for a full-size car
MAX_ANGLE_DEVIATION = np.deg2rad(3.0)  # standard deviation of the steering wheel angle in a window
MIN_WINDOWS = 10  # minimum number of windows
CUTOFF = 1.0  # Hz; of the zero-phase low-pass on the measured yaw rate


@dataclass(frozen=True)
class Line:
    """Result of `fit_line`."""

    slope: float  # b
    uncertainty: float  # standard uncertainty of b
    intercepts: dict[str, float]  # a_j by group
    residuals: np.ndarray  # (n,)
    degrees_of_freedom: int


def fit_line(x: np.ndarray, y: np.ndarray, groups: Sequence[str]) -> Line:
    """Least-squares line. groups: group of each point. Raises IdentificationError for constant x or too few points."""
    masks = _group_columns(groups)
    design = np.column_stack([x, *masks.values()])
    degrees_of_freedom = len(x) - len(masks) - 1
    square_sum = float(sum(mask @ np.square(x - mask @ x / mask.sum()) for mask in masks.values()))
    if degrees_of_freedom < 1 or square_sum <= MIN_VARIATION**2 * float(x @ x):
        raise IdentificationError(f"{len(x)} rows in {len(masks)} series determine no slope: add rows at other angles")
    slope, *intercepts = np.linalg.lstsq(design, y, rcond=None)[0].tolist()
    residuals = y - design @ [slope, *intercepts]
    variance = float(residuals @ residuals) / degrees_of_freedom / square_sum
    return Line(slope, math.sqrt(variance), dict(zip(masks, intercepts, strict=True)), residuals, degrees_of_freedom)


def fit_cubic(x: np.ndarray, line: Line, groups: Sequence[str]) -> tuple[tuple[float, float], bool]:
    """((c_1, c_3) of a cubic fitted to the residuals e of a line; whether the cubic is significant).

        e = a'_j + c_1 x + c_3 x^3 + e_c,    F = (sum e^2 - sum e_c^2) / (sum e_c^2 / (n - J - 2))
    """
    design = np.column_stack([x, x**3, *_group_columns(groups).values()])
    coefficients, *_ = np.linalg.lstsq(design, line.residuals, rcond=None)
    cubic_residuals = line.residuals - design @ coefficients
    linear_sum, cubic_sum = float(line.residuals @ line.residuals), float(cubic_residuals @ cubic_residuals)
    degrees_of_freedom = line.degrees_of_freedom - 1
    if degrees_of_freedom < 1 or linear_sum <= 1e-20:
        return (0.0, 0.0), False
    f_ratio = (linear_sum - cubic_sum) / max(cubic_sum / degrees_of_freedom, 1e-20)
    return (float(coefficients[0]), float(coefficients[1])), bool(fisher.sf(f_ratio, 1, degrees_of_freedom) < 0.01)


def _group_columns(groups: Sequence[str]) -> dict[str, np.ndarray]:
    """Indicator column (n,) of each group, by name: 1 for its points, 0 for others."""
    return {str(name): (np.asarray(groups) == name).astype(float) for name in dict.fromkeys(groups)}


@dataclass(frozen=True)
class Turntable:
    """Angles (n,) of the steering wheel and of both front wheels [rad], positive to the left. sweeps: names, (n,)."""

    steering: np.ndarray
    left: np.ndarray
    right: np.ndarray
    sweeps: tuple[str, ...]


def identify_steering_ratio(data: Turntable) -> Identification:
    """Estimate of steering_ratio [1] from the slope of a line. Raises IdentificationError for an unusable table."""
    _check_rows(data)
    mean = 0.5 * (data.left + data.right)
    line = fit_line(data.steering, mean, data.sweeps)
    limits = VEHICLE_QUANTITIES["steering_ratio"]
    ratio = 1.0 / line.slope if line.slope else math.inf
    if not (limits.minimum <= ratio <= limits.maximum):
        hint = ("steering wheel and road wheels have opposite signs: left is positive in every column"
                if ratio < 0.0 else "are steering-wheel and road-wheel columns exchanged, or is a unit wrong?")
        raise IdentificationError(f"the steering wheel turns {ratio:.3g} times as far as the road wheels, not "
                                  f"{limits.minimum:g} to {limits.maximum:g}: {hint}")
    low, high = symmetric_interval(line.slope, line.uncertainty, line.degrees_of_freedom)
    cubic, significant = fit_cubic(data.steering, line, data.sweeps)
    used = tuple(dict.fromkeys(data.sweeps))
    span = math.degrees(data.steering.min()), math.degrees(data.steering.max())
    method = (f"turntables, {len(mean)} rows in {len(used)} sweep{'s' * (len(used) != 1)}, {span[0]:.0f} to "
              f"{span[1]:.0f} deg")
    largest = math.degrees(float(np.abs(line.residuals).max()))
    verdict = (f"The steering wheel turns {ratio:.2f} times as far as the mean of the front wheels; the straight line "
               f"deviates by at most {largest:.2f} deg at the road wheel.")
    if significant:
        verdict += f" The ratio is not constant: {1.0 / (line.slope + cubic[0]):.2f} on centre."
    estimate = ParameterEstimate("steering_ratio", ratio, "1", ratio**2 * line.uncertainty, (1.0 / high, 1.0 / low),
                                 method, used, verdict)
    first, last = data.steering.min() / ANGLE_BIN_WIDTH, data.steering.max() / ANGLE_BIN_WIDTH
    edges = ANGLE_BIN_WIDTH * np.arange(math.floor(first), math.ceil(last) + 1)
    coverage = Coverage("steering-wheel angle", "deg", np.degrees(edges), np.histogram(data.steering, edges)[0], 1, 2)
    figure = {"steering": data.steering, "left": data.left, "right": data.right, "mean": mean, "sweeps": data.sweeps,
              "slope": line.slope, "intercepts": line.intercepts, "residuals": line.residuals, "cubic": cubic,
              "significant": significant}
    return Identification("steering-ratio", (estimate,), used, (), None, (coverage,), tuple(_make_warnings(data, line)),
                          figure)


def _check_rows(data: Turntable) -> None:
    columns = {"steering wheel": (data.steering, MAX_STEERING_WHEEL_ANGLE),
               "left wheel": (data.left, MAX_ROAD_WHEEL_ANGLE), "right wheel": (data.right, MAX_ROAD_WHEEL_ANGLE)}
    if len(data.steering) < MIN_ROWS:
        raise IdentificationError(f"the table has {len(data.steering)} rows, at least {MIN_ROWS} are needed")
    for name, (angle, largest) in columns.items():
        if not np.isfinite(angle).all():
            raise IdentificationError(f"the {name} angle is missing in row {int(np.argmin(np.isfinite(angle))) + 1}")
        if np.abs(angle).max() > largest:
            raise IdentificationError(f"the {name} angle reaches {math.degrees(np.abs(angle).max()):.4g} deg, limit "
                                      f"{math.degrees(largest):.0f}: are the unit and the column correct?")
        if not np.ptp(angle) > 0.0:
            raise IdentificationError(f"the {name} angle is {math.degrees(angle[0]):.4g} deg in every row; vary it")
    if np.ptp(data.steering) < MIN_RANGE:
        raise IdentificationError(f"the steering wheel ranges over {math.degrees(np.ptp(data.steering)):.3g} deg, at "
                                  "least 90 deg are needed; if the column is in radians, name it steering_wheel_rad")


def _make_warnings(data: Turntable, line: Line) -> Iterator[str]:
    difference = data.left - data.right - np.median(data.left - data.right)
    turns = [difference[side * data.steering > ANGLE_BIN_WIDTH] for side in (1.0, -1.0)]
    if all(map(len, turns)) and (inner_excess := np.concatenate(turns).mean()) < -math.radians(0.3):
        yield (f"The outer wheel turns further than the inner one by {math.degrees(-inner_excess):.1f} deg on average: "
               "left and right columns may be exchanged. The ratio is not affected.")
    if len(line.intercepts) > 1:
        spread = math.degrees(max(line.intercepts.values()) - min(line.intercepts.values()))
        yield (f"The sweeps differ by up to {spread:.2f} deg at the road wheel. Possible causes are play, friction, "
               "and turntables zeroed between the sweeps.")


def identify_steering_offset(logs: Sequence[DriveLog], vehicle: VehicleParameters) -> Identification:
    """Offset at the steering wheel [rad], positive to the left, by both methods: parameters OFFSET, DIRECT_OFFSET.

    vehicle: its offset is the start value of the fit. Raises IdentificationError for too little straight driving.
    """
    logs, notes = prepare_drives(logs, vehicle)
    runs = [sample_run(log, vehicle) for log in logs]
    settings, min_radius = SETTINGS.for_car(vehicle), MIN_RADIUS * vehicle.speed_scale**2
    windows = [_find_straight_windows(run, vehicle, settings.minimum_speed, min_radius) for run in runs]
    values = np.concatenate([w[:, 1] for w in windows])
    if len(values) < MIN_WINDOWS:
        raise IdentificationError(
            f"too little straight driving: {len(values)} windows of {WINDOW:g} s have a radius above "
            f"{min_radius:.3g} m, a speed above {settings.minimum_speed:.3g} m/s, and constant steering; "
            f"{MIN_WINDOWS} are needed")
    # Without smoothing, road unevenness causes an error of 0.02 deg at the steering wheel even after four minutes.
    smoothed_logs = [replace(log, yaw_rate=filtered_derivative(
        log.ins_time_ns, log.yaw_rate, CUTOFF, MAXIMUM_GAP, "zero_phase")[0]) for log in logs]
    fit = fit_driving(smoothed_logs, vehicle, (OFFSET,), "linear", settings)
    predicted_runs = tuple(name for name, (count, _) in fit.window_counts.items() if count)
    paper = _make_estimate(OFFSET, fit.values[0], fit.spread, "predicted versus measured yaw rate (paper)",
                           predicted_runs, f"{fit.prediction_count} predictions on straights")

    run_index = np.concatenate([np.full(len(w), i) for i, w in enumerate(windows)])
    times = np.concatenate([w[:, 0] for w in windows])
    _, spread, _ = make_blocks(run_index, times).fit_least_squares(np.ones((len(values), 1)), values)
    averaged_runs = tuple(run.name for run, w in zip(runs, windows, strict=True) if len(w))
    direct = _make_estimate(DIRECT_OFFSET, float(values.mean()), spread, "mean reading on steady straights",
                            averaged_runs, f"{len(values)} windows of {WINDOW:g} s")
    conflict = describe_contradiction(paper, direct.value, direct.standard_uncertainty,
                                      "the mean reading on steady straights")
    if conflict:
        paper = replace(paper, status="doubtful", verdict=f"{paper.verdict} {conflict}")
    names = tuple(run.name for run in runs)
    used = tuple(name for name in names if name in predicted_runs or name in averaged_runs)
    rejected = tuple((name, "no straight driving") for name in names if name not in used)
    figure = {"time": times, "run": run_index, "offset": values, "residual_yaw_rate": fit.residuals["yaw_rate"]}
    return Identification("steering-offset", (paper, direct), used, rejected, None, (),
                          (*notes, *([conflict] if conflict else [])), figure)


def _find_straight_windows(run: RunSamples, vehicle: VehicleParameters, min_speed: float,
                           min_radius: float) -> np.ndarray:
    """(start time [s], offset [rad] at the steering wheel) of the steady straight windows of a run, (n, 2)."""
    rows = []
    for start in np.arange(run.time[0], run.time[-1] - WINDOW, WINDOW) if len(run) else ():
        part = slice(*np.searchsorted(run.time, (start, start + WINDOW)))
        time, angle, speed = run.time[part], run.steering_wheel_angle[part], run.velocity_x[part]
        if len(time) < 10 or time[-1] - time[0] < 0.9 * WINDOW or speed.min() < min_speed:
            continue
        mean_speed = float(speed.mean())
        curvature = float(run.yaw[part][-1] - run.yaw[part][0]) / (mean_speed * float(time[-1] - time[0]))
        if abs(curvature) * min_radius > 1.0 or angle.std() > MAX_ANGLE_DEVIATION:
            continue
        road_wheel_angle = steady_state_steering(mean_speed, curvature, vehicle)
        rows.append((start, float(angle.mean()) - vehicle.steering_ratio * road_wheel_angle))
    return np.array(rows).reshape(-1, 2)


def _make_estimate(name: str, value: float, spread: Spread, method: str, runs: tuple[str, ...],
                   basis: str) -> ParameterEstimate:
    uncertainty = float(spread.standard_errors[0])
    degrees, uncertainty_degrees = np.rad2deg(value), np.rad2deg(uncertainty)
    verdict = (f"The steering wheel reads {degrees:.2f} deg when driving straight, standard uncertainty "
               f"{uncertainty_degrees:.2f} deg, from {basis} in {spread.basis[0]}.")
    return ParameterEstimate(name, float(value), "rad", uncertainty, spread.interval(0, value), method, runs, verdict,
                             "identified" if uncertainty_degrees < 0.5 else "doubtful")
