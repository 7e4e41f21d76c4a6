"""Joint fit of vehicle and sensor parameters to several drives.

Problem, loss and fit are those of `discovery`. Windows of the drives are predicted with the measured inputs. The errors
of yaw rate and lateral velocity at the INS are assumed to follow Student's t distribution. The effects that represent
the parameters are fitted together, without a prior. Unlike in a regression of force on slip, noise of the slip angle
does not attenuate the estimates. Checked by: test_driving_fit.py.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..augmented import AugmentedModel
from ..channels import CHANNELS
from ..discovery.fit import Problem, Sensitivities
from ..discovery.loss import Errors, Loss
from ..discovery.settings import DiscoverySettings
from ..discovery.space import Space
from ..discovery.windows import STEP, Windows
from ..effects.front_stiffness import FrontStiffness
from ..effects.heading_misalignment import HeadingMisalignment
from ..effects.rear_stiffness import RearStiffness
from ..effects.sensor_lever_arm import SensorLeverArm
from ..effects.sensor_roll import SensorRoll
from ..effects.steering_delay import SteeringDelay
from ..effects.steering_offset import SteeringOffset
from ..effects.steering_ratio import SteeringRatio
from ..effects.tyre_relaxation import TyreRelaxation
from ..effects.yaw_inertia import YawInertia
from ..errors import StCoreError
from ..log import DriveLog
from ..models import Model, get_model
from ..regression import Spread, make_blocks
from ..timeseries import NANOSECOND
from ..vehicle import VehicleParameters
from .result import IdentificationError

MISALIGNMENT, DELAY, RELAXATION, ROLL = "ins_misalignment", SteeringDelay.name, TyreRelaxation.name, SensorRoll.name
MAX_ITERATIONS, SCALE_TOLERANCE = 6, 0.02
"""Maximum number of fits, each with the error scale of the one before; relative change of the scale at convergence."""
MAX_CONDITION = 1e12  # condition number of the Hessian above which the drives do not determine the parameters
MIN_CURVATURE_RATIO = 0.2  # smallest ratio of the curvature of the loss to its Gauss-Newton approximation; typical: 0.7
Values = Mapping[str, float]


@dataclass(frozen=True)
class FitQuantity:
    """A quantity that can be identified from driving, and the effect that represents it in the fit; SI units."""

    effect: str
    unit: str
    value: Callable[[VehicleParameters, Values], float]  # from the vehicle and values by "effect.parameter"
    relative: bool = False  # whether the relative uncertainty determines the status
    max_uncertainty: float = 0.0  # largest standard uncertainty of an identified value [unit], if not relative


def _make_scaled_quantity(effect: str, key: str, unit: str) -> FitQuantity:
    return FitQuantity(effect, unit, lambda car, values: values[f"{effect}.factor"] * float(getattr(car, key)), True)


QUANTITIES: Mapping[str, FitQuantity] = {
    "cornering_stiffness_front": _make_scaled_quantity(FrontStiffness.name, "cornering_stiffness_front", "N/rad"),
    "cornering_stiffness_rear": _make_scaled_quantity(RearStiffness.name, "cornering_stiffness_rear", "N/rad"),
    "yaw_inertia": _make_scaled_quantity(YawInertia.name, "yaw_inertia", "kg m^2"),
    "steering_ratio": _make_scaled_quantity(SteeringRatio.name, "steering_ratio", "1"),
    # delta = (delta_h - o_file) / (factor i_file) + angle, so o = o_file - angle factor i_file.
    "steering_wheel_offset": FitQuantity(SteeringOffset.name, "rad", max_uncertainty=0.02, value=lambda car, values: (
        car.steering_wheel_offset - values[f"{SteeringOffset.name}.angle"] * car.steering_ratio
        * values.get(f"{SteeringRatio.name}.factor", 1.0))),
    "cg_to_ins_x": FitQuantity(SensorLeverArm.name, "m", max_uncertainty=0.1, value=lambda car, values: (
        car.cg_to_ins_x + values[f"{SensorLeverArm.name}.x"])),
    # Angle by which the reported heading points too far to the left.
    MISALIGNMENT: FitQuantity(HeadingMisalignment.name, "rad",
                              lambda car, values: values[f"{HeadingMisalignment.name}.angle"], max_uncertainty=0.005),
    # Delay from the measured angle to the wheels.
    DELAY: FitQuantity(DELAY, "s", lambda car, values: values[f"{DELAY}.time"], max_uncertainty=0.02),
    # Distance rolled until the force reaches 63 % of its final value after a step of the slip angle.
    RELAXATION: FitQuantity(RELAXATION, "m", lambda car, values: values[f"{RELAXATION}.length"], max_uncertainty=0.1),
    # Outward shift of the INS per lateral acceleration.
    ROLL: FitQuantity(ROLL, "s^2", lambda car, values: values[f"{ROLL}.shift"], max_uncertainty=0.01),
}


@dataclass(frozen=True)
class DrivingFitSettings:
    """Settings of a fit. A window is used if its whole horizon is within the limits of speed and acceleration."""

    horizon: float = 1.5  # s, of the predictions; 1 to 10
    interval: float = 0.5  # s, between the starts of the predictions
    minimum_speed: float = 5.0  # m/s
    maximum_acceleration: float = 4.0  # m/s^2, largest |v_x r|
    min_windows: int = 60  # smallest number of windows in a fit
    channels: tuple[str, ...] = ("yaw_rate", "velocity_y")  # without velocity_y, predictions start from steady sideslip

    def for_car(self, vehicle: VehicleParameters) -> "DrivingFitSettings":
        """These settings, with a lower minimum speed for a scale model."""
        return replace(self, minimum_speed=self.minimum_speed * vehicle.speed_scale)


class _LimitedWindows(Windows):
    """Windows of the drives. used: mask (n,) of those within the speed and acceleration limits of the settings."""

    MIN_SUBSTEPS = 2  # steps of 50 ms are unstable for some cars at 5 m/s

    def __init__(self, runs: Sequence[DriveLog], vehicle: VehicleParameters, settings: DrivingFitSettings):
        super().__init__(runs, vehicle, DiscoverySettings(
            channels=tuple(name for name in settings.channels
                           if all(CHANNELS[name].is_measured_in(run) for run in runs)),
            horizon=settings.horizon, windows=20_000, interval=settings.interval))
        grid = np.round(np.arange(0.0, self.time[-1] + 0.5 * STEP, STEP) / NANOSECOND).astype(np.int64)
        speed, rate = self.measured_at(self.starts_ns[:, None] + grid, "velocity_x", "yaw_rate")
        with np.errstate(invalid="ignore"):
            self.used = ((speed >= settings.minimum_speed)
                         & (np.abs(speed * rate) <= settings.maximum_acceleration)).all(axis=1)
            weights = np.square(speed * rate)[self.used]
            squared_curvature = np.square(rate / speed)[self.used]
        has_turns = weights.sum() > 0.0
        self.mean_squared_curvature = float(np.average(squared_curvature, weights=weights)) if has_turns else 0.0
        self.peak_accelerations = np.sqrt(weights.max(axis=1))
        self.mean_acceleration = float(np.average(np.sqrt(weights), weights=weights)) if has_turns else 0.0

    @cached_property
    def known(self) -> np.ndarray:
        return super().known & self.used[:, None]


@dataclass(frozen=True, eq=False)
class DrivingFit:
    """Result of a fit of p quantities. Means are weighted by (v_x r)^2."""

    names: tuple[str, ...]  # keys of QUANTITIES
    values: np.ndarray  # (p,) [SI]
    spread: Spread  # from the variation between blocks of driving
    at_bound: tuple[str, ...]  # names of quantities at a bound
    noise_covariance: np.ndarray  # (p, p) for independent residuals, up to a constant factor
    residuals: Mapping[str, np.ndarray]  # (n,) predicted minus measured, by channel [SI]
    run_index: np.ndarray  # (n,) index of the run of each residual
    time: np.ndarray  # (n,) start of the prediction of each residual, as `Windows.seconds` [s]
    window_counts: Mapping[str, tuple[int, int]]  # number of windows (used, all) by run
    mean_squared_curvature: float  # of the path [1/m^2]
    mean_acceleration: float  # of |v_x r| [m/s^2]
    peak_accelerations: np.ndarray  # largest |v_x r| of each used window [m/s^2]

    @property
    def prediction_count(self) -> int:
        """Number of predictions used."""
        return sum(used for used, _ in self.window_counts.values())


def fit_driving(logs: Sequence[DriveLog], vehicle: VehicleParameters, names: Sequence[str],
                base: str | Model = "nonlinear", settings: DrivingFitSettings = DrivingFitSettings()) -> DrivingFit:
    """Fit of the quantities `names`, distinct keys of QUANTITIES; all others remain fixed.

    logs: from `run_samples.prepare_drives`. base: linear, nonlinear, or either with known effects. Raises
    IdentificationError for an unknown name, unusable drives, too few windows, and values not determined by the drives.
    """
    for name in names:
        if name not in QUANTITIES:
            raise IdentificationError(f"{name}: not identifiable from driving; choose from {', '.join(QUANTITIES)}")
    effects = tuple(dict.fromkeys(QUANTITIES[name].effect for name in names))
    model = get_model(base)
    library = {*effects, *(model.values if isinstance(model, AugmentedModel) else ())}
    try:
        windows = _LimitedWindows(logs, vehicle, settings)
    except StCoreError as error:
        raise IdentificationError(str(error)) from None
    counts = {name: (int(windows.used[windows.run == k].sum()), int((windows.run == k).sum()))
              for k, name in enumerate(windows.names)}
    total = sum(used for used, _ in counts.values())
    if total < settings.min_windows:
        raise IdentificationError(
            f"too little driving: {total} of {len(windows)} windows of {settings.horizon:g} s are faster than "
            f"{settings.minimum_speed:.3g} m/s and below a lateral acceleration of {settings.maximum_acceleration:g} "
            f"m/s^2; {settings.min_windows} are needed")
    space = Space(model, windows.settings, library=library)
    loss = Loss(Errors(windows, space), space.null)
    problem = Problem(loss, space.null, windows.block)
    vector, indices = problem.start.copy(), problem.free_indices(effects)
    for _ in range(MAX_ITERATIONS):  # values and error scale are estimated in turn
        previous_scale = loss.scale.copy()
        sensitivities = Sensitivities(vector, indices, loss.sensitivities(vector, indices))
        vector = problem.fit(effects, sensitivities, vector=vector, recompute=effects, iterations=12).vector
        loss.rescale(vector)
        if np.abs(loss.scale / previous_scale - 1.0).max() < SCALE_TOLERANCE:
            break
    return _make_fit(problem, windows, vector, effects, names, counts)


def _make_fit(problem: Problem, windows: _LimitedWindows, vector: np.ndarray, effects: tuple[str, ...],
              names: Sequence[str], counts: Mapping[str, tuple[int, int]]) -> DrivingFit:
    space, indices = problem.space, problem.free_indices(effects)
    errors = problem.errors.at(vector)
    sensitivities = problem.loss.sensitivities(vector, indices)
    quadratic = problem.loss.quadratic(errors, sensitivities)
    used = np.flatnonzero(windows.used)
    blocks = make_blocks(windows.run[used], windows.seconds[used])
    hessian, gradient = blocks.sum_by_block(quadratic.hessian[used]), blocks.sum_by_block(quadratic.gradient[used])
    total = hessian.sum(axis=0)
    size = np.sqrt(np.diag(total).clip(1e-300))
    if np.linalg.cond(total / np.outer(size, size)) > MAX_CONDITION:
        raise IdentificationError(f"the drives do not determine {', '.join(names)} together: drive at more speeds and "
                                  "curvatures, or fit fewer parameters")
    # The Gauss-Newton approximation overestimates the curvature of the loss.
    curvature = np.diag(problem.loss.curvature(errors, sensitivities))
    ratio = np.clip((curvature / np.diag(total)).mean(), MIN_CURVATURE_RATIO, 1.0)
    influence = blocks.compute_influence(ratio * hessian, gradient)

    def to_quantities(vector: np.ndarray) -> np.ndarray:
        effect_values = {f"{e}.{p}": value for e in effects for p, value in space.values(e, vector).items()}
        return np.array([QUANTITIES[name].value(windows.vehicle, effect_values) for name in names])

    values, step = to_quantities(vector), 1e-4
    change = np.stack([(to_quantities(vector + step * space.scale * axis) - values) / step
                       for axis in np.eye(len(space))[indices]], axis=1)
    margin = 1e-3 * (space.high - space.low)  # a value closer to a bound counts as being at it
    effects_at_bound = {space.parameters[i][0] for i in indices
                        if not space.low[i] + margin[i] < vector[i] < space.high[i] - margin[i]}
    points = len(windows.time)
    residuals = dict(zip(windows.columns, -errors[used].reshape(-1, len(windows.columns)).T, strict=True))
    return DrivingFit(
        tuple(names), values, blocks.make_spread(influence @ change.T),
        tuple(name for name in names if QUANTITIES[name].effect in effects_at_bound),
        change @ np.linalg.inv(total) @ change.T, residuals, np.repeat(windows.run[used], points),
        np.repeat(windows.seconds[used], points), counts,
        windows.mean_squared_curvature, windows.mean_acceleration, windows.peak_accelerations)
