"""Finds the effects that a model lacks, with their values, and the remaining residual, from recorded drives."""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..channels import CHANNELS
from ..effects import REAR_STEERING, TOTAL_DELAY, get_effect
from ..errors import StCoreError
from ..handling import find_implausible_values
from ..identification.axle_forces import ForceCurve
from ..log import DriveLog
from ..models import Model
from ..regression import Z95
from ..timeseries import NANOSECOND
from ..vehicle import VehicleParameters
from . import decision, result, waterfall
from .axles import Axles
from .error_regions import MIN_TURNING_ACCELERATION, find_error_regions
from .evidence import Evidence, JointFit, approximate_joint_fit, error_reductions, library_p_value, relative_reduction
from .fit import Fit, Problem
from .library_fit import MAX_CLOCK_DEVIATION, apply_clock_corrections, estimate_clock_corrections, fit_healthy_car
from .loss import Errors, Loss
from .next_manoeuvre import Curvatures, choose_manoeuvre, find_most_informative, list_separabilities, simulate_catalogue
from .partitions import MIN_RUNS, Partition, find_sites, make_partitions
from .power_analysis import EFFECT_SIZES, find_confounding_effect, measure_power, predict_power
from .search import Search, SearchState
from .settings import DiscoverySettings
from .space import Space, find_file_quantities
from .varying import VaryingFit, collect_varying_evidence, find_varying_effects
from .windows import MARGIN_NS, MIN_SPEED, Windows

Progress = Callable[[str, int, int], None]
SensorEstimates = Mapping[str, tuple[float, float, float]]
MIN_TURNING_FRACTION = 0.05  # smallest fraction of driving in turns, and of turns to each side, without a warning
CONTAINED_IN_INPUT = "the measured forward acceleration is an input and already contains it"
NEVER_TESTABLE = {"drag": CONTAINED_IN_INPUT, "rolling_resistance": CONTAINED_IN_INPUT,
                  "grade": f"{CONTAINED_IN_INPUT}; pitch is not measured"}  # effect: reason


def discover(runs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model = "nonlinear",
             reference: Sequence[DriveLog] = (), settings: DiscoverySettings | None = None,
             progress: Progress | None = None, sensor_estimates: SensorEstimates | None = None, parallel: int = 1,
             clocks: Mapping[str, float] | None = None) -> result.Discovery:
    """Find the effects that the base model lacks to explain the runs.

    runs: drives to be diagnosed.
    vehicle: parameters of the vehicle file, from which the search starts.
    reference: drives of the healthy car; the search then starts from the fit to these drives and finds later changes.
    progress(stage, done, total): called regularly; total is at least 100 and exceeds done.
    sensor_estimates: (value, lower, upper 95 % limit) from redundant sensors, by name of the estimate in `checks`.
    parallel: number of threads.
    clocks: standard deviation of the error of the steering clock [s], by run; clocks of other runs count as exact.
    Raises StCoreError for duplicate names and too few usable predictions, ConfigurationError for settings that are not
    valid for the base model. Checked by: test_discovery*.py, bench/discovery.
    """
    return _Analysis(runs, vehicle, base, reference, settings or DiscoverySettings(), progress, sensor_estimates or {},
                     parallel, clocks or {}).analyse()


def fit_effects(runs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model, names: Sequence[str],
                settings: DiscoverySettings | None = None) -> Model:
    """The base model with the given effects fitted jointly to the runs. Raises ConfigurationError for an effect that is
    unknown or does not apply to the base model."""
    names = (names,) if isinstance(names, str) else tuple(names)
    settings = replace(settings or DiscoverySettings(), effects=names or None)
    space = Space(base, settings)
    windows = Windows(runs, vehicle, settings)
    loss = Loss(Errors(windows, space), space.null)
    problem = Problem(loss, space.null, windows.block, quantities=find_file_quantities(space, vehicle))
    problem.update_design_effect(space.null)
    fit = problem.fit((), problem.all_sensitivities(space.null))
    for _ in range(3):
        fit = problem.fit(names, problem.all_sensitivities(fit.vector), iterations=5)
        loss.rescale(fit.vector)
        problem.update_design_effect(fit.vector)
    return space.at(problem.refit(fit).vector)


