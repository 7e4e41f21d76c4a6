"""Search for an empirical relation missing from the result of `discover`: a curve added to one term of the model."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..augmented import AugmentedModel
from ..discovery.evidence import Agreement
from ..discovery.result import Discovery
from ..discovery.settings import DiscoverySettings
from ..discovery.windows import Windows
from ..log import DriveLog
from ..vehicle import VehicleParameters
from . import selection
from .candidates import FACTORS, SENSOR_READINGS, TYPICAL_SIZES, Candidate, compute_quantities, split_name
from .formulas import Formula, simulate_formulas
from .next_drive import NextDrives, find_sparse_ranges, simulate_drives
from .relation_fit import RelationFit, RelationFits
from .selection import ScreenedCandidate

MAX_FITTED_CANDIDATES = 10  # largest number of candidates fitted by simulation
MIN_BLOCKS = 10  # minimum number of blocks for a curve with eight coefficients
MAX_DETECTION_LIMIT = 3.0  # typical magnitudes; a model term counts as not examined if all its limits are higher
STEERING_TIMING = ("steering_rate", "lagging_steering")
"""Quantities with which a relation of the front steering can imitate a delayed or advanced steering signal."""
FitByCandidate = dict[ScreenedCandidate, RelationFit]


@dataclass(frozen=True, eq=False)
class Relation:
    """An empirical relation that reduces the held-out loss."""

    candidate: Candidate  # the term of the model that it modifies, and the quantity it depends on
    coefficients: np.ndarray  # (8,) of the splines
    points: np.ndarray  # (k,) values of the quantity
    value: np.ndarray  # (k,) the curve at these points [`Candidate.unit`]
    deviation: np.ndarray  # (k,) its standard deviation [`Candidate.unit`]
    density: np.ndarray  # (k,) fraction of the samples near each point
    gain: float  # reduction of the held-out loss per residual [1]
    p_value: float  # of the hypothesis of no gain, corrected for multiple testing [1]
    position_5s: tuple[float, float]  # held-out position error at the end of the horizon (without, with it) [m]
    runs: Mapping[str, tuple[float, float]]  # position_5s by run; empty without positions: position_5s is then (0, 0)
    model: AugmentedModel  # the model without the relation, at the values fitted with it
    alternatives: Mapping[str, float] = field(default_factory=dict)  # equally good relations: cosine similarity [1]
    formulas: Sequence[Formula] = ()  # closed forms that retain the curve's gain in simulation, best first
    agreement: Agreement = field(default_factory=lambda: Agreement({}, 1.0, 0.0))  # of its size across runs
    # Effects of the result that the relation replaces, with the residual reduction [1] that each still adds.
    redundant: Mapping[str, float] = field(default_factory=dict)
    next_drives: NextDrives = field(default_factory=NextDrives)  # ranges with few samples, and manoeuvres to drive next

    def describe_errors(self, template: str) -> str:
        """The template with both errors of `position_5s` filled in; "" without positions."""
        return template.format(*self.position_5s) if self.runs else ""


@dataclass(frozen=True)
class RelationSearch:
    """Result of a search."""

    relation: Relation | None  # None if none is significant and large enough
    reason: str  # text on the gain of the relation, or why there is none
    # Held-out gain per residual [1] and p-value [1] of each candidate, best first.
    statistics: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    # By candidate, smallest detectable linear relation, at the end of its range [unit of the curve].
    detection_limits: Mapping[str, float] = field(default_factory=dict)

    def find_unexamined_terms(self) -> list[str]:
        """Model terms for which all detection limits exceed MAX_DETECTION_LIMIT typical magnitudes."""
        smallest: dict[str, float] = {}
        for name, limit in self.detection_limits.items():
            term, _, factor = split_name(name)
            typical_size = TYPICAL_SIZES[term] / FACTORS.get(factor, 1.0)
            smallest[term] = min(smallest.get(term, np.inf), limit / typical_size)
        return [term for term, size in smallest.items() if size > MAX_DETECTION_LIMIT]


def needs_search(discovery: Discovery) -> bool:
    """Whether the residual of a discovery is large enough for a search: the outcome is unknown, or the position error
    at the end of the horizon exceeds `limits.max_noise_ratio` times the noise."""
    return discovery.outcome == "unknown" or bool(discovery.signature)


def find_relation(discovery: Discovery, runs: Sequence[DriveLog], vehicle: VehicleParameters,
                  settings: DiscoverySettings, threads: int = 1, tick: Callable[[], None] = lambda: None,
                  reported: Collection[tuple[str, str]] = ()) -> RelationSearch:
    """Find a relation missing in the model of a discovery, or the reason why none is reported.

    Every candidate is fitted together with the effects of the result; changes that a parameter of the vehicle file can
    reproduce are projected out of its evidence. A relation is reported if its p-value, corrected for the number of
    candidates, is below `limits.false_alarm`; if its held-out gain is significant and reaches `limits.relevant` of the
    residual or `limits.relevant_position`; if the predicted path improves at level `limits.false_alarm` (not required
    of a sensor relation); if the mean position error does not grow; and if the error of no run grows significantly and
    by at least `limits.relevant_position`. tick: called for each candidate.
    reported: (finding, channel) of `st check`; relations that may imitate a reported sensor fault are rejected.
    Raises StCoreError for a duplicate name, and if no run has both INS and steering.
    """
    measured_channels = tuple(c for c in settings.channels if c in discovery.noise)
    settings = replace(settings, channels=measured_channels or settings.channels)
    model = discovery.model or discovery.base
    if not model.has_tyres:
        return RelationSearch(None, "the kinematic model has no tyre slip and no axle forces for a relation to act "
                              "on: use --base linear or --base nonlinear")
    windows = Windows(runs, vehicle, settings)
    blocks = int(windows.block.max()) + 1 if len(windows) else 0
    if len(set(windows.run)) == 1:
        return RelationSearch(None, "only one usable run: a relation needs a second one for validation; add drives")
    if len(windows) < 3 or blocks < MIN_BLOCKS:
        return RelationSearch(None, f"only {blocks} blocks of {settings.block:g} s; a curve needs {MIN_BLOCKS}: drive "
                              "longer, or give more runs")
    names = [e.name for e in (*discovery.effects, *discovery.minor)]
    fits = RelationFits(windows, model, discovery.acceleration_gain, names, settings, threads)
    tick()
    base_fit = fits.fit_without_relation()
    screened = selection.screen(fits, base_fit, tick)
    if not screened:
        return RelationSearch(None, "no candidate relation changes a prediction of these drives: drive left and right "
                              "turns, accelerate and brake, at several speeds")
    return _select(screened, fits, base_fit, [e.name for e in discovery.effects], reported, tick)


def _select(screened: Sequence[ScreenedCandidate], fits: RelationFits, base_fit: RelationFit,
            effect_names: Sequence[str], reported: Collection[tuple[str, str]],
            tick: Callable[[], None]) -> RelationSearch:
    """The best significant candidate, or the reason why none is reported. effect_names: effects of the result."""
    limits, residual_count = fits.limits, fits.loss.residual_count
    p_values = selection.compute_p_values(screened, fits.blocks)
    ordered = sorted(screened, key=lambda s: -s.gain)
    statistics = {s.candidate.name: (s.gain / residual_count, p_values[s.candidate.name]) for s in ordered}
    level = limits.false_alarm / len(screened)
    detection_limits = {s.candidate.name: s.compute_detection_limit(level, fits.blocks) for s in screened}
    significant = [s for s in ordered if p_values[s.candidate.name] <= limits.false_alarm]
    if not significant:
        name, (gain, p_value) = next(iter(statistics.items()))
        return RelationSearch(None, f"no relation is significant. The best, {name}, changes the held-out loss by "
                              f"{-gain:+.3f} per residual, p = {p_value:.2g}, corrected for the number of "
                              f"candidates; p < {limits.false_alarm:g} is required", statistics, detection_limits)
    imitated_faults = {s: fault for s in significant if (fault := _find_imitated_fault(s.candidate, reported))}
    remaining = [s for s in significant if s not in imitated_faults]
    fitted, rejections = _fit_candidates(remaining, fits, base_fit, tick)
    rejections |= {s: f"{s.candidate.name} is significant, but may be the sensor fault that st check reports: "
                      f"{fault}. Correct it first and search again" for s, fault in imitated_faults.items()}
    accepted = [s for s in fitted if s not in rejections]
    if not accepted:
        first = next(s for s in significant if s in rejections)
        return RelationSearch(None, rejections[first], statistics, detection_limits)
    # A candidate with a factor must be better by at least the smallest relevant gain.
    best = min(accepted, key=lambda s: float(fitted[s].held_out.sum())
               + (limits.relevant * residual_count if s.candidate.factor else 0.0))
    relation, gain_text = _make_relation(best, fitted, base_fit, fits, p_values[best.candidate.name], effect_names)
    return RelationSearch(relation, gain_text, statistics, detection_limits)


def _fit_candidates(significant: Sequence[ScreenedCandidate], fits: RelationFits, base_fit: RelationFit,
                    tick: Callable[[], None]) -> tuple[FitByCandidate, dict[ScreenedCandidate, str]]:
    """Fit candidates by simulation: (fits with a usable curve, reasons to reject candidates)."""
    fitted: FitByCandidate = {}
    rejections: dict[ScreenedCandidate, str] = {}
    before = selection.compute_position_errors(fits, base_fit)
    # The best candidate of every term is fitted first.
    first = {s.candidate.term: s for s in reversed(significant)}
    ordered = list(dict.fromkeys([*sorted(first.values(), key=lambda s: -s.gain), *significant]))
    for s in ordered[:MAX_FITTED_CANDIDATES]:
        tick()
        fit = fits.fit(s.candidate, base_fit)
        name, after = s.candidate.name, selection.compute_position_errors(fits, fit)
        reason = selection.describe_unusable_curve(fits, fit)
        if not reason:
            fitted[s] = fit  # may be an alternative to the accepted relation, even if it is rejected
            reason = selection.describe_deterioration(fits, name, before, after) or selection.describe_small_gain(
                fits, s.candidate, base_fit.held_out - fit.held_out, before - after)
        if reason:
            rejections[s] = reason
    return fitted, rejections


def _find_imitated_fault(candidate: Candidate, reported: Collection[tuple[str, str]]) -> str:
    if candidate.term == "front_steer" and {candidate.quantity, candidate.factor} & set(STEERING_TIMING):
        return next((name for name, channel in reported if channel == "road_wheel_angle" and name.endswith("_lag")), "")
    return next((name for name, channel in reported if channel == SENSOR_READINGS.get(candidate.term)), "")


def _make_relation(best: ScreenedCandidate, fitted: FitByCandidate, base_fit: RelationFit, fits: RelationFits,
                   p_value: float, effect_names: Sequence[str]) -> tuple[Relation, str]:
    fit, c = fitted[best], best.candidate
    gains = base_fit.held_out - fit.held_out
    before, after = (selection.compute_position_errors(fits, f) for f in (base_fit, fit))
    others = [s for s in fitted if s is not best]
    excess = np.array([fitted[s].held_out - fit.held_out for s in others])
    is_equally_good = selection.find_equally_good(excess, fits.limits.undecided_p, fits.settings.seed)
    alternatives = {s.candidate.name: fitted[s] for s, is_good in zip(others, is_equally_good, strict=True) if is_good}
    u = compute_quantities(fits.windows)[c.quantity]
    points = np.linspace(c.low, c.high, selection.POINTS)
    splines = c.compute_splines(points)
    deviation = np.sqrt(np.maximum(np.einsum("ik,ij,jk->k", splines, fit.compute_covariance(), splines), 0.0))
    edges = np.concatenate([[-np.inf], 0.5 * (points[1:] + points[:-1]), [np.inf]])
    density = np.histogram(np.clip(u, c.low, c.high), edges)[0] / max(len(u), 1)
    runs = {name: (float(np.nanmean(before[in_run])), float(np.nanmean(after[in_run])))
            for k, name in enumerate(fits.windows.names) if (in_run := fits.windows.run == k).any()
            and np.isfinite(before[in_run]).any() and np.isfinite(after[in_run]).any()}
    with_relation = fits.make_space(c).at(fit.vector)
    without_relation = with_relation.select_effects(e for e in with_relation.effects if e.name != c.effect)
    relation = Relation(
        c, fit.coefficients, points, fit.coefficients @ splines, deviation, density,
        float(gains.sum()) / fits.loss.residual_count, p_value,
        (selection.average_finite(before), selection.average_finite(after)), runs, without_relation,
        {name: selection.compute_cosine(fits, fit, other) for name, other in alternatives.items()},
        simulate_formulas(fits, fit, base_fit), selection.compare_runs(fits, fit),
        selection.find_redundant_effects(fits, fit, base_fit, effect_names),
        simulate_drives(fits, fit, alternatives, best.design_effect, points, deviation,
                       find_sparse_ranges(points, density, c.parity)))
    return relation, f"it {selection.describe_gain(fits, gains, before - after)}"
