"""Axle cornering stiffnesses as the paper finds them: slope of axle force over slip angle, from driving.

    F_f cos(delta) = (l_r m a_y + I_z r_dot) / L,    F_r = (l_f m a_y - I_z r_dot) / L

from the force and moment balance of the single-track car, a_y at the CG; slip angles from the velocity at each axle.
Samples that are slow, near-straight or beyond |a_y| = 4 m/s^2 are left out, and those with |alpha| > 2 deg in the
regression of their axle. The slope is an average over that range: a tyre that begins to saturate within it gives less
than its stiffness at small slip, and noise of the slip angle draws the slope towards zero as well.
Source: paper, section on parameter identification. Checked by: test_identification_driving.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..log import DriveLog
from ..models._dynamic import axle_slip_angles
from ..vehicle import VehicleParameters
from . import resampling
from .coverage import ACCELERATION_EDGES, SPEED_EDGES, coverage, require
from .result import Coverage, Estimate, Identification, IdentificationError, Status, strong_correlations
from .run_samples import LateralAcceleration, RunSamples, prepared, run_samples

AXLES = ("front", "rear")
METHOD = "regression of axle force on slip angle (paper)"
FEWEST = 500
"""Samples of an axle, below which there is no regression."""


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
    """Slip angle [rad] and force [N] of an axle, (n,), and the run of each sample. Force and slip have opposite signs.
    """

    slip: np.ndarray
    force: np.ndarray
    run_of: np.ndarray
    time: np.ndarray


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


def identify_stiffness(logs: Sequence[DriveLog], vehicle: VehicleParameters, settings: StiffnessSettings | None = None,
                       *, bootstrap: int = 200, seed: int = 0) -> Identification:
    """Both stiffnesses by the paper's regression, with a bootstrap over runs (or blocks of few runs).

    vehicle: mass, inertia, lengths, lever arm, steering; its stiffnesses do not enter. Offset and ratio must be right.
    Raises IdentificationError, with the numbers, for too thin driving.
    """
    settings = settings or StiffnessSettings()
    logs, noticed = prepared(logs, vehicle)
    runs = [run_samples(log, vehicle, settings.cutoff, lateral_acceleration=settings.lateral_acceleration)
            for log in logs]
    masks, rejected = zip(*(_gate(run, settings) for run in runs), strict=True)
    covered = _coverage(runs, masks)
    require(covered, "Drive bends to both sides at several speeds, with 0.5 to 4 m/s^2 across.")
    axles = [_axle(runs, masks, vehicle, index, settings) for index in range(2)]
    slopes, drawn = _regress(axles, settings, bootstrap, seed)
    uncertainty = np.sqrt(np.diag(drawn.covariance))
    estimates = tuple(
        Estimate(f"cornering_stiffness_{axle}", float(slopes[i]), "N/rad", float(uncertainty[i]),
                 drawn.interval(i, slopes[i], uncertainty[i]), METHOD, tuple(run.name for run in runs),
                 _verdict(axle, slopes[i], uncertainty[i], len(axles[i].slip), drawn.words(i)),
                 _status(slopes[i], uncertainty[i])) for i, axle in enumerate(AXLES))
    figure = {f"{name}_{axle}": getattr(samples, name)
              for axle, samples in zip(AXLES, axles, strict=True) for name in ("slip", "force", "run_of")}
    return Identification(
        "stiffness", estimates, tuple(run.name for run in runs), tuple(r for rows in rejected for r in rows),
        drawn.correlation, covered,
        (*noticed, *strong_correlations([e.parameter for e in estimates], drawn.correlation)), figure)


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
    columns: list[list[np.ndarray]] = [[], [], [], []]
    for number, (run, mask) in enumerate(zip(runs, masks, strict=True)):
        slip, force = slip_angles(run, vehicle)[index], axle_forces(run, vehicle)[index]
        use = mask & (np.abs(slip) <= settings.maximum_slip)
        for column, values in zip(columns, (slip, force, np.full(len(run), number), run.time), strict=True):
            column.append(values[use])
    samples = AxleSamples(*(np.concatenate(c) for c in columns))
    if len(samples.slip) < FEWEST:
        raise IdentificationError(
            f"too few samples: {len(samples.slip)} of the {AXLES[index]} axle pass (speed, bend, |a_y|, slip angle "
            f"below {np.rad2deg(settings.maximum_slip):g} deg), {FEWEST} are needed; check offset and lever arm too")
    return samples


def _regress(axles: Sequence[AxleSamples], settings: StiffnessSettings, count: int,
             seed: int) -> tuple[np.ndarray, resampling.Drawn]:
    """Slopes (2,) and their bootstrap; both axles drawn together."""
    both = np.concatenate([a.run_of for a in axles]), np.concatenate([a.time for a in axles])
    pieces = resampling.pieces(*both)
    sides = np.split(pieces.of, [len(axles[0].slip)])
    totals = []
    for axle, own in zip(axles, sides, strict=True):
        moments = np.stack([np.ones_like(axle.slip), axle.slip, axle.force, axle.slip**2, axle.slip * axle.force], 1)
        totals.append(np.stack([np.bincount(own, column, len(pieces)) for column in moments.T], axis=1))
    slopes = np.array([_slope(t.sum(axis=0), settings.through_origin) for t in totals])

    def estimate(weights: np.ndarray) -> np.ndarray:
        return np.stack([_slope((weights @ t).T, settings.through_origin) for t in totals], axis=1)

    return slopes, resampling.bootstrap(estimate, pieces, count, seed)


def _slope(moments: np.ndarray, through_origin: bool) -> np.ndarray:
    """C of F = -C alpha + intercept from (n, sum a, sum F, sum a^2, sum a F)."""
    n, a, f, aa, af = moments
    return -af / aa if through_origin else -(n * af - a * f) / (n * aa - a * a)


def _status(slope: float, uncertainty: float) -> Status:
    if not slope > 2.0 * uncertainty:
        return "unidentifiable"
    return "identified" if uncertainty < 0.1 * slope else "doubtful"


def _verdict(axle: str, slope: float, uncertainty: float, count: int, words: str) -> str:
    if not slope > 2.0 * uncertainty:
        return (f"The force of the {axle} axle does not follow its slip angle, {slope:.0f} +/- {uncertainty:.0f} N/rad:"
                " offset of the steering, misalignment or lever arm of the INS, or a sign may be wrong.")
    return (f"{slope:.0f} N/rad +/- {100 * uncertainty / slope:.1f} % from {count} samples, resampling {words}. "
            "Average slope up to 2 deg of slip, compliance and roll steer included.")