class _JudgedEffects(NamedTuple):
    """The effects of the final fit by verdict, and results that depend on the verdicts."""

    named: tuple[result.FoundEffect, ...]
    minor: tuple[result.FoundEffect, ...]  # in the model, but not reported as causes
    contradicted: tuple[result.FoundEffect, ...]  # refuted by measured axle forces, or making the car implausible
    verdicts: dict[str, result.Reason]  # by effect
    leave_one_out: Mapping[str, Mapping[str, Mapping[str, float]]]
    curves: tuple[ForceCurve, ...]
    combinations: tuple[result.Combination, ...]  # those that no contradicted effect changes


class _Analysis:
    """Inputs of one discovery, and the steps from the search to the result."""

    def __init__(self, runs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model,
                 reference: Sequence[DriveLog], settings: DiscoverySettings, progress: Progress | None,
                 sensor_estimates: SensorEstimates, parallel: int, clocks: Mapping[str, float]):
        self.vehicle, self.settings, self.limits = vehicle, settings, settings.limits
        self._progress, self._count = progress, 0
        self.warnings: list[str] = []
        self.clock_errors: dict[str, float] = {}
        self._required_duration = settings.horizon + 2.0 * MARGIN_NS * NANOSECOND + 0.5  # of a usable run [s]
        self.runs, self.reference = self._select_usable(runs, "run"), self._select_usable(reference, "reference")
        if not self.runs:
            raise StCoreError(f"no run is long enough: a run needs {self._required_duration:.0f} s of driving faster "
                              f"than {MIN_SPEED:g} m/s with INS and steering")
        logs = [*self.runs, *self.reference]
        missing = [c for c in settings.channels if not all(CHANNELS[c].is_measured_in(log) for log in logs)]
        if missing:
            self.warnings.append(f"{', '.join(missing)}: not measured in every run, left out; effects that need "
                                 f"{'it' if len(missing) == 1 else 'them'} are not searched for")
        self.settings = settings = replace(settings, channels=tuple(c for c in settings.channels if c not in missing))
        self.space = Space(base, settings)
        self.threads = parallel
        self.runs, self.reference = (self._correct_clocks(logs, clocks) for logs in (self.runs, self.reference))
        self.windows = Windows(self.runs, vehicle, settings)
        if len(np.unique(self.windows.block)) < 2:  # no other block to hold out: no effect can be tested
            raise StCoreError(f"fewer than two blocks of {settings.block:g} s contain a prediction of "
                              f"{settings.horizon:g} s: drive longer, faster than {MIN_SPEED:g} m/s, without gaps")
        # Estimates from redundant sensors, keyed by "effect.parameter".
        self.sensors = {f"{effect}.{p.name}": sensor_estimates[p.identity] for effect in self.space.hypotheses
                        for p in get_effect(effect).parameters if p.identity and p.identity in sensor_estimates}

    def analyse(self) -> result.Discovery:  # long: the steps of a discovery in their order, and its result
        self.problem, column_noise = self._make_problem()
        settings, space, problem = self.settings, self.space, self.problem
        self._warn_of_low_excitation()
        partitions = make_partitions(self.windows)
        search = Search(problem, self.limits, partitions, self.sensors, settings.seed, self._ticker("searching"))
        state = search.run()
        without_priors, fit = self._add_corrections(state, partitions)
        self._ticker("decomposing the errors")()
        horizon_errors = waterfall.HorizonErrors(without_priors, settings.seed)
        varying, varying_fit = self._find_varying(state, partitions)
        channel_noise = self._channel_noise(column_noise)
        judged = self._judge_effects(search, state, partitions, channel_noise)
        steps, base = waterfall.build_steps(problem, state.fit, state.order, horizon_errors, partitions)
        errors = waterfall.compare_channel_errors(horizon_errors, base, fit, channel_noise)
        named_errors = waterfall.compare_channel_errors(horizon_errors, base, state.fit, channel_noise)
        budget = waterfall.build_budget(problem, base, state.fit, fit, varying_fit, horizon_errors)
        power = (measure_power(problem, state.fit, self.limits, settings.seed, self._ticker("measuring power"))
                 if settings.simulate_power else predict_power(problem, state.fit, state.scores, self.limits))
        effects, design_effect = judged.named, state.scores.design_effect
        curvatures: Curvatures = {}
        if settings.locate_errors or any(e.alternatives for e in effects):
            self._ticker("simulating manoeuvres")()
            curvatures = simulate_catalogue(problem, state.fit)
        untestable = self._find_untestable(state, power, judged, curvatures)
        noise, position = max(channel_noise.get("position_5s", 0.0), 1e-9), named_errors.get("position_5s")
        noise_ratios = (position.base / noise, position.augmented / noise) if position else (np.nan, np.nan)
        outcome, reasons = self._decide_outcome(state, judged, untestable, noise_ratios, len(varying))
        separability = list_separabilities(problem, state.fit, effects, design_effect)
        regions = self._locate_errors(base, channel_noise) if settings.locate_errors else ()
        signature = (f"the position error is {noise_ratios[1]:.1f} times the noise",
                     *(f"large {CHANNELS[r.channel].label} error: {r.condition}" for r in regions[:5]))
        assumed = {q.key: result.AssumedQuantity(q.key, q.unit, q.value, q.deviation, q.stated)
                   for q in problem.quantities if q is not None}
        return result.Discovery(
            outcome=outcome, effects=effects, minor=judged.minor, combinations=judged.combinations,
            effective=(*judged.contradicted, *self._list_corrections(without_priors, fit, state)),
            varying=varying, steps=tuple(steps), errors=errors, named_errors=named_errors,
            budget=tuple(budget), reasons=reasons, large_error_regions=regions,
            candidates=self._list_candidates(state, judged.verdicts), not_testable=untestable,
            next_manoeuvre=choose_manoeuvre(problem, state.fit, separability, curvatures, design_effect),
            separability=separability, power_analysis=power, runs=self._list_runs(), clock_errors=self.clock_errors,
            signature=signature if noise_ratios[1] > self.limits.max_noise_ratio else (), base=space.at(base.vector),
            start="reference" if self.reference else "vehicle file", warnings=tuple(self.warnings),
            model=space.at(fit.vector) if fit.names else None, assumed=tuple(assumed.values()),
            named=space.at(problem.vector_without(state.fit, *(e.name for e in judged.contradicted)))
            if state.order else None, leave_one_out=judged.leave_one_out, axle_curves=judged.curves,
            # The residual of the best model counts as noise in all later comparisons, whatever its cause.
            noise={c: error.augmented for c, error in errors.items()}, acceleration_gain=float(fit.vector[-1]))

    def _judge_effects(self, search: Search, state: SearchState, partitions: Mapping[str, Partition],
                       channel_noise: Mapping[str, float]) -> _JudgedEffects:
        """The effects found by the search, with verdicts, force curves and combinations of vehicle parameters."""
        problem = self.problem
        # All other parameters of the library are free as well, so that intervals include their possible contribution.
        joint_fit = approximate_joint_fit(problem, state.fit) if problem.prior is None else None
        position_error, _ = error_reductions(problem.position_error(problem.held_out_residuals(state.fit)), None)
        noise_ratio = position_error / max(channel_noise.get("position_5s", 0.0), 1e-9)  # 0 without positions
        sensors, effects = {} if self.reference else self.sensors, []
        for name in state.order:
            evidence = state.evidence[name]
            values = waterfall.estimate_parameters(problem, state.fit, name, partitions, state.near_optimal, joint_fit,
                                                   noise_ratio)
            effects.append(result.FoundEffect(
                name, get_effect(name).kind,
                {n: replace_interval(p, sensors.get(f"{name}.{n}")) for n, p in values.items()},
                (), evidence.position_reduction, _local_estimates(evidence),
                search.find_cancelling_effects(state.fit, name), *decision.find_most_affected(evidence, self.limits),
                "" if self.reference else get_effect(name).imitated_by))
        leave_one_out = waterfall.leave_one_out(problem, state.fit)
        axles, curves, combinations = self._analyse_axles(state, joint_fit, noise_ratio)
        verdicts = self._decide_reporting(state, effects, axles, leave_one_out)
        for name, verdict in verdicts.items():
            if verdict.rule == decision.NAMED and not decision.is_confirmed(state.evidence[name], self.limits):
                verdicts[name] = decision.judge_necessity(search.find_best_rival(state, name), self.limits) or verdict
        imitated = [e for e in effects if REAR_STEERING in e.other_causes]
        otherwise_named = [e.name for e in imitated if verdicts[e.name].rule == decision.NAMED]
        if otherwise_named and (text := describe_common_cause(imitated, self.vehicle.wheelbase)):
            self.warnings.append(text)
            verdicts |= {name: result.Reason(decision.MINOR, name, {}, text) for name in otherwise_named}
        effects = [replace(e, alternatives=decision.list_alternatives(state.rivals.get(e.name, ()), self.limits))
                   for e in effects]
        named, minor, contradicted = (tuple(e for e in effects if verdicts[e.name].rule in rules) for rules in (
            (decision.NAMED,), (decision.MINOR,), (decision.FORCES, decision.IMPLAUSIBLE)))
        refuted = {part for e in contradicted for part in (e.name, *get_effect(e.name).members)}
        return _JudgedEffects(named, minor, contradicted, verdicts, leave_one_out, curves,
                              tuple(complete_delay(c, effects) for c in combinations if not refuted & {*c.effects}))

    def _decide_outcome(self, state: SearchState, judged: _JudgedEffects, untestable: Sequence[result.UntestableEffect],
                        noise_ratios: tuple[float, float], n_varying: int,
                        ) -> tuple[result.Outcome, tuple[result.Reason, ...]]:
        """(outcome, the reasons for it and for each effect). noise_ratios: position error divided by noise, with the
        base model and with the final model."""
        hypotheses = self.space.hypotheses
        detectable = 1.0 - sum(n.name in hypotheses for n in untestable) / len(hypotheses)
        combinations = result.unseparated_combinations(judged.combinations, judged.named)
        outcome, reason = decision.decide(
            self.limits, named=[state.evidence[e.name] for e in judged.named], rivals=state.rivals,
            rejected=[evidence for evidence, *_ in state.rejected.values()], noise_ratio=noise_ratios[1],
            detectable_share=detectable, n_varying=n_varying, combinations=[c.name for c in combinations],
            n_effects=len(state.fit.names), base_noise_ratio=noise_ratios[0])
        return outcome, (reason, *judged.verdicts.values(),
                         *(decision.judge_alternative(r, self.limits) for r in state.all_rivals),
                         *(verdict for _, verdict, _ in state.rejected.values()))

    def _add_corrections(self, state: SearchState, partitions: Mapping[str, Partition]) -> tuple[Problem, Fit]:
        """(problem without the priors of the vehicle file, its fit with effective corrections added); problem and fit
        of the search if the gain is too small, the position error grows, or reference drives replace these priors."""
        problem, scale = self.problem, self.problem.loss.scale
        if problem.prior is not None:
            return problem, state.fit
        without_priors = copy(problem)  # its fits predict best, but may be implausible
        without_priors.set_quantities((None,) * len(self.space))
        search = Search(without_priors, self.limits, partitions, self.sensors, self.settings.seed,
                        self._ticker("searching for corrections"), decision.judge_correction)
        fit = search.add_corrections(state.fit)
        problem.loss.scale = scale
        fit = without_priors.fit_at(fit.names, fit.vector, fit.indices, fit.sensitivities)
        gain = without_priors.held_out_gain(state.fit, fit)
        # Both sums are over the same windows; they are 0 if position is not a channel.
        before, after = (np.nansum(p.position_error(p.held_out_residuals(f)))
                         for p, f in ((problem, state.fit), (without_priors, fit)))
        return (problem, state.fit) if gain < self.limits.relevant or after > before else (without_priors, fit)

    def _make_problem(self) -> tuple[Problem, dict[str, float]]:
        """(problem, noise by column). With reference drives, the problem starts from the fit to these drives, and the
        position error of this fit counts as noise of position_5s."""
        settings, space = self.settings, self.space
        start, prior, covariance, gain, column_noise = space.null, None, None, 0.0, self.windows.noise_floor()
        if self.reference:
            tick = self._ticker("fitting the reference drives")
            healthy = fit_healthy_car(self.reference, self.vehicle, space, settings, self.threads, tick)
            start, prior, covariance = healthy.vector, healthy.prior, healthy.covariance
            gain = healthy.gain_between_runs
            # The residual of the healthy car counts as noise: it is not a change since the reference drives.
            column_noise = {c: max(column_noise[c], float(v))
                            for c, v in zip(self.windows.columns, healthy.residual_scale, strict=True)}
            column_noise["position_5s"] = healthy.position_error
        loss = Loss(Errors(self.windows, space, self.threads), start)
        return Problem(loss, start, self.windows.block, prior,
                       np.array([column_noise[c] for c in self.windows.columns]), gain,
                       find_file_quantities(space, self.vehicle) if prior is None else None, covariance), column_noise

    def _select_usable(self, runs: Sequence[DriveLog], role: str) -> list[DriveLog]:
        """The runs that are long enough; warns about the others."""
        if short := [run.name for run in runs if run.overlap < self._required_duration]:
            self.warnings.append(f"{role} {', '.join(short)}: not used, INS and steering overlap for less than "
                                 f"{self._required_duration:.1f} s")
        return [run for run in runs if run.overlap >= self._required_duration]

    def _correct_clocks(self, runs: list[DriveLog], deviations: Mapping[str, float]) -> list[DriveLog]:
        """The runs with corrected steering time stamps; warns if the steering clock of a run is uncertain."""
        uncertain = [s for run in runs if (s := deviations.get(run.name, 0.0)) > MAX_CLOCK_DEVIATION]
        if not uncertain:
            return runs
        corrections = estimate_clock_corrections(runs, self.vehicle, self.space, self.settings, deviations,
                                                 self.threads, self._ticker("correcting clocks"))
        self.clock_errors |= corrections
        remaining = (f"; the search corrects the clocks of these runs by {1e3 * min(corrections.values()):.0f} to "
                     f"{1e3 * max(corrections.values()):.0f} ms. An error common to all runs"
                     if corrections else ": its error")
        self.warnings.append("the offset of the steering clock has a standard deviation of up to "
                             f"{1e3 * max(uncertain):.0f} ms, in {len(uncertain)} of {len(runs)} runs{remaining} has "
                             "the same effect as steering delay or lag, yaw inertia or tyre relaxation (log INS frames "
                             "on CAN, or give the clock offset)")
        return apply_clock_corrections(runs, corrections)

    def _warn_of_low_excitation(self) -> None:
        if len(self.runs) < MIN_RUNS:
            count = "one run" if len(self.runs) == 1 else f"{len(self.runs)} runs"
            self.warnings.append(f"{count} only: parts of runs are compared with each other instead of whole runs")
        if not find_sites(self.windows).any():
            self.warnings.append("all driving is at one site: effects of the site, such as banked roads and wind, "
                                 "cannot be separated from properties of the car")
        if (blocks := self.problem.blocks) < 10:
            self.warnings.append(f"only {blocks} blocks of {self.settings.block:g} s: tests have little power")
        lateral_acceleration = self.windows.joined_log.yaw_rate * self.windows.joined_log.velocity_x
        left, right = ((side * lateral_acceleration > MIN_TURNING_ACCELERATION).mean() for side in (1.0, -1.0))
        if left + right < MIN_TURNING_FRACTION:
            self.warnings.append("nearly all driving is straight: tyres, steering ratio and mass are not identifiable")
        elif min(left, right) < MIN_TURNING_FRACTION * (left + right):
            self.warnings.append("nearly all turns are to one side: offsets of sensors and steering are not separable "
                                 "from changes of the car")

    def _analyse_axles(self, state: SearchState, joint_fit: JointFit | None, noise_ratio: float) -> tuple[
            Axles | None, tuple[ForceCurve, ...], tuple[result.Combination, ...]]:
        """(axle forces of the final model, force curves, combinations); (None, (), ()) for a base model without tyres,
        for driving without slip, and for values so uncertain that they exceed the limits of a vehicle file. With
        reference drives there are no combinations, because these are compared with the vehicle file."""
        base = self.space.at(self.problem.start)
        try:
            axles = Axles(self.problem, state.fit, joint_fit, self.runs, self.vehicle, noise_ratio, state.near_optimal)
            return axles, axles.force_curves(base), axles.combinations(base) if joint_fit else ()
        except StCoreError:
            return None, (), ()

    def _decide_reporting(self, state: SearchState, effects: Sequence[result.FoundEffect], axles: Axles | None,
                          leave_one_out: Mapping[str, Mapping[str, Mapping[str, float]]]) -> dict[str, result.Reason]:
        """Verdict on each effect of the final fit: whether it is reported as a cause, and why."""
        worse_axles: dict[str, str] = {}
        violations: dict[str, str] = {}
        force_ratios = dict.fromkeys(("front", "rear"), np.nan) if axles is None else axles.compute_force_ratios()
        names = [e.name for e in effects]
        at_peak = [] if self.reference else [get_effect(name) for name in names if get_effect(name).at_peak_force]
        peak_force_ratios = {effect.name: max((ratio for axle, ratio in force_ratios.items() if effect.slot in (
            f"{axle} axle", "both axles")), default=1.0) for effect in at_peak}
        if axles is not None and not self.reference:
            for axle in axles.find_worse_axles(self.space.at(self.space.null), leave_one_out):
                worse_axles |= dict.fromkeys(axles.find_effects_on_axle(axle, names), axle)
            for name in names:
                model = self.space.at(self.problem.start).with_values({name: self.space.values(name, state.fit.vector)})
                implausible = find_implausible_values(model.effective_vehicle(self.vehicle), self.vehicle, axles.car)
                violations[name] = next(iter(implausible), "")
        refuted = [name for name in names if worse_axles.get(name) or violations.get(name)]
        dependent = self._find_dependent(state.fit, effects, refuted) if refuted else ()
        # Only the total delay of the steering is identifiable, not its parts.
        delays = [n for n in names if TOTAL_DELAY in get_effect(n).combinations] if axles is not None else []
        return {e.name: decision.judge_reporting(
            state.evidence[e.name], self.limits,
            excludes_null=any(not p.interval[0] <= p.null <= p.interval[1] for p in e.parameters.values()),
            parameter_at_bound="" if self.reference else find_parameter_across_bound(e),
            peak_force_ratio=peak_force_ratios.get(e.name, 1.0), worse_axle=worse_axles.get(e.name, ""),
            violation=violations.get(e.name, ""), depends_on=refuted if e.name in dependent else (),
            summands=tuple(n for n in delays if n != e.name) if e.name in delays else ()) for e in effects}

    def _find_dependent(self, fit: Fit, effects: Sequence[result.FoundEffect], refuted: Sequence[str]) -> list[str]:
        """Effects with a value that leaves its interval if the refuted effects are removed and all others refitted."""
        names = tuple(n for n in fit.names if n not in refuted)
        without = self.problem.refit(self.problem.fit(names, self.problem.all_sensitivities(fit.vector)))
        return [e.name for e in effects if e.name in names and any(
            not p.interval[0] <= self.space.values(e.name, without.vector)[key] <= p.interval[1]
            for key, p in e.parameters.items())]

    def _list_corrections(self, problem: Problem, fit: Fit, state: SearchState) -> tuple[result.FoundEffect, ...]:
        """Effects of `fit` that are not in `state.fit`. Their `position_5s_increase` is in-sample, without a refit."""
        position = problem.position_error(problem.errors.at(fit.vector))
        return tuple(result.FoundEffect(
            n, get_effect(n).kind, waterfall.estimate_parameters(problem, fit, n, {}), (), error_reductions(
                problem.position_error(problem.errors.at(problem.vector_without(fit, n))) - position, None)[0], {})
            for n in fit.names if n not in state.fit.names)

    def _find_varying(self, state: SearchState,
                      partitions: Mapping[str, Partition]) -> tuple[tuple[result.VaryingEffect, ...], Fit | None]:
        """(at most one significant effect that varies between parts of the drives, its fit): an effect that the search
        rejected for this reason; otherwise the one with the largest gain from separate values, without a fit."""
        varying, varying_fit = None, None
        # An effect of the final fit, or an alternative to one, is not also reported as varying.
        reported = [*state.fit.names, *(r.name for r in state.all_rivals if decision.is_alternative(r, self.limits))]
        for name, (evidence, verdict, fit) in state.rejected.items():
            if (verdict.rule == decision.VARIES and not self.space.overlaps(name, reported)
                    and decision.is_relevant(evidence, self.limits)):
                partition = decision.varying_partition(evidence, self.limits)
                varying_fit, varying = fit, result.VaryingEffect(
                    name, partition, waterfall.estimate_parameters(self.problem, fit, name, {}),
                    _local_estimates(evidence)[partition], evidence.position_reduction)
                break
        for v in find_varying_effects(self.problem, state.fit, partitions) if varying is None else ():
            evidence = collect_varying_evidence(self.problem, state.fit, v, partitions)
            if decision.varies_relevantly(evidence, self.limits) and not self.space.overlaps(v.name, reported):
                varying = describe_varying(v, self.space, evidence.position_reduction)
                break
        if varying is None:
            return (), None
        self.warnings.append(f"an effect similar to {varying.resembles.replace('_', ' ')} is significant, but varies "
                             f"between {decision.PARTITION_NAMES[varying.varies_with]}; it is listed as varying")
        return (varying,), varying_fit

    def _list_candidates(self, state: SearchState,
                         verdicts: Mapping[str, result.Reason]) -> tuple[result.CandidateEffect, ...]:
        """Every effect of the library with its gain and verdict, in order of decreasing gain."""
        problem, space, candidates = self.problem, self.space, []
        # An effect that was tried in place of several others is listed with the one that it replaces best.
        rivals = {r.name: r for r in sorted(state.all_rivals, key=lambda r: (decision.is_alternative(r, self.limits),
                                                                            r.gain_ratio))}
        for name in space.hypotheses:
            values: Mapping[str, float] = space.values(name, state.fit.vector)
            if name in state.evidence:
                verdict, gain = verdicts[name], state.evidence[name].gain
            elif name in state.rejected:
                evidence, verdict, fit = state.rejected[name]
                gain, values = evidence.gain, space.values(name, fit.vector)
            elif name in rivals:
                rival = rivals[name]
                verdict = decision.judge_alternative(rival, self.limits)
                gain, values = rival.evidence.gain, rival.values
            elif name in state.scores.by_effect:
                gains, vector = state.scores.gains[name]
                values = space.values(name, vector)
                gain = float(gains.sum()) / problem.residual_count
                p_value = library_p_value(state.scores.by_effect[name], gains, state.scores, len(space.hypotheses))
                verdict = decision.judge(Evidence(name, gain, p_value), self.limits)
                if verdict.rule == decision.ACCEPTED:
                    verdict = result.Reason(decision.EXPLAINS_LESS, name, {"gain": gain}, "it reduces the errors by "
                                            f"{100 * relative_reduction(gain):.1f} %; effects that reduce them by more "
                                            "were tried first")
            else:
                verdict, gain = result.Reason("included", name, {}, "overlaps an effect of the model"), 0.0
            candidates.append(result.CandidateEffect(name, get_effect(name).kind, values, relative_reduction(gain),
                                                     verdict.rule, verdict.text))
        return tuple(sorted(candidates, key=lambda c: -c.gain))

    def _find_untestable(self, state: SearchState, power: result.PowerAnalysis, judged: _JudgedEffects,
                         curvatures: Curvatures) -> tuple[result.UntestableEffect, ...]:
        """Effects that are not detectable in these drives, with the reason and a manoeuvre to detect them."""
        names = {*(name for e in judged.named for name in (e.name, *e.alternatives)), *(e.name for e in judged.minor)}
        untestable, problem = [], self.problem
        for name in self.space.hypotheses:
            powers = [p for p in power.powers if p.effect == name]
            typical = powers[len(EFFECT_SIZES) - 1]
            if name in names or typical.probability >= self.limits.detection_power:
                continue
            other = find_confounding_effect(problem, state.fit, name, state.scores, self.limits)
            confounder = f"in these drives it cannot be separated from {other.replace('_', ' ')}; " if other else ""
            size = f"{100 * typical.size:.3g} %" if typical.unit == "1" else f"{typical.size:.3g} {typical.unit}"
            untestable.append(result.UntestableEffect(
                name, f"a change of {size} would be detected with probability {typical.probability:.2f}; "
                f"{confounder}it is visible in {get_effect(name).excited_by}",
                find_most_informative(problem, name, curvatures)))
        untestable += [result.UntestableEffect(n, f"it needs the signal {', '.join(get_effect(n).signals)}, which is "
                                               "not recorded") for n in self.space.without_signal]
        return (*untestable, *(result.UntestableEffect(name, reason) for name, reason in NEVER_TESTABLE.items()))

    def _channel_noise(self, column_noise: Mapping[str, float]) -> dict[str, float]:
        """Noise of each channel at the end of the horizon [SI], and mean position error that counts as noise [m]."""
        noise = {channel.name: float(np.hypot.reduce([column_noise[column] for column in channel.columns]))
                 for channel in self.windows.channels}
        if "position" in noise:  # mean of a Rayleigh distribution
            rayleigh_mean = noise["position"] * float(np.sqrt(np.pi) / 2.0)
            noise["position_5s"] = max(column_noise.get("position_5s", 0.0), rayleigh_mean)
        return noise

    def _locate_errors(self, fit: Fit, channel_noise: Mapping[str, float]) -> tuple[result.LargeErrorRegion, ...]:
        self._ticker("locating errors")()
        noise = {channel: value for channel, value in channel_noise.items() if channel != "position_5s"}
        return find_error_regions(self.runs, self.space.at(fit.vector), self.vehicle, self.settings, self.reference,
                                  noise, float(fit.vector[-1]))

    def _list_runs(self) -> tuple[result.Run, ...]:
        site = find_sites(self.windows)
        windows = [np.flatnonzero(self.windows.run == k) for k in range(len(self.runs))]
        return (*(result.Run(log.name, "suspect", log.overlap, int(site[rows[0]]) if len(rows) else 0, len(rows))
                  for log, rows in zip(self.runs, windows, strict=True)),
                *(result.Run(log.name, "reference", log.overlap, 0, 0) for log in self.reference))

    def _ticker(self, stage: str) -> Callable[[], None]:
        """A function that reports the progress of a stage."""
        def tick() -> None:
            self._count += 1
            if self._progress:
                self._progress(stage, self._count, max(100, self._count + 1))
        return tick


