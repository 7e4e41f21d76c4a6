"""Axle forces of a fitted model, compared with the measured forces, and combinations of vehicle parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..augmented import AugmentedModel
from ..effects import COMBINATIONS, EFFECTS, TOTAL_DELAY, get_effect
from ..errors import StCoreError
from ..handling import stability_factor
from ..identification import axle_forces
from ..log import DriveLog
from ..readings import correct_log
from ..sideslip import compute_steady_velocity_y
from ..tyres import GRAVITY
from ..vehicle import STIFFNESS_LIMITS, VehicleParameters
from .evidence import JointFit
from .fit import Fit, Problem
from .result import Combination
from .search import NearSet

DRAWS = 100  # number of random draws of the fitted values, for 90 % and 95 % intervals
MAX_SLIP = 0.35  # rad, slip angle beyond the peak force of every road tyre
MIN_SAMPLES = 100  # runs with fewer samples of slip and force are left out of the comparison with the vehicle file
MIN_FORCE_CHANGE = 0.01  # relative; an effect that changes the force by less does not count as acting on the axle
SMALL_SLIP = 0.005  # rad, slip angle at which the cornering stiffness of an axle is evaluated
GAIN_SPEED = 20.0  # m/s, speed at which the steady-state yaw rate gain is evaluated


class Axles:
    """Forces of both axles in a fitted model.

    joint_fit: covariance of the values; if None, there are no bands and the intervals have zero width.
    noise_ratio: ratio of residual to noise, by which bands and intervals are widened if it is above 1 [1].
    near_sets: `SearchState.near_optimal`; bands and intervals include all of these fits.
    Raises StCoreError for a base model without tyres, and if the drives are too short or the values too uncertain.
    """

    def __init__(self, problem: Problem, fit: Fit, joint_fit: JointFit | None, runs: Sequence[DriveLog],
                 vehicle: VehicleParameters, noise_ratio: float, near_sets: Sequence[NearSet] = ()):
        if not problem.space.model.base.has_tyres:
            raise StCoreError(f"{problem.space.model.base.name}: this model has no axle forces")
        self.problem, self.fit, self.runs, self.vehicle = problem, fit, runs, vehicle
        self.model = problem.space.at(fit.vector)
        self.car = _elastic_car(self.model, vehicle)
        self.has_sideslip = "velocity_y" in problem.errors.windows.settings.channels
        # Measured slip and force of both axles, corrected only for fitted effects of steering, sensors and load.
        logs, payloads = [], problem.space.payloads
        corrector = self.model.select_effects(e for e in self.model.effects
                                              if e.kind == "sensors" or e.slot == "steering" or e.name in payloads)
        car = corrector.effective_vehicle(vehicle)
        for run in runs:
            log = correct_log(corrector, run)
            angle = corrector.effective_road_wheel_angle(log.road_wheel_angle, vehicle)
            log = replace(log, road_wheel_angle=angle, steering_wheel_angle=None)
            logs.append(log if self.has_sideslip else replace(log, velocity_y=compute_steady_velocity_y(log, car)))
        self.regressions = axle_forces.fit_axle_regressions(logs, car)
        near_models = [problem.space.at(vector) for _, vector in near_sets if joint_fit]
        self.near_models = axle_forces.select_valid_models(near_models, vehicle)
        self.draws: list[AugmentedModel] = []
        if joint_fit is not None:
            in_model = joint_fit.indices < len(problem.space) - 1  # the last parameter is the accelerometer gain
            indices = joint_fit.indices[in_model]
            covariance, scale = np.zeros((len(self.model.vector),) * 2), problem.space.scale[indices]
            covariance[np.ix_(indices, indices)] = joint_fit.covariance[np.ix_(in_model, in_model)] * np.outer(
                scale, scale) * max(noise_ratio, 1.0) ** 2
            model_error = np.array([p.model_error for _, p in self.model.free_parameters])[indices]
            covariance[indices, indices] += np.square(model_error)
            self.draws = axle_forces.draw_models(self.model, covariance, vehicle, DRAWS)

    def force_curves(self, base: AugmentedModel) -> tuple[axle_forces.ForceCurve, ...]:
        """`ForceCurve` of each axle in the slip range of the drives. base: initial model, for `ForceCurve.file`.
        Raises StCoreError for drives without slip."""
        return tuple(axle_forces.make_axle_curve(self.model, self.vehicle, r.axle, r.samples.slip, base, self.draws,
                                                 self.near_models) for r in self.regressions)

    def combinations(self, base: AugmentedModel) -> tuple[Combination, ...]:
        """`COMBINATIONS` of vehicle parameters, with 95 % intervals."""
        values, file_values = _combination_values(self.model, self.vehicle), _combination_values(base, self.vehicle)
        draws = np.array([_combination_values(model, self.vehicle) for model in self.draws] or [values])
        low, high = np.quantile(draws, (0.025, 0.975), axis=0)
        sets = [values, *(_combination_values(model, self.vehicle) for model in self.near_models)]
        low, high = np.min([low, *sets], axis=0).tolist(), np.max([high, *sets], axis=0).tolist()
        effects = {name: tuple(e.name for e in EFFECTS.values() if name in e.combinations) for name in COMBINATIONS}
        return tuple(Combination(name, unit, float(values[i]), (low[i], high[i]), float(file_values[i]), effects[name])
                     for i, (name, unit) in enumerate(COMBINATIONS.items()))

    def compute_force_ratios(self) -> dict[str, float]:
        """Largest force up to the 99.5 % quantile of the slip in the drives, divided by the peak force [1], by axle."""
        ratios = {}
        for regression in self.regressions:
            slip = np.linspace(0.0, MAX_SLIP, 61)
            force = axle_forces.compute_axle_force(self.model, self.vehicle, regression.axle, slip)
            largest_slip = float(np.quantile(np.abs(regression.samples.slip), 0.995))
            reached_force = float(np.interp(largest_slip, slip, np.maximum.accumulate(force)))
            ratios[regression.axle] = reached_force / max(float(force.max()), 1.0)
        return ratios

    def find_effects_on_axle(self, axle: str, names: Sequence[str]) -> tuple[str, ...]:
        """The effects among `names` that change the force of an axle at the slip angles of the drives."""
        samples = next(regression.samples for regression in self.regressions if regression.axle == axle)
        slip = np.quantile(np.abs(samples.slip), (0.5, 0.95))
        force = axle_forces.compute_axle_force(self.model, self.vehicle, axle, slip)
        models = {name: self.problem.space.at(self.problem.vector_without(self.fit, name)) for name in names}
        changes = {name: axle_forces.compute_axle_force(model, self.vehicle, axle, slip) / force - 1.0
                   for name, model in models.items()}
        return tuple(name for name, change in changes.items() if np.abs(change).max() > MIN_FORCE_CHANGE)

    def find_worse_axles(self, base: AugmentedModel,
                         leave_one_out: Mapping[str, Mapping[str, Mapping[str, float]]]) -> tuple[str, ...]:
        """Axles with measured forces that agree less well with the model than with the vehicle file; none if sideslip
        is not measured or excitation is low. leave_one_out: see `Discovery`."""
        space, worse_axles = self.problem.space, []
        base = base.with_values({name: space.values(name, self.fit.vector) for name in space.payloads})
        for regression in self.regressions if self.has_sideslip else ():
            if not regression.usable:
                continue
            squared_errors = np.zeros(2)  # of the model, of the vehicle file
            for k, run in enumerate(self.runs):
                in_run = np.asarray(regression.samples.run_index) == k
                if in_run.sum() < MIN_SAMPLES:
                    continue
                samples = replace(regression.samples, **{name: getattr(regression.samples, name)[in_run]
                                                         for name in ("slip", "force", "run_index", "time", "used")})
                held_out_model = self.model.with_values(leave_one_out.get(run.name, {}))
                squared_errors += [axle_forces.compute_force_error(model, self.vehicle, samples) ** 2
                                   for model in (held_out_model, base)]
            if squared_errors[0] > squared_errors[1]:
                worse_axles.append(regression.axle)
        return tuple(worse_axles)


def _combination_values(model: AugmentedModel, vehicle: VehicleParameters) -> np.ndarray:
    """(5,) `COMBINATIONS` of a model."""
    car = _elastic_car(model, vehicle)
    yaw_gain = GAIN_SPEED / (car.wheelbase * (1.0 + stability_factor(car) * GAIN_SPEED**2))
    # Road wheel angles at a steering wheel angle of -1 and 1 rad; a steering offset cancels in their difference.
    right, left = (model.effective_road_wheel_angle(side / vehicle.steering_ratio, vehicle) for side in (-1.0, 1.0))
    delay = sum(sum(values.values()) for name, values in model.values.items()
                if TOTAL_DELAY in get_effect(name).combinations)
    front = car.cornering_stiffness_front / (2.0 * car.static_tyre_load_front)
    rear = car.cornering_stiffness_rear / (2.0 * car.static_tyre_load_rear)
    return np.array([front, rear, stability_factor(car), 0.5 * yaw_gain * float(left - right), delay])


def _elastic_car(model: AugmentedModel, vehicle: VehicleParameters) -> VehicleParameters:
    """The car of a model, with the axle stiffnesses at small slip, which include compliance and roll steer."""
    car = model.effective_vehicle(vehicle)
    low, high = (limit * car.mass * GRAVITY for limit in STIFFNESS_LIMITS)  # random draws are clipped to the limits
    front, rear = (min(max(float(force[0]) / SMALL_SLIP, low), high)
                   for force in axle_forces.compute_axle_forces(model, vehicle, np.array([SMALL_SLIP])))
    return replace(car, cornering_stiffness_front=front, cornering_stiffness_rear=rear)
