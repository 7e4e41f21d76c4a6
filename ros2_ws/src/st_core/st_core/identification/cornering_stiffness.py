"""Axle cornering stiffnesses by regression of measured axle forces on slip angles.

    F_f cos(delta) = (l_r m a_y + I_z r_dot) / L,    F_r = (l_f m a_y - I_z r_dot) / L

follow from the force and moment balance of the single-track car, with a_y at the CG, and the slip angles from the
velocity at each axle. The stiffness is the slope of force versus slip; an intercept absorbs offsets of steering and
INS. Slow and nearly straight driving, |a_y| above 4 m/s^2 and slip angles above 2 deg are left out.

The slope is a mean over the slip range: it is below the stiffness at zero slip if the tyre saturates in that range, or
if the slip angle is noisy. `AxleRegression.model_error` is the resulting standard uncertainty of the stiffness at zero
slip, from a second regression in the lower half of the slip range (`regression.extrapolation_uncertainty`). Source:
paper, section on parameter identification. Checked by: test_identification_driving.py, test_axle_curve.py,
test_stiffness_model_error.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from .. import models
from ..log import DriveLog
from ..regression import Spread, extrapolation_uncertainty, make_blocks
from ..vehicle import VehicleParameters
from .result import Coverage, Identification, IdentificationError, ParameterEstimate, Status, describe_correlations
from .run_samples import (
    ACCELERATION_EDGES,
    SPEED_EDGES,
    RunSamples,
    measure_coverage,
    prepare_drives,
    require_coverage,
    sample_run,
)

AXLES = ("front", "rear")
METHOD = "regression of axle force on slip angle (paper)"
MIN_SPEED, MAX_RADIUS, MAX_ACCELERATION = 3.0, 300.0, 4.0  # m/s, m, m/s^2
MAX_SLIP = np.deg2rad(2.0)
MIN_AXLE_SAMPLES = 500  # minimum number of samples in a regression
SLIP_BIN_COUNT = 12
MAX_RANGE_RATIO = 0.8  # mean slip in the lower / in the full range; above it, extrapolation multiplies errors by over 5
MAX_RELATIVE_UNCERTAINTY = 0.1  # ratio of standard uncertainty to stiffness above which the stiffness is doubtful
SLIP_QUANTILE = 0.995  # quantile of |slip angle| that counts as the largest slip angle of the drives


class Slope(NamedTuple):
    """Slope of the force of an axle versus its slip angle."""

    stiffness: float  # C [N/rad]
    spread: Spread  # of (C, intercept)
    blocks: np.ndarray  # index of each block
    influence: np.ndarray  # of each block on C


@dataclass(frozen=True, eq=False)
class AxleSamples:
    """Samples (n,) of an axle; slip angle and force have opposite signs."""

    axle: str
    slip: np.ndarray  # slip angle [rad]
    force: np.ndarray  # N
    run_of: np.ndarray  # index of the run
    time: np.ndarray  # s
    used: np.ndarray  # whether a sample is used in the regression

    def bin_forces(self) -> tuple[np.ndarray, np.ndarray]:
        """(mean slip, mean force opposing it) in each bin of |slip|, (b,) each.

        The slip at zero force, which is due to offsets of steering and INS, is subtracted first. Bins are left out
        if they have fewer than 5 samples, or less than 1 % of those that a uniform distribution would have there.
        """
        slip = self.slip - self.find_zero_force_slip()
        size, force = np.abs(slip), -self.force * np.sign(slip)
        bins = np.digitize(size, np.linspace(0.0, float(np.quantile(size, SLIP_QUANTILE)), SLIP_BIN_COUNT + 1)) - 1
        members = [bins == k for k in range(SLIP_BIN_COUNT)]
        members = [member for member in members if member.sum() >= max(0.01 * len(size) / SLIP_BIN_COUNT, 5)]
        return (np.array([size[member].mean() for member in members]),
                np.array([force[member].mean() for member in members]))

    def find_zero_force_slip(self) -> float:
        """Slip at zero force [rad], by linear regression; 0 if the force does not oppose the slip."""
        use = self.used if self.used.sum() >= 10 else np.ones(len(self.slip), bool)
        slope, intercept = np.polyfit(self.slip[use], -self.force[use], 1)
        return float(-intercept / slope) if slope > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class AxleRegression:
    """Result of the regression of one axle. stiffness, standard_error, interval95 [N/rad]: NaN if it failed."""

    axle: str
    stiffness: float
    standard_error: float
    interval95: tuple[float, float]
    samples: AxleSamples  # all samples above the minimum speed
    reasons: tuple[str, ...]  # why the value is rejected; empty for a usable value
    basis: str  # text on the number of samples and blocks
    model_error: float = float("nan")  # standard uncertainty at zero slip [N/rad], see the module; NaN if unknown

    @property
    def usable(self) -> bool:
        return not self.reasons

    @property
    def uncertainty(self) -> float:
        """Standard uncertainty of the stiffness at zero slip [N/rad], including the model error if it is known."""
        return float(np.hypot(self.standard_error, np.nan_to_num(self.model_error)))

    def estimate(self, runs: tuple[str, ...]) -> ParameterEstimate:
        """Estimate of the stiffness at zero slip, with the Student quantile of interval95."""
        half = 0.5 * (self.interval95[1] - self.interval95[0]) * self.uncertainty / max(self.standard_error, 1e-300)
        status: Status = "identified" if self.uncertainty < MAX_RELATIVE_UNCERTAINTY * self.stiffness else "doubtful"
        if self.reasons:
            text, status = "; ".join(self.reasons), "unidentifiable"
            verdict = f"{text[0].upper()}{text[1:]}."
        else:
            slip = np.rad2deg(np.quantile(np.abs(self.samples.slip[self.samples.used]), SLIP_QUANTILE))
            model_error = (f"a model error of {100 * self.model_error / self.stiffness:.1f} % is included"
                           if np.isfinite(self.model_error) else "its dependence on the slip range is unknown")
            verdict = (f"{self.stiffness:.0f} N/rad, standard uncertainty "
                       f"{100 * self.uncertainty / self.stiffness:.1f} %, from {self.basis}. Secant over slip angles "
                       f"up to {slip:.1f} deg, compliance and roll steer included; {model_error}.")
        return ParameterEstimate(f"cornering_stiffness_{self.axle}", self.stiffness, "N/rad", self.uncertainty,
                                 (self.stiffness - half, self.stiffness + half), METHOD, runs, verdict, status)


def compute_measured_forces(samples: RunSamples, vehicle: VehicleParameters) -> tuple[np.ndarray, np.ndarray]:
    """Lateral forces of (front, rear) axle [N] along the lateral axis of the wheels, left +; see the module."""
    lateral = vehicle.mass * samples.lateral_acceleration / vehicle.wheelbase
    yaw = vehicle.yaw_inertia * samples.yaw_acceleration / vehicle.wheelbase
    return ((vehicle.cg_to_rear_axle * lateral + yaw) / np.cos(samples.road_wheel_angle),
            vehicle.cg_to_front_axle * lateral - yaw)


def compute_slip_angles(samples: RunSamples, vehicle: VehicleParameters) -> tuple[np.ndarray, np.ndarray]:
    """Slip angles of (front, rear) axle [rad], + when the wheels travel to their left (`models.slip_angles`)."""
    angle = samples.road_wheel_angle
    state = 0.0, 0.0, samples.velocity_x, samples.velocity_y, 0.0, samples.yaw_rate  # position and yaw have no effect
    return models.slip_angles(state, (np.sin(angle), np.cos(angle)), vehicle)


def fit_axle_regressions(logs: Sequence[DriveLog], vehicle: VehicleParameters) -> tuple[AxleRegression, AxleRegression]:
    """Regressions of (front, rear) axle on drives with measured sideslip.

    vehicle: its mass, inertia, lengths, lever arm and steering are used and must be correct; its stiffnesses are not
    used. Raises IdentificationError for no drive, a repeated name, or a drive that is too short.
    """
    drives, _ = prepare_drives(logs, vehicle)
    return _fit_regressions([sample_run(log, vehicle) for log in drives], vehicle)[0]


def _fit_regressions(runs: Sequence[RunSamples], vehicle: VehicleParameters) -> tuple[
        tuple[AxleRegression, AxleRegression], tuple[Coverage, ...], np.ndarray, tuple[tuple[str, str], ...]]:
    """(regressions, coverage, correlation of the two stiffnesses (2, 2), (run, reason why samples are left out))."""
    masks, rejected, times = [], [], [run.time for run in runs]
    for run in runs:
        slow = np.abs(run.velocity_x) < MIN_SPEED
        straight = ~slow & (np.abs(run.yaw_rate) * MAX_RADIUS < np.abs(run.velocity_x))
        hard = ~slow & ~straight & (np.abs(run.lateral_acceleration) > MAX_ACCELERATION)
        masks.append(~(slow | straight | hard))
        reasons = {f"slower than {MIN_SPEED:g} m/s": slow, f"straighter than R = {MAX_RADIUS:g} m": straight,
                   f"beyond {MAX_ACCELERATION:g} m/s^2": hard}
        rejected += [(run.name, f"{int(mask.sum())} of {len(run)} samples {reason}")
                     for reason, mask in reasons.items() if mask.any()]
    covered = (
        measure_coverage("cornering speed", "m/s", SPEED_EDGES,
                         [run.velocity_x[m] for run, m in zip(runs, masks, strict=True)], times, 2.0, 1),
        measure_coverage("lateral acceleration", "m/s^2", ACCELERATION_EDGES,
                         [run.lateral_acceleration[m] for run, m in zip(runs, masks, strict=True)], times, 1.0, 3))
    insufficient = "; ".join(c.describe() for c in covered if not c.sufficient)
    samples = []
    for index, name in enumerate(AXLES):
        rows = []
        for number, (run, mask) in enumerate(zip(runs, masks, strict=True)):
            slip, force = compute_slip_angles(run, vehicle)[index], compute_measured_forces(run, vehicle)[index]
            fast = np.abs(run.velocity_x) >= MIN_SPEED
            rows.append([v[fast] for v in (slip, force, np.full(len(run), number), run.time,
                                           mask & (np.abs(slip) <= MAX_SLIP))])
        samples.append(AxleSamples(name, *(np.concatenate(column) for column in zip(*rows, strict=True))))
    slopes = [_fit_slope(axle) if axle.used.sum() >= 10 else None for axle in samples]
    front, rear = (_make_regression(*pair, [f"too little excitation: {insufficient}"] if insufficient else [])
                   for pair in zip(samples, slopes, strict=True))
    correlation = np.eye(2)
    if slopes[0] is not None and slopes[1] is not None:  # from the influence of common blocks
        _, front_rows, rear_rows = np.intersect1d(slopes[0].blocks, slopes[1].blocks, return_indices=True)
        influences = np.stack([slopes[0].influence[front_rows], slopes[1].influence[rear_rows]])
        if len(front_rows) > 2 and (influences.std(axis=1) > 0.0).all():
            correlation = np.corrcoef(influences)
    return (front, rear), covered, correlation, tuple(rejected)


def _fit_slope(samples: AxleSamples) -> Slope:
    """Slope C of F = -C alpha + intercept, fitted to the used samples."""
    slip = samples.slip[samples.used]
    group = make_blocks(samples.run_of[samples.used], samples.time[samples.used])
    solution, spread, influence = group.fit_least_squares(np.stack([-slip, np.ones_like(slip)], axis=1),
                                                          samples.force[samples.used])
    return Slope(float(solution[0]), spread, (group.run.astype(np.int64) << 32) + group.block, influence[:, 0])


def _estimate_model_error(samples: AxleSamples, slope: Slope) -> float:
    """Standard uncertainty of the secant as an estimate of the stiffness at zero slip [N/rad]; NaN if unknown."""
    size = np.abs(samples.slip - samples.find_zero_force_slip())
    low = replace(samples, used=samples.used & (size <= 0.5 * np.quantile(size[samples.used], SLIP_QUANTILE)))
    mean, mean_low = (float(np.average(used, weights=used**2)) if used.any() else np.inf
                      for used in (size[samples.used], size[low.used]))
    if low.used.sum() < MIN_AXLE_SAMPLES or mean_low > MAX_RANGE_RATIO * mean:
        return float("nan")
    low_slope = _fit_slope(low)
    return extrapolation_uncertainty((slope.stiffness, float(slope.spread.covariance[0, 0]), mean),
                                     (low_slope.stiffness, float(low_slope.spread.covariance[0, 0]), mean_low))


def _make_regression(samples: AxleSamples, slope: Slope | None, reasons: Sequence[str]) -> AxleRegression:
    nan, count = float("nan"), int(samples.used.sum())
    reasons = [*reasons, *([] if count >= MIN_AXLE_SAMPLES else [
        f"too few samples: {count} of the {samples.axle} axle meet the limits of speed, radius, |a_y| and slip angle "
        f"({np.rad2deg(MAX_SLIP):g} deg), {MIN_AXLE_SAMPLES} are needed; also check the steering offset and "
        "the INS lever arm"])]
    failed = (samples.axle, nan, nan, (nan, nan), samples)
    if slope is None:
        return AxleRegression(*failed, tuple(reasons), f"{count} samples")
    value, spread = slope.stiffness, slope.spread
    error = float(spread.deviations[0])
    basis = f"{count} samples, {spread.basis[0]}"
    interval = spread.interval(0, value)
    if not interval[0] > 0.0:
        reason = (f"the fit failed: the force of the {samples.axle} axle does not follow its slip angle, slope "
                  f"{value:.0f} N/rad (standard uncertainty {error:.0f}); offset or sign of the steering, misalignment "
                  "or lever arm of the INS may be wrong, or the drive has too little sideslip")
        return AxleRegression(*failed, (*reasons, reason), basis)
    return AxleRegression(samples.axle, value, error, interval, samples, tuple(reasons), basis,
                          _estimate_model_error(samples, slope))


def identify_stiffness(logs: Sequence[DriveLog], vehicle: VehicleParameters) -> Identification:
    """Both stiffnesses by regression, with a covariance from the variation between runs, or blocks if runs are few.

    A stiffness whose interval is not above 0 is NaN and unidentifiable. Raises IdentificationError.
    """
    logs, notes = prepare_drives(logs, vehicle, "velocity_y")
    runs = [sample_run(log, vehicle) for log in logs]
    regressions, covered, correlation, rejected = _fit_regressions(runs, vehicle)
    require_coverage(
        covered, "Drive bends to both sides at several speeds, with 0.5 to 4 m/s^2 of lateral acceleration.")
    for regression in regressions:
        if int(regression.samples.used.sum()) < MIN_AXLE_SAMPLES:
            raise IdentificationError("; ".join(regression.reasons))
    names = tuple(run.name for run in runs)
    estimates = tuple(regression.estimate(names) for regression in regressions)
    figure = {f"{key}_{regression.axle}": getattr(regression.samples, key)[regression.samples.used]
              for regression in regressions for key in ("slip", "force")}
    return Identification("stiffness", estimates, names, rejected, correlation, covered,
                          (*notes, *describe_correlations([e.parameter for e in estimates], correlation)), figure)