def _local_estimates(evidence: Evidence) -> dict[str, tuple[result.LocalEstimate, ...]]:
    return {partition: tuple(result.LocalEstimate(part, *estimate) for part, estimate in a.ratios.items())
            for partition, a in evidence.agreement.items()}


def complete_delay(delay: result.Combination, effects: Sequence[result.FoundEffect]) -> result.Combination:
    """The total delay, with alternatives of the effects found, such as tyre relaxation, added to its `effects`. If only
    one effect of the model contributes, the interval is extended to include the interval of this effect. Combinations
    other than the total delay are returned unchanged."""
    if not delay.is_delay:
        return delay
    contributors = [e for e in effects if e.name in delay.effects]
    low, high = delay.interval
    for p in contributors[0].parameters.values() if len(contributors) == 1 else ():
        low, high = min(low, p.interval[0]), max(high, p.interval[1])
    names = dict.fromkeys((*delay.effects, *(other for e in contributors for other in e.alternatives)))
    return replace(delay, interval=(low, high), effects=tuple(names))


def describe_varying(v: VaryingFit, space: Space, position_reduction: float) -> result.VaryingEffect:
    """Result for an effect with a separate value in each part; ratios are relative to the value furthest from null."""
    parameter, null = space.parameters[v.index][1], float(space.null[v.index])
    value, deviation = max(v.values.values(), key=lambda estimate: abs(estimate[0] - null))
    change = value - null or float(space.scale[v.index])
    ratios = tuple(result.LocalEstimate(part, (x - null) / change, s / abs(change))
                   for part, (x, s) in v.values.items())
    fitted = result.FittedParameter(value, parameter.unit, (value - Z95 * deviation, value + Z95 * deviation), null)
    return result.VaryingEffect(v.name, v.varies_with, {parameter.name: fitted}, ratios, position_reduction)


