"""Axle forces and slip angles as measured, and the axle cornering stiffnesses as the paper finds them from them.

    F_f cos(delta) = (l_r m a_y + I_z r_dot) / L,    F_r = (l_f m a_y - I_z r_dot) / L

from the force and moment balance of the single-track car, a_y at the CG; slip angles from the velocity at each axle.
The stiffness is the slope of force over slip. Samples that are slow, near-straight or beyond |a_y| = 4 m/s^2 are left
out, and those with |alpha| > 2 deg in the regression of their axle. The slope is the secant over that range: a tyre
that begins to saturate within it gives less than its stiffness at zero slip, and noise of the slip angle draws the
slope towards zero as well. `AxleRegression.model_error` is the standard uncertainty of the secant as stiffness at zero
slip, from the regression over the lower half of the slip:

    C(a) = C_0 - s a,    u = sqrt(max((C_low - C)^2 - u_d^2, 0)) a / (a - a_low) / sqrt(3)

a: mean |alpha| weighted by alpha^2; u_d^2 = u_low^2 - u^2 (Hausman, 1978). Source: paper, section on parameter
identification. Checked by: test_identification_driving.py, test_axle_curve.py, test_stiffness_model_error.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..log import DriveLog
from ..models._base import axle_slip_angles
from ..vehicle import VehicleParameters
from .blocks import Spread, blocks
from .result import (
    ACCELERATION_EDGES,
    SPEED_EDGES,
    Coverage,
    Estimate,
    Identification,
    IdentificationError,
    Status,
    coverage,
    require,
    strong_correlations,
)
from .run_samples import LateralAcceleration, RunSamples, prepared, run_samples

AXLES = ("front", "rear")
METHOD = "regression of axle force on slip angle (paper)"
FEWEST = 500
"""Least samples of an axle for a regression."""
LARGEST_RANGE_RATIO = 0.8
"""Mean slip or acceleration of the lower range over that of all driving beyond which the difference of the two shows no
trend: extrapolated to zero it would be multiplied by more than 5."""
LARGEST_RELATIVE = 0.1
"""Standard uncertainty over stiffness from which on it is doubtful."""


@dataclass(frozen=True)
class StiffnessSettings:
    """What enters the regression. minimum_speed [m/s]; maximum_radius [m]: straighter samples are left out;
    maximum_acceleration: of |a_y| [m/s^2]; maximum_slip [rad]. cutoff [Hz]: of the filter, see `run_samples`.
    through_origin: no intercept. An intercept takes up what offsets of steering and INS add to both sides; without
    left and right bends it takes up part of the slope too.
    """

    minimum_speed: float = 3.0
    maximum_radius: float = 300.0
    maximum_acceleration: float = 4.0
    maximum_slip: float = np.deg2rad(2.0)
    cutoff: float = 2.0
    lateral_acceleration: LateralAcceleration = "velocity"
    through_origin: bool = False


@dataclass(frozen=True, eq=False)
class AxleSamples:
    """Slip angle [rad] and force [N] of an axle, (n,), with the run and the time [s] of each sample; force and slip
    have opposite signs. used: (n,) which samples are in the range of the regression."""

    axle: str
    slip: np.ndarray
    force: np.ndarray
    run_of: np.ndarray
    time: np.ndarray
    used: np.ndarray

    def binned(self, count: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(slip, force, standard error of the force), one value per bin of |slip|, (b,) each, force opposing the slip.

        Both signs are folded together after the slip at which the force vanishes is taken off, which offsets of
        steering and INS cause. Bins with less than 1 % of an even share of the samples are left out.
        """
        slope, centre = self._line()
        slip = self.slip - centre
        side = np.sign(slip)
        size, force = np.abs(slip), -self.force * side
        edges = np.linspace(0.0, float(np.quantile(size, 0.995)), count + 1)
        number = np.digitize(size, edges) - 1
        group = blocks(self.run_of, self.time)
        rows = []
        for k in range(count):
            member = number == k
            n = int(member.sum())
            if n < 0.01 * len(size) / count or n < 5:
                continue
            # Within a bin the force still rises with the slip: only what is off the local line is scatter.
            mean, middle = float(force[member].mean()), float(size[member].mean())
            off = np.where(member, force - mean - slope * (size - middle), 0.0)
            error = float(np.sqrt(np.square(group.sums(off)).sum()) / n)
            rows.append((middle, mean, error))
        return tuple(np.array(rows).reshape(-1, 3).T)  # type: ignore[return-value]  # three rows

    def _line(self) -> tuple[float, float]:
        """Slope of -force over slip [N/rad] and the slip at zero force [rad], by the samples in the regression's range;
        the slip is not shifted where the slope is not positive."""
        use = self.used if self.used.sum() >= 10 else np.ones(len(self.slip), bool)
        slope, intercept = np.polyfit(self.slip[use], -self.force[use], 1)
        return (float(slope), float(-intercept / slope)) if slope > 0.0 else (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class AxleRegression:
    """Result of the regression of one axle. stiffness, standard_error [N/rad], interval95: NaN where it failed.

    samples: all slip and force pairs above the minimum speed. coverage: excitation by signal. reasons: why the value is
    refused, whole sentences, empty for one that may be used. basis: samples and blocks it rests on, in words.
    model_error [N/rad]: as stiffness at zero slip, see the module; NaN where the samples do not show it.
    """

    axle: str
    stiffness: float
    standard_error: float
    interval95: tuple[float, float]
    samples: AxleSamples
    coverage: tuple[Coverage, ...]
    reasons: tuple[str, ...]
    basis: str
    model_error: float = float("nan")

    @property
    def usable(self) -> bool:
        return not self.reasons

    @property
    def uncertainty(self) -> float:
        """Standard uncertainty as stiffness at zero slip [N/rad], as far as the samples show it."""
        return float(np.hypot(self.standard_error, np.nan_to_num(self.model_error)))

    @property
    def interval_at_zero_slip(self) -> tuple[float, float]:
        """95 % interval of `uncertainty`, with the degrees of freedom of interval95 [N/rad]."""
        half = 0.5 * (self.interval95[1] - self.interval95[0]) * self.uncertainty / max(self.standard_error, 1e-300)
        return self.stiffness - half, self.stiffness + half


def axle_forces(samples: RunSamples, vehicle: VehicleParameters) -> tuple[np.ndarray, np.ndarray]:
    """Lateral force of (front, rear) axle [N], left +, in the lateral axis of the wheels; see the module."""
    pull = vehicle.mass * samples.lateral_acceleration / vehicle.wheelbase
    turn = vehicle.yaw_inertia * samples.yaw_acceleration / vehicle.wheelbase
    return ((vehicle.cg_to_rear_axle * pull + turn) / np.cos(samples.road_wheel_angle),
            vehicle.cg_to_front_axle * pull - turn)


def slip_angles(samples: RunSamples, vehicle: VehicleParameters) -> tuple[np.ndarray, np.ndarray]:
    """Slip angle of (front, rear) axle [rad], + when the wheels slide to their left (`models.axle_slip_angles`)."""
    angle = samples.road_wheel_angle
    return axle_slip_angles(samples.velocity_x, samples.velocity_y, samples.yaw_rate, np.sin(angle), np.cos(angle),
                            vehicle)


def axle_regressions(logs: Sequence[DriveLog], vehicle: VehicleParameters,
                     settings: StiffnessSettings | None = None) -> tuple[AxleRegression, AxleRegression]:
    """The paper's regression of both axles (front, rear) for drives with measured sideslip; never raises for thin
    or contradicting driving: the reasons are in the result.

    vehicle: mass, inertia, lengths, lever arm, steering; its stiffnesses do not enter. Offset and ratio must be right.
    Raises IdentificationError only for no drive, one named twice, or one too short.
    """
    settings = settings or StiffnessSettings()
    own, _ = prepared(logs, vehicle)
    return _regressions([run_samples(log, vehicle, settings.cutoff,
                                     lateral_acceleration=settings.lateral_acceleration) for log in own],
                        vehicle, settings)[0]


def _regressions(runs: Sequence[RunSamples], vehicle: VehicleParameters, settings: StiffnessSettings) -> tuple[
        tuple[AxleRegression, AxleRegression], np.ndarray, tuple[tuple[str, str], ...]]:
    """(regressions, correlation of the two stiffnesses (2, 2), (run, what of it is left out))."""
    masks, rejected = zip(*(_gate(run, settings) for run in runs), strict=True)
    covered = _coverage(runs, masks)
    samples = [_axle(runs, masks, vehicle, index, settings) for index in range(2)]
    reasons = ["; ".join(c.words() for c in covered if not c.enough)]
    reasons = [f"the driving is too thin: {reasons[0]}"] if reasons[0] else []
    found = []
    for one in samples:
        count = int(one.used.sum())
        thin = [*reasons, *([] if count >= FEWEST else [
            f"too few samples: {count} of the {one.axle} axle pass (speed, bend, |a_y|, slip angle below "
            f"{np.rad2deg(settings.maximum_slip):g} deg), {FEWEST} are needed; check offset and lever arm too"])]
        found.append((one, thin, _slope(one, settings.through_origin) if count >= 10 else None))
    front, rear = (_result(one, slope, covered, thin, settings.through_origin) for one, thin, slope in found)
    return (front, rear), _correlation([slope for _, _, slope in found]), tuple(r for rows in rejected for r in rows)


def _slope(samples: AxleSamples, through_origin: bool) -> tuple[float, Spread, dict[tuple[int, int], float]]:
    """(C, spread, influence by run and block) of F = -C alpha + intercept over the used samples."""
    slip, force = samples.slip[samples.used], samples.force[samples.used]
    group = blocks(samples.run_of[samples.used], samples.time[samples.used])
    columns = -slip[:, None] if through_origin else np.stack([-slip, np.ones_like(slip)], axis=1)
    found, spread, residuals = group.regression(columns, force)
    own = group.influence(columns, residuals)[:, 0]
    return float(found[0]), spread, dict(zip(zip(group.run.tolist(), group.block.tolist(), strict=True), own,
                                             strict=True))


def _model_error(samples: AxleSamples, slope: tuple[float, Spread, Any], through_origin: bool) -> float:
    """See the module; NaN for too few samples or one size of slip."""
    size = np.abs(samples.slip - samples._line()[1])
    low = replace(samples, used=samples.used & (size <= 0.5 * np.quantile(size[samples.used], 0.995)))
    mean, mean_low = (float((size[one.used] ** 3).sum() / (size[one.used] ** 2).sum()) if one.used.any() else np.inf
                      for one in (samples, low))
    if low.used.sum() < FEWEST or mean_low > LARGEST_RANGE_RATIO * mean:
        return float("nan")
    value, spread, _ = _slope(low, through_origin)
    chance = max(float(spread.covariance[0, 0] - slope[1].covariance[0, 0]), 0.0)
    return float(np.sqrt(max((value - slope[0]) ** 2 - chance, 0.0)) * mean / (mean - mean_low) / np.sqrt(3.0))


def _correlation(slopes: Sequence) -> np.ndarray:
    """Of the two stiffnesses, by what each block does to both; the identity where one is missing."""
    if any(s is None for s in slopes):
        return np.eye(2)
    keys = sorted(set(slopes[0][2]) & set(slopes[1][2]))
    pulls = np.array([[s[2][key] for key in keys] for s in slopes])
    return np.corrcoef(pulls) if len(keys) > 2 and (pulls.std(axis=1) > 0.0).all() else np.eye(2)


def _result(samples: AxleSamples, slope: tuple[float, Spread, Any] | None, covered: tuple[Coverage, ...],
            reasons: Sequence[str], through_origin: bool) -> AxleRegression:
    nan = float("nan")
    failed = (samples.axle, nan, nan, (nan, nan), samples, covered)
    if slope is None:
        return AxleRegression(*failed, tuple(reasons), f"{int(samples.used.sum())} samples")
    value, spread, _ = slope
    error = float(spread.deviations[0])
    basis = f"{int(samples.used.sum())} samples, {spread.basis[0]}"
    interval = spread.interval(0, value)
    if not interval[0] > 0.0:
        why = (f"the fit failed: the force of the {samples.axle} axle does not follow its slip angle, slope "
               f"{value:.0f} +/- {error:.0f} N/rad; offset or sign of the steering, misalignment or lever "
               "arm of the INS may be wrong, or the drive has too little sideslip")
        return AxleRegression(*failed, (*reasons, why), basis)
    return AxleRegression(samples.axle, value, error, interval, samples, covered, tuple(reasons), basis,
                          _model_error(samples, slope, through_origin))


def identify_stiffness(logs: Sequence[DriveLog], vehicle: VehicleParameters,
                       settings: StiffnessSettings | None = None) -> Identification:
    """Both stiffnesses by the paper's regression, with a covariance over runs (or blocks of few runs).

    vehicle: mass, inertia, lengths, lever arm, steering; its stiffnesses do not enter. Offset and ratio must be right.
    A slope with zero inside its interval is not given: value NaN, unidentifiable, with the reason as its verdict.
    Raises IdentificationError, with the numbers, for too thin driving.
    """
    settings = settings or StiffnessSettings()
    logs, noticed = prepared(logs, vehicle)
    runs = [run_samples(log, vehicle, settings.cutoff, lateral_acceleration=settings.lateral_acceleration)
            for log in logs]
    regressions, correlation, rejected = _regressions(runs, vehicle, settings)
    require(regressions[0].coverage, "Drive bends to both sides at several speeds, with 0.5 to 4 m/s^2 across.")
    for one in regressions:
        if int(one.samples.used.sum()) < FEWEST:
            raise IdentificationError("; ".join(one.reasons))
    names = tuple(run.name for run in runs)
    estimates = tuple(Estimate(f"cornering_stiffness_{one.axle}", one.stiffness, "N/rad", one.uncertainty,
                               one.interval_at_zero_slip, METHOD, names, _verdict(one), _status(one))
                      for one in regressions)
    figure = {f"{key}_{one.axle}": getattr(one.samples, key)[one.samples.used]
              for one in regressions for key in ("slip", "force", "run_of")}
    return Identification("stiffness", estimates, names, rejected, correlation, regressions[0].coverage,
                          (*noticed, *strong_correlations([e.parameter for e in estimates], correlation)), figure)


def _gate(run: RunSamples, settings: StiffnessSettings) -> tuple[np.ndarray, list[tuple[str, str]]]:
    slow = np.abs(run.velocity_x) < settings.minimum_speed
    straight = ~slow & (np.abs(run.yaw_rate) * settings.maximum_radius < np.abs(run.velocity_x))
    hard = ~slow & ~straight & (np.abs(run.lateral_acceleration) > settings.maximum_acceleration)
    reasons = {f"slower than {settings.minimum_speed:g} m/s": slow,
               f"straighter than R = {settings.maximum_radius:g} m": straight,
               f"beyond {settings.maximum_acceleration:g} m/s^2": hard}
    return ~(slow | straight | hard), [(run.name, f"{int(b.sum())} of {len(run)} samples {why}")
                                       for why, b in reasons.items() if b.any()]


def _coverage(runs: Sequence[RunSamples], masks: Sequence[np.ndarray]) -> tuple[Coverage, ...]:
    interval = float(np.median(np.concatenate([np.diff(run.time) for run in runs])))
    chosen = [(run.velocity_x[m], run.lateral_acceleration[m]) for run, m in zip(runs, masks, strict=True)]
    return (coverage("speed in bends", "m/s", SPEED_EDGES, [c[0] for c in chosen], interval, 2.0, 1),
            coverage("lateral acceleration", "m/s^2", ACCELERATION_EDGES, [c[1] for c in chosen], interval, 1.0, 3))


def _axle(runs: Sequence[RunSamples], masks: Sequence[np.ndarray], vehicle: VehicleParameters, index: int,
          settings: StiffnessSettings) -> AxleSamples:
    columns: list[list[np.ndarray]] = [[], [], [], [], []]
    for number, (run, mask) in enumerate(zip(runs, masks, strict=True)):
        slip, force = slip_angles(run, vehicle)[index], axle_forces(run, vehicle)[index]
        fast = np.abs(run.velocity_x) >= settings.minimum_speed
        use = mask & (np.abs(slip) <= settings.maximum_slip)
        values = (slip, force, np.full(len(run), number), run.time, use)
        for column, value in zip(columns, values, strict=True):
            column.append(value[fast])
    return AxleSamples(AXLES[index], *(np.concatenate(c) for c in columns))


def _status(one: AxleRegression) -> Status:
    if not one.usable:
        return "unidentifiable"
    return "identified" if one.uncertainty < LARGEST_RELATIVE * one.stiffness else "doubtful"


def _verdict(one: AxleRegression) -> str:
    if one.reasons:
        text = "; ".join(one.reasons)
        return f"{text[0].upper()}{text[1:]}."
    slip = np.rad2deg(np.quantile(np.abs(one.samples.slip[one.samples.used]), 0.995))
    model_error = (f"model error +/- {100 * one.model_error / one.stiffness:.1f} % included"
                   if np.isfinite(one.model_error) else "its change with the slip range is not known")
    return (f"{one.stiffness:.0f} N/rad +/- {100 * one.uncertainty / one.stiffness:.1f} % from {one.basis}. "
            f"Secant over slip angles up to {slip:.1f} deg, compliance and roll steer included; {model_error}.")
