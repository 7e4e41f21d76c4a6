"""Lever arm and misalignment of the INS, from slow driving.

The rear axle of a slow car moves in the direction of the heading, apart from a small slip angle. For an INS at a
distance d_x ahead of the CG and rotated by gamma to the left,

    v_y = -gamma v_x + (l_r + d_x) r - s v_x^2 r - e v_x dr/dt,    s = m l_f / (L C_r)

v_x, v_y: at the INS. Straights determine gamma, bends d_x, and bends at two speeds s [rad s^2/m], the magnitude of the
rear slip angle per lateral acceleration. The term with e [s^2] is due to the lateral motion of an INS above the roll
axis as the body rolls. An INS at d_y to the left of the CG is slower than the CG in left bends, faster in right bends:

    phi + c phi^3 = delta - K v_x r,    phi = atan(L r / (v_x + r d_y))

Ratio and offset of the steering, the understeer gradient K [rad s^2/m] and c are also fitted; the term with c is the
deviation of the mean road wheel angle from phi in tight bends. Checked by: test_identification_driving.py.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from ..handling import rear_slip_coefficient
from ..log import DriveLog
from ..regression import Blocks, Spread, correlation_matrix, make_blocks
from ..vehicle import VehicleParameters
from .driving_fit import MISALIGNMENT
from .result import Identification, ParameterEstimate, Status, describe_correlations
from .run_samples import SPEED_EDGES, RunSamples, measure_coverage, prepare_drives, require_coverage, sample_run

MINIMUM_SPEED, MAXIMUM_SPEED = 1.5, 9.0  # m/s
MAXIMUM_ACCELERATION = 2.5  # m/s^2, lateral
CURVATURE_EDGES = np.array([-0.3, -0.05, -0.02, -0.005, 0.005, 0.02, 0.05, 0.3])  # 1/m, positive to the left
MIN_CURVATURE = 0.03  # 1/m; d_y is not identifiable from wider bends
MIN_TIGHT_TIME = 5.0  # s of tight bends to each side
SAMPLE_INTERVAL = 0.1  # s; filtered samples at shorter intervals are redundant


def identify_ins_mounting(logs: Sequence[DriveLog], vehicle: VehicleParameters) -> Identification:
    """Estimates of cg_to_ins_x [m], ins_misalignment [rad, positive to the left], and with tight bends cg_to_ins_y [m].

    The lever arm of `vehicle` only affects sample selection. Raises IdentificationError for too few or unusable drives.
    """
    logs, notes = prepare_drives(logs, vehicle, "velocity_y")
    runs = [sample_run(log, vehicle) for log in logs]
    masks = [(run.velocity_x >= MINIMUM_SPEED) & (run.velocity_x <= MAXIMUM_SPEED)
             & (np.abs(run.velocity_x * run.yaw_rate) <= MAXIMUM_ACCELERATION) for run in runs]
    pairs, times = list(zip(runs, masks, strict=True)), [run.time for run in runs]
    coverage = (measure_coverage("speed", "m/s", SPEED_EDGES[:5], [run.velocity_x[m] for run, m in pairs], times, 5, 1),
                measure_coverage("curvature", "1/m", CURVATURE_EDGES,
                                 [run.yaw_rate[m] / run.velocity_x[m] for run, m in pairs], times, 2.0, 3))
    require_coverage(coverage, "Drive slowly (2 to 8 m/s): straight on, and left and right turns.")
    columns = [_make_columns(run, mask, vehicle) for run, mask in pairs]
    run_index = np.concatenate([np.full(len(c), i) for i, c in enumerate(columns)])
    time, speed, lateral, rate, rate_dot, angle = np.concatenate(columns).T
    blocks = make_blocks(run_index, time)
    used_runs = tuple(run.name for run, c in zip(runs, columns, strict=True) if len(c))

    regressors = np.stack([speed, rate, speed**2 * rate, speed * rate_dot], axis=1)
    theta, spread, _ = blocks.fit_least_squares(regressors, lateral)
    misalignment, rear_axle_to_ins, slip = -theta[0], theta[1], -theta[2]
    estimates = [
        _make_estimate("cg_to_ins_x", rear_axle_to_ins - vehicle.cg_to_rear_axle, spread, 1, 1.0, used_runs,
                       f"{rear_axle_to_ins:.3f} m ahead of the rear axle, if the rear wheels do not steer", 0.1),
        _make_estimate(MISALIGNMENT, misalignment, spread, 0, 1.0, used_runs,
                       f"{np.rad2deg(misalignment):+.2f} deg, reported heading minus the car's heading", 0.005)]
    correlation = correlation_matrix(spread.covariance[np.ix_([1, 0], [1, 0])] * np.array([[1, -1], [-1, 1]]))
    slip_correlation = correlation_matrix(spread.covariance)[1:3, 1:3]
    warnings = [*notes, *describe_correlations(["lever arm", "rear slip"], slip_correlation),
                _compare_rear_slip(slip, spread.covariance[2, 2], vehicle)]
    lateral_position = _estimate_lateral_position(speed, rate, angle, blocks, vehicle, used_runs)
    if isinstance(lateral_position, str):
        warnings.append(lateral_position)
    else:
        estimates.append(lateral_position)
        correlation = block_diag(correlation, 1.0)
    figure = {"curvature": rate / speed, "speed": speed, "run": run_index, "names": tuple(run.name for run in runs),
              "velocity_ratio": lateral / speed + slip * speed * rate - theta[3] * rate_dot, "theta": theta,
              "residual": lateral - regressors @ theta}
    rejected = tuple((run.name, f"{len(run) - int(mask.sum())} of {len(run)} samples outside {MINIMUM_SPEED:g} to "
                      f"{MAXIMUM_SPEED:g} m/s or above {MAXIMUM_ACCELERATION:g} m/s^2 of lateral acceleration")
                     for run, mask in pairs if not mask.all())
    return Identification("ins", tuple(estimates), used_runs, rejected, correlation, coverage,
                          tuple(w for w in warnings if w), figure)


def _make_columns(run: RunSamples, mask: np.ndarray, vehicle: VehicleParameters) -> np.ndarray:
    """(time, v_x, v_y, r, dr/dt, delta) at the INS [SI], (n, 6): one sample of the mask in each SAMPLE_INTERVAL."""
    rows = np.flatnonzero(mask)
    if len(rows):
        rows = rows[np.unique(np.floor(run.time[rows] / SAMPLE_INTERVAL), return_index=True)[1]]
    rate = run.yaw_rate[rows]
    return np.stack([run.time[rows], run.velocity_x[rows] - rate * vehicle.cg_to_ins_y,
                     run.velocity_y[rows] + rate * vehicle.cg_to_ins_x, rate, run.yaw_acceleration[rows],
                     run.road_wheel_angle[rows]], axis=1)


def _estimate_lateral_position(speed: np.ndarray, rate: np.ndarray, angle: np.ndarray, blocks: Blocks,
                               vehicle: VehicleParameters, used_runs: tuple[str, ...]) -> ParameterEstimate | str:
    """Estimate of cg_to_ins_y, or a warning if it is not identifiable."""
    curvature = rate / speed
    left, right = (np.count_nonzero(side * curvature > MIN_CURVATURE) * SAMPLE_INTERVAL for side in (1.0, -1.0))
    if min(left, right) < MIN_TIGHT_TIME:
        return (f"cg_to_ins_y is not estimated: the drives have {left:.0f} s of left and {right:.0f} s of right bends "
                f"tighter than R = {1 / MIN_CURVATURE:.0f} m; {MIN_TIGHT_TIME:g} s of each are needed.")
    d_y = 0.0
    for _ in range(4):  # the equation is nearly linear in d_y
        forward = speed + rate * d_y
        kinematic = np.arctan(vehicle.wheelbase * rate / forward)
        slope = -vehicle.wheelbase * rate**2 / (forward**2 + (vehicle.wheelbase * rate) ** 2)
        # delta_file = f (kinematic + c kinematic^3 + slope (d_y' - d_y) + K v r) + o;  d_y': the next value of d_y,
        # f: true steering ratio / ratio of the vehicle file
        regressors = np.stack([kinematic, slope, speed * rate, np.ones_like(speed), kinematic**3], axis=1)
        theta, spread, _ = blocks.fit_least_squares(regressors, angle)
        d_y += float(theta[1] / theta[0])
    return _make_estimate("cg_to_ins_y", d_y, spread, 1, float(1.0 / theta[0]), used_runs,
                          f"{d_y:+.3f} m from the CG, positive to the left, from turns to both sides", 0.1)


def _make_estimate(name: str, value: float, spread: Spread, index: int, factor: float,
                   used_runs: tuple[str, ...], description: str, max_uncertainty: float) -> ParameterEstimate:
    """Estimate whose standard uncertainty is |factor| times that of regression coefficient `index`."""
    uncertainty = float(abs(factor) * spread.standard_errors[index])
    unit = "rad" if name == MISALIGNMENT else "m"
    text = f"{np.rad2deg(uncertainty):.2g} deg" if name == MISALIGNMENT else f"{uncertainty:.2g} m"
    status: Status = "identified" if uncertainty < max_uncertainty else (
        "doubtful" if uncertainty < 5.0 * max_uncertainty else "unidentifiable")
    prefix = {"identified": "", "doubtful": "Poorly determined: ", "unidentifiable": "Not identifiable: "}[status]
    method = "steering versus curvature in tight bends" if name == "cg_to_ins_y" else "lateral velocity in slow driving"
    return ParameterEstimate(name, float(value), unit, uncertainty, spread.interval(index, value, uncertainty), method,
                             used_runs,
                             f"{prefix}{description}, standard uncertainty {text}, from {spread.basis[index]}.", status)


def _compare_rear_slip(slip: float, variance: float, vehicle: VehicleParameters) -> str:
    """Warning if s differs from the vehicle file by 2 or more standard errors; "" otherwise, or if s is uncertain."""
    expected = rear_slip_coefficient(vehicle)
    uncertainty = float(np.sqrt(variance))
    if uncertainty > 0.5 * expected or abs(slip - expected) < 2.0 * uncertainty:
        return ""
    return (f"The rear slip angle per lateral acceleration is {slip:.3g} rad s^2/m (standard uncertainty "
            f"{uncertainty:.2g}), but the vehicle file gives {expected:.3g}: check rear stiffness and rear load.")