def describe_common_cause(effects: Sequence[result.FoundEffect], wheelbase: float) -> str:
    """A sentence if rear wheels steered by k times the front angle explain both a ratio f and an INS position x, or "".

    effects: those that such rear wheels imitate.

        r = v delta (1 - k) / l,    f = 1 / (1 - k),    x = k delta v / r = l (f - 1);    a wheelbase f l acts alike
    """
    found = {key: p for e in effects for key, p in e.parameters.items()}
    ratio, x = found.get("factor"), found.get("x")
    if ratio is None or x is None or any(p.interval[0] <= p.null <= p.interval[1] for p in (ratio, x)):
        return ""
    low, high = (wheelbase * (end - 1.0) for end in ratio.interval)
    if x.interval[1] < low or high < x.interval[0]:
        return ""
    return (f"a steering ratio {ratio.value:.3f} times the file's and an INS position {x.value:+.2f} m from the file's "
            "are not reported as causes, because one cause explains both: rear wheels that steer by "
            f"{1.0 - 1.0 / ratio.value:+.3f} times the front angle, or a wheelbase of {wheelbase * ratio.value:.2f} m")


def find_parameter_across_bound(effect: result.FoundEffect) -> str:
    """Name of a parameter with an interval that crosses one of its `physical_bounds`; "" if there is none."""
    return next((p.name for p in get_effect(effect.name).parameters if (entry := effect.parameters.get(p.name)) and any(
        entry.interval[0] < edge < entry.interval[1] for edge in p.physical_bounds)), "")


def replace_interval(fitted: result.FittedParameter,
                     sensors: tuple[float, float, float] | None) -> result.FittedParameter:
    """The fitted value with the smallest symmetric interval that contains the sensors' interval. `fitted` is returned
    unchanged if this interval would include the null value, or if the fitted interval excludes the null value or does
    not overlap the sensors' interval."""
    value, (_, low, high) = fitted.value, sensors or (0.0, -np.inf, np.inf)
    half_width = max(high - value, value - low)
    contains_null = fitted.interval[0] <= fitted.null <= fitted.interval[1]
    overlap = low <= fitted.interval[1] and fitted.interval[0] <= high
    if not (contains_null and overlap) or abs(value - fitted.null) <= half_width:
        return fitted
    return replace(fitted, interval=(value - half_width, value + half_width))
