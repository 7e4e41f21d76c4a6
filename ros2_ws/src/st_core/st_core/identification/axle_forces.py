"""Axle forces versus slip angle: cornering stiffness by regression, and force curves of a model.

The cornering stiffness is the slope of measured axle force versus slip angle, with opposite sign. The forces

    F_f cos(delta) = (l_r m a_y + I_z r_dot) / L,    F_r = (l_f m a_y - I_z r_dot) / L

follow from the force and moment balance of the single-track car, with a_y at the CG, and the slip angles from the
velocity at each axle. An intercept absorbs offsets of steering and INS. Slow and nearly straight driving, |a_y| above
4 m/s^2 and slip angles above 2 deg are excluded.

The slope is a mean over the slip range. It is below the stiffness at zero slip if the tyre saturates in that range, or
if the slip angle is noisy. `AxleRegression.model_error` is the resulting standard uncertainty of the stiffness at zero
slip, from a second regression in the lower half of the slip range (`regression.extrapolation_uncertainty`). Source:
paper, section on parameter identification.

The force curve is computed from the equations of motion of a model, in a turn with equal slip of both axles,
v_y_dot = 0 and no forward acceleration, without effects on the steering signal (ratio, delay, ...). Offsets cancel in

    F(alpha) = (F_model(-alpha) - F_model(alpha)) / 2,   alpha >= 0

The slip angle is computed from the measured steering, as in the regression, so compliance and roll steer change the
curve. Checked by: test_identification_driving.py, test_axle_curve.py, test_stiffness_model_error.py.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..augmented import AugmentedModel
from ..errors import ConfigurationError, StCoreError
from ..log import DriveLog
from ..models import Model, get_model, slip_angles
from ..regression import Spread, extrapolation_uncertainty, make_blocks
from ..vehicle import VehicleParameters
from . import run_samples
from .result import Coverage, Identification, IdentificationError, ParameterEstimate, Status, describe_correlations
from .run_samples import RunSamples, prepare_drives, sample_run

AXLES = ("front", "rear")
METHOD = "regression of axle force on slip angle (paper)"
MIN_SPEED, MAX_RADIUS, MAX_ACCELERATION = 3.0, 300.0, 4.0  # m/s, m, m/s^2
MAX_SLIP = np.deg2rad(2.0)
MIN_AXLE_SAMPLES = 500  # minimum number of samples in a regression
SLIP_BIN_COUNT = 12
MAX_RANGE_RATIO = 0.8  # mean slip of the lower / full range; above it, extrapolation multiplies errors by over 5
MAX_RELATIVE_UNCERTAINTY = 0.1  # ratio of standard uncertainty to stiffness above which the stiffness is doubtful
SLIP_QUANTILE = 0.995  # quantile of |slip angle| that counts as the largest slip angle of the drives
EVALUATION_SPEED = 20.0  # m/s, speed at which the curve is evaluated; upper limit of minimum_slip_speed
MIN_DRAWS = 20  # minimum number of drawn models for a band
MAX_SECANT_STEPS = 6  # to find the lateral acceleration; with the largest roll steer, the force error is below 0.1 %


class Slope(NamedTuple):
    """Slope of the force of an axle versus its slip angle."""

    stiffness: float  # C [N/rad]
    spread: Spread  # uncertainty of (C, intercept)
    blocks: np.ndarray  # (k,) identifier of each block, from its run and its number in the run
    influence: np.ndarray  # (k,) influence of each block on C, see `Blocks.compute_influence`


@dataclass(frozen=True, eq=False)
class AxleSamples:
    """Samples (n,) of an axle; slip angle and force have opposite signs."""

    axle: str
    slip: np.ndarray  # slip angle [rad]
    force: np.ndarray  # N
    run_index: np.ndarray  # index of the run
    time: np.ndarray  # s since the first INS sample of the run
    used: np.ndarray  # whether a sample is used in the regression

    def bin_forces(self) -> tuple[np.ndarray, np.ndarray]:
        """(mean |slip| [rad], mean force that opposes the slip [N]) in each bin of |slip|, (b,) each.

        The slip at zero force, which offsets of steering and INS cause, is subtracted first. A bin is omitted if it has
        fewer than 5 samples, or less than 1 % of the samples that it would have in a uniform distribution.
        """
        slip = self.slip - self.find_zero_force_slip()
        size, force = np.abs(slip), -self.force * np.sign(slip)
        bins = np.digitize(size, np.linspace(0.0, float(np.quantile(size, SLIP_QUANTILE)), SLIP_BIN_COUNT + 1)) - 1
        masks = [bins == k for k in range(SLIP_BIN_COUNT)]
        masks = [mask for mask in masks if mask.sum() >= max(0.01 * len(size) / SLIP_BIN_COUNT, 5)]
        return np.array([size[mask].mean() for mask in masks]), np.array([force[mask].mean() for mask in masks])

    def find_zero_force_slip(self) -> float:
        """Slip at zero force [rad], by linear regression; 0 if the force does not oppose the slip."""
        mask = self.used if self.used.sum() >= 10 else np.ones(len(self.slip), bool)
        slope, intercept = np.polyfit(self.slip[mask], -self.force[mask], 1)
        return float(-intercept / slope) if slope > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class AxleRegression:
    """Result of the regression of one axle; NaN if the fit failed."""

    axle: str
    samples: AxleSamples  # all samples above the minimum speed
    reasons: tuple[str, ...]  # why the value is rejected; empty for a usable value
    basis: str  # text on the number of samples and blocks
    stiffness: float = float("nan")  # [N/rad]
    standard_error: float = float("nan")  # [N/rad]
    interval95: tuple[float, float] = (float("nan"), float("nan"))  # [N/rad]
    model_error: float = float("nan")  # standard uncertainty at zero slip [N/rad]; NaN if unknown

    @property
    def usable(self) -> bool:
        return not self.reasons

    @property
    def uncertainty(self) -> float:
        """Standard uncertainty of the stiffness at zero slip [N/rad], including the model error if it is known."""
        return float(np.hypot(self.standard_error, np.nan_to_num(self.model_error)))

    def estimate(self, runs: tuple[str, ...]) -> ParameterEstimate:
        """Estimate of the stiffness at zero slip; its interval is interval95, widened by uncertainty/standard_error."""
        half = 0.5 * (self.interval95[1] - self.interval95[0]) * self.uncertainty / max(self.standard_error, 1e-300)
        status: Status = "identified" if self.uncertainty < MAX_RELATIVE_UNCERTAINTY * self.stiffness else "doubtful"
        if self.reasons:
            text, status = "; ".join(self.reasons), "unidentifiable"
            verdict = f"{text[0].upper()}{text[1:]}."
        else:
            slip = np.rad2deg(np.quantile(np.abs(self.samples.slip[self.samples.used]), SLIP_QUANTILE))
            model_error = (f"a model error of {100 * self.model_error / self.stiffness:.2g} % is included"
                           if np.isfinite(self.model_error) else "its dependence on the slip range is unknown")
            verdict = (f"{self.stiffness:.0f} N/rad, standard uncertainty "
                       f"{100 * self.uncertainty / self.stiffness:.1f} %, from {self.basis}. Mean slope over slip "
                       f"angles up to {slip:.1f} deg, compliance and roll steer included; {model_error}.")
        return ParameterEstimate(f"cornering_stiffness_{self.axle}", self.stiffness, "N/rad", self.uncertainty,
                                 (self.stiffness - half, self.stiffness + half), METHOD, runs, verdict, status)


def compute_measured_forces(samples: RunSamples, vehicle: VehicleParameters) -> tuple[np.ndarray, np.ndarray]:
    """Lateral forces of the (front, rear) axle [N] along the lateral axis of the wheels, positive to the left."""
    lateral = vehicle.mass * samples.lateral_acceleration / vehicle.wheelbase
    yaw = vehicle.yaw_inertia * samples.yaw_acceleration / vehicle.wheelbase
    return ((vehicle.cg_to_rear_axle * lateral + yaw) / np.cos(samples.road_wheel_angle),
            vehicle.cg_to_front_axle * lateral - yaw)


def compute_slip_angles(samples: RunSamples, vehicle: VehicleParameters) -> tuple[np.ndarray, np.ndarray]:
    """Slip angles of the (front, rear) axle [rad], positive for wheels that slide to their left."""
    angle = samples.road_wheel_angle
    state = 0.0, 0.0, samples.velocity_x, samples.velocity_y, 0.0, samples.yaw_rate  # position and yaw have no effect
    return slip_angles(state, (np.sin(angle), np.cos(angle)), vehicle)


def fit_axle_regressions(logs: Sequence[DriveLog], vehicle: VehicleParameters) -> tuple[AxleRegression, AxleRegression]:
    """Regressions of the (front, rear) axle on drives with measured sideslip.

    vehicle: its mass, inertia, lengths, lever arm and steering are used and must be correct; its stiffnesses are not
    used. Raises IdentificationError without drives, and for duplicate names, or drives too short or full of gaps.
    """
    drives, _ = prepare_drives(logs, vehicle)
    return _fit_regressions([sample_run(log, vehicle) for log in drives], vehicle)[0]


def _fit_regressions(runs: Sequence[RunSamples], vehicle: VehicleParameters) -> tuple[
        tuple[AxleRegression, AxleRegression], tuple[Coverage, ...], np.ndarray, tuple[tuple[str, str], ...]]:
    """(regressions, coverage, correlation of the two stiffnesses (2, 2), (run, reason why samples are excluded))."""
    masks, rejected, times = [], [], [run.time for run in runs]
    for run in runs:
        slow = np.abs(run.velocity_x) < MIN_SPEED
        straight = ~slow & (np.abs(run.yaw_rate) * MAX_RADIUS < np.abs(run.velocity_x))
        high_acceleration = ~slow & ~straight & (np.abs(run.lateral_acceleration) > MAX_ACCELERATION)
        masks.append(~(slow | straight | high_acceleration))
        reasons = {f"slower than {MIN_SPEED:g} m/s": slow, f"on a radius above {MAX_RADIUS:g} m": straight,
                   f"above |a_y| = {MAX_ACCELERATION:g} m/s^2": high_acceleration}
        rejected += [(run.name, f"{int(mask.sum())} of {len(run)} samples {reason}")
                     for reason, mask in reasons.items() if mask.any()]
    coverage = (
        run_samples.measure_coverage("cornering speed", "m/s", run_samples.SPEED_EDGES,
                         [run.velocity_x[m] for run, m in zip(runs, masks, strict=True)], times, 2.0, 1),
        run_samples.measure_coverage("lateral acceleration", "m/s^2", run_samples.ACCELERATION_EDGES,
                         [run.lateral_acceleration[m] for run, m in zip(runs, masks, strict=True)], times, 1.0, 3))
    insufficient = "; ".join(c.describe() for c in coverage if not c.sufficient)
    rows: tuple[list, list] = [], []
    for run_index, (run, mask) in enumerate(zip(runs, masks, strict=True)):
        fast = np.abs(run.velocity_x) >= MIN_SPEED
        slips, forces = compute_slip_angles(run, vehicle), compute_measured_forces(run, vehicle)
        for axle_rows, slip, force in zip(rows, slips, forces, strict=True):
            axle_rows.append([v[fast] for v in (slip, force, np.full(len(run), run_index), run.time,
                                                mask & (np.abs(slip) <= MAX_SLIP))])
    samples = [AxleSamples(name, *map(np.concatenate, zip(*axle_rows, strict=True)))
               for name, axle_rows in zip(AXLES, rows, strict=True)]
    slopes = [_fit_slope(axle) if axle.used.sum() >= 10 else None for axle in samples]
    front, rear = (_make_regression(*pair, [f"too little excitation: {insufficient}"] if insufficient else [])
                   for pair in zip(samples, slopes, strict=True))
    correlation = np.eye(2)
    if slopes[0] is not None and slopes[1] is not None:  # correlation of the influences of common blocks
        _, front_rows, rear_rows = np.intersect1d(slopes[0].blocks, slopes[1].blocks, return_indices=True)
        influences = np.stack([slopes[0].influence[front_rows], slopes[1].influence[rear_rows]])
        if len(front_rows) > 2 and (influences.std(axis=1) > 0.0).all():
            correlation = np.corrcoef(influences)
    return (front, rear), coverage, correlation, tuple(rejected)


def _fit_slope(samples: AxleSamples) -> Slope:
    """Slope C of F = -C alpha + intercept, fitted to the used samples."""
    slip = samples.slip[samples.used]
    blocks = make_blocks(samples.run_index[samples.used], samples.time[samples.used])
    solution, spread, influence = blocks.fit_least_squares(np.stack([-slip, np.ones_like(slip)], axis=1),
                                                          samples.force[samples.used])
    number = (blocks.run.astype(np.int64) << 32) + blocks.number_in_run
    return Slope(float(solution[0]), spread, number, influence[:, 0])


def _estimate_model_error(samples: AxleSamples, slope: Slope) -> float:
    """Standard uncertainty of the slope as an estimate of the stiffness at zero slip [N/rad]; NaN if unknown."""
    size = np.abs(samples.slip - samples.find_zero_force_slip())
    low = replace(samples, used=samples.used & (size <= 0.5 * np.quantile(size[samples.used], SLIP_QUANTILE)))
    mean, mean_low = (float(np.average(sizes, weights=sizes**2)) if sizes.any() else np.inf
                      for sizes in (size[samples.used], size[low.used]))
    if low.used.sum() < MIN_AXLE_SAMPLES or mean_low > MAX_RANGE_RATIO * mean:
        return float("nan")
    low_slope = _fit_slope(low)
    return extrapolation_uncertainty((slope.stiffness, float(slope.spread.covariance[0, 0]), mean),
                                     (low_slope.stiffness, float(low_slope.spread.covariance[0, 0]), mean_low))


def _make_regression(samples: AxleSamples, slope: Slope | None, reasons: Sequence[str]) -> AxleRegression:
    count = int(samples.used.sum())
    if count < MIN_AXLE_SAMPLES:
        reasons = [*reasons, f"too few samples: {count} of the {samples.axle} axle meet the limits of speed, radius, "
                   f"|a_y| and slip angle ({np.rad2deg(MAX_SLIP):g} deg), but {MIN_AXLE_SAMPLES} are needed; also "
                   "check the steering offset and the INS lever arm"]
    if slope is None:
        return AxleRegression(samples.axle, samples, tuple(reasons), f"{count} samples")
    value, spread = slope.stiffness, slope.spread
    error, interval = float(spread.standard_errors[0]), spread.interval(0, value)
    basis = f"{count} samples, {spread.basis[0]}"
    if not interval[0] > 0.0:
        reason = (f"the fit failed: the force of the {samples.axle} axle does not follow its slip angle, slope "
                  f"{value:.0f} N/rad (standard uncertainty {error:.0f}); offset or sign of the steering, misalignment "
                  "or lever arm of the INS may be wrong, or the drive has too little sideslip")
        return AxleRegression(samples.axle, samples, (*reasons, reason), basis)
    return AxleRegression(samples.axle, samples, tuple(reasons), basis, value, error, interval,
                          _estimate_model_error(samples, slope))


def identify_stiffness(logs: Sequence[DriveLog], vehicle: VehicleParameters) -> Identification:
    """Both stiffnesses by regression; uncertainty from the variation between runs or, with few runs, between blocks.

    A stiffness with an interval not above 0 is NaN and unidentifiable. Raises IdentificationError for unusable drives.
    """
    logs, notes = prepare_drives(logs, vehicle, "velocity_y")
    runs = [sample_run(log, vehicle) for log in logs]
    regressions, coverage, correlation, rejected = _fit_regressions(runs, vehicle)
    run_samples.require_coverage(
        coverage, "Drive left and right turns at several speeds, with 0.5 to 4 m/s^2 of lateral acceleration.")
    for regression in regressions:
        if int(regression.samples.used.sum()) < MIN_AXLE_SAMPLES:
            raise IdentificationError("; ".join(regression.reasons))
    names = tuple(run.name for run in runs)
    estimates = tuple(regression.estimate(names) for regression in regressions)
    figure = {f"{key}_{regression.axle}": getattr(regression.samples, key)[regression.samples.used]
              for regression in regressions for key in ("slip", "force")}
    return Identification("stiffness", estimates, names, rejected, correlation, coverage,
                          (*notes, *describe_correlations([e.parameter for e in estimates], correlation)), figure)


@dataclass(frozen=True)
class ForceCurve:
    """Lateral force of an axle versus slip angle, within the range of the drives."""

    axle: str
    slip: tuple[float, ...]  # slip angle, >= 0 [rad]
    force: tuple[float, ...]  # positive if it opposes the slip [N]
    low: tuple[float, ...]  # lower end of the 90 % band of the force [N]
    high: tuple[float, ...]  # upper end of the 90 % band of the force [N]
    file: tuple[float, ...]  # force before the search, with the vehicle file or the fit of a reference [N]
    density: tuple[float, ...]  # fraction of the samples between neighbouring values of slip


def compute_axle_forces(model: str | Model, vehicle: VehicleParameters,
                        slip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Forces of the (front, rear) axle [N], (n,) each, at slip angles >= 0 [rad]; positive if they oppose the slip.

        v_y = l_r r + v tan(slip),   delta = atan((v_y + l_f r) / v) - slip,   r = a_y / v,   v: EVALUATION_SPEED
        F_f cos(delta) = (l_r m a_y + I_z r_dot) / L,   F_r = (l_f m a_y - I_z r_dot) / L

    Raises StCoreError for a model without tyres.
    """
    model = get_model(model)
    if not model.has_tyres:
        raise StCoreError(f"{getattr(model, 'base', model).name}: this model has no axle forces")
    if isinstance(model, AugmentedModel):
        model = model.select_effects(e for e in model.effects if e.slot != "steering")
    slip = np.concatenate((-np.asarray(slip, float), slip))
    p, car = model.parameters(vehicle), model.effective_vehicle(vehicle)
    zero = np.zeros_like(slip)

    def compute_accelerations(a_y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(v_y_dot + v_x r [m/s^2], r_dot [rad/s^2], road wheel angle [rad]) of the model in a turn with r = a_y/v."""
        r = a_y / EVALUATION_SPEED
        v_y = car.cg_to_rear_axle * r + EVALUATION_SPEED * np.tan(slip)
        angle = np.arctan((v_y + car.cg_to_front_axle * r) / EVALUATION_SPEED) - slip
        w = model.inputs(angle, zero, p, *(zero for _ in model.signals))
        rates = model.rhs(model.start_state((zero, zero, zero + EVALUATION_SPEED, v_y, zero, r), w, p), w, p)
        return rates[3] + EVALUATION_SPEED * r, rates[5], angle

    a_y, (model_a_y, yaw_acceleration, angle) = zero, compute_accelerations(zero)
    slope = zero
    for _ in range(MAX_SECANT_STEPS):
        last_a_y, last_model_a_y = a_y, model_a_y
        a_y = a_y + (model_a_y - a_y) / (1.0 - slope)
        model_a_y, yaw_acceleration, angle = compute_accelerations(a_y)
        change = a_y - last_a_y
        slope = np.divide(model_a_y - last_model_a_y, change, out=zero.copy(), where=np.abs(change) > 1e-9)
        if np.abs(model_a_y - a_y).max() < 1e-6:
            break
    force, moment = car.mass * model_a_y, car.yaw_inertia * yaw_acceleration
    front = ((car.cg_to_rear_axle * force + moment) / (car.wheelbase * np.cos(angle))).reshape(2, -1)
    rear = ((car.cg_to_front_axle * force - moment) / car.wheelbase).reshape(2, -1)
    return 0.5 * (front[0] - front[1]), 0.5 * (rear[0] - rear[1])


def compute_axle_force(model: str | Model, vehicle: VehicleParameters, axle: str, slip: np.ndarray) -> np.ndarray:
    """`compute_axle_forces` of one axle ("front" or "rear")."""
    return compute_axle_forces(model, vehicle, slip)[AXLES.index(axle)]


def make_axle_curve(model: str | Model, vehicle: VehicleParameters, axle: str, measured_slip: np.ndarray,
                    original: str | Model, draws: Iterable[Model] = (),
                    alternatives: Iterable[Model] = ()) -> ForceCurve:
    """The force curve of one axle with its band, at 41 slip angles up to the largest slip of the drives.

    measured_slip: (n,) slip angles of the axle [rad], either sign. original: model before the search. draws: models
    from `draw_models`. alternatives: other models consistent with the drives. The band contains the central 90 % of the
    draws at each slip, the curve and the alternatives. Raises StCoreError for fewer than two slip angles or only zeros.
    """
    abs_slip = np.abs(np.asarray(measured_slip, float))
    abs_slip = abs_slip[np.isfinite(abs_slip)]
    if len(abs_slip) < 2 or not abs_slip.max() > 0.0:
        raise StCoreError(f"{axle} axle: {len(abs_slip)} measured slip angles; two are needed, not all 0")
    slip = np.linspace(0.0, float(np.quantile(abs_slip, SLIP_QUANTILE)), 41)
    force, original_force = (compute_axle_force(candidate, vehicle, axle, slip) for candidate in (model, original))
    drawn = [compute_axle_force(candidate, vehicle, axle, slip) for candidate in draws]
    low, high = np.quantile(drawn, (0.05, 0.95), axis=0) if drawn else (force, force)
    curves = [force, *(compute_axle_force(candidate, vehicle, axle, slip) for candidate in alternatives)]
    counts = np.histogram(abs_slip, slip)[0]
    return ForceCurve(axle, *(tuple(values.tolist()) for values in (
        slip, force, np.min([low, *curves], axis=0), np.max([high, *curves], axis=0), original_force,
        counts / max(int(counts.sum()), 1))))


def draw_models(model: AugmentedModel, covariance: np.ndarray, vehicle: VehicleParameters,
                count: int) -> list[AugmentedModel]:
    """Models whose values are drawn from a normal distribution about those of `model` and clipped to their bounds.

    covariance: (p, p) of `model.vector` [SI]; zero for values that are not varied. Draws that take a value of `vehicle`
    beyond the limits of a vehicle file are dropped. Raises StCoreError if fewer than MIN_DRAWS draws are left.
    """
    low, high = np.array([p.bounds for _, p in model.free_parameters]).T.reshape(2, -1)
    values = np.random.default_rng(0).multivariate_normal(model.vector, covariance, count, method="eigh")
    models = select_valid_models([model.with_vector(row.tolist()) for row in np.clip(values, low, high)], vehicle)
    if len(models) < MIN_DRAWS:
        raise StCoreError(f"{len(models)} of {count} drawn parameter sets are within the limits of a vehicle file, "
                          f"{MIN_DRAWS} are needed: the values are too uncertain")
    return models


def select_valid_models(models: Iterable[AugmentedModel], vehicle: VehicleParameters) -> list[AugmentedModel]:
    """The models with which all values of the vehicle are within the limits of a vehicle file."""
    valid = []
    for candidate in models:
        with suppress(ConfigurationError):
            candidate.parameters(vehicle)
            valid.append(candidate)
    return valid


def compute_force_error(model: str | Model, vehicle: VehicleParameters, samples: AxleSamples) -> float:
    """RMS difference between modelled and measured axle force versus slip, divided by the measured peak [1].

        sqrt(mean over bins of (F_model(alpha) - mean F)^2) / max (mean F),    mean F: mean measured force of a bin

    The bins are those of `AxleSamples.bin_forces`, equally wide in |slip|, so that straights do not outweigh corners.
    """
    slip, force = samples.bin_forces()
    return float(np.sqrt(np.mean((compute_axle_force(model, vehicle, samples.axle, slip) - force) ** 2)) / force.max())
