"""Folds the reported effects of a discovery into the user's vehicle file, as corrections of its entries."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import yaml
from scipy import stats
from st_core.augmented import AugmentedModel, fold_effects, set_effects_to_null
from st_core.batch import LogBatch
from st_core.discovery import Discovery
from st_core.discovery.result import Run
from st_core.effects import Effect, get_effect
from st_core.errors import ConfigurationError, StCoreError
from st_core.handling import find_implausible_values
from st_core.integrate import required_slip_speed
from st_core.log import DriveLog, LogSignals
from st_core.log_evaluation import regular_starts, usable_starts
from st_core.models import TYRE_MODELS, get_model
from st_core.prediction import PredictionSettings
from st_core.regression import Z95
from st_core.vehicle import FILE_QUANTITIES, Provenance, VehicleParameters, value_of
from st_core.yaml_text import dump_flow, format_number
from st_recordings.car import STABILITY_SPEEDS

from ..terminal import format_count
from .drives import Request

HORIZON, STEP = 5.0, 0.05  # s, of the predictions that are compared
START_INTERVAL = 5.0  # s, between prediction starts
MIN_SPEED = 1.5  # m/s, at the start of a prediction
POSE_TOLERANCE = 1e-3  # m, rad; predictions that differ by less at the end of the horizon count as equal
MAX_POSITION_DIFFERENCE = 0.02  # m, mean at the end of the horizon; above it, effective corrections are dropped
SIGNIFICANCE_LEVEL = 0.05  # of a one-sided paired t-test over the predictions of a drive, which do not overlap
SIGNIFICANT_DIGITS = 6  # of a written value
SCALE_SOURCE = "kept at its value while other entries were corrected"  # of a lambda_ky that the file did not contain
SLIP_SPEED_KEY = "minimum_slip_speed"


@dataclass(frozen=True)
class VehicleUpdate:
    """A vehicle file with effects folded into its entries, and the model for it."""

    vehicle: VehicleParameters  # updated car, or the original one if vehicle.yaml is not written
    text: str  # content of vehicle.yaml; "" if it is not written
    model: AugmentedModel  # for `vehicle`: `Discovery.model` without the values that are folded into the file
    folded: tuple[str, ...]  # effects in vehicle.yaml
    # (before, after, low, high) by key [SI]; low, high: 95 % interval.
    changes: Mapping[str, tuple[float, float, float, float]]
    # Changes (before, after), by key, of each effect that is not folded because folding would change predictions.
    not_folded: Mapping[str, Mapping[str, tuple[float, float]]]
    # Mean position error of the base model after 5 s [m] with the (original, updated) file; held out if there are
    # several drives.
    error: tuple[float, float] = (math.nan, math.nan)
    worse_drives: tuple[str, ...] = ()  # drives with a significantly larger error with the updated file
    implausible_values: tuple[str, ...] = ()
    required_slip_speed: float = 0.0  # minimum_slip_speed that the model needs [m/s]; 0 if that of the file suffices

    @property
    def is_not_worse(self) -> bool:
        """Whether the updated file is not worse: mean error unknown or not larger, and no drive significantly worse."""
        return not (self.error[1] > self.error[0] or self.worse_drives)


def update_vehicle(discovery: Discovery, request: Request) -> VehicleUpdate | None:
    """The update of `fold_named_effects`, or the original file if it predicts better; None without a model."""
    update = fold_named_effects(discovery, request)
    if update is None or not update.text or update.is_not_worse:
        return update
    model = discovery.model or update.model
    return _keep_original_file(request.vehicle, model, update.not_folded, update.error, update.worse_drives)


def fold_named_effects(discovery: Discovery, request: Request) -> VehicleUpdate | None:
    """Fold the reported effects into the vehicle file, even if this does not improve predictions; None without a model.

    Effects that an entry can express are folded in the order in which they act. An effect is skipped if its values
    exceed the limits of the file or if predictions would change, because the entry has no influence (steering ratio,
    if the road-wheel angle was recorded) or the effect does not commute with earlier ones (steering play). Minor
    effects and effective corrections are not folded.
    """
    if discovery.model is None or discovery.named is None:
        return None
    drives = [d.log for d in request.drives if d.log is not None]
    expected = _compute_errors(discovery.named, request.vehicle, drives)
    folded: tuple[type[Effect], ...] = ()
    not_folded, named = {}, {e.name for e in discovery.effects}
    for effect in (e for e in discovery.named.effects if e.fold and e.name in named):
        candidate = (*folded, effect)
        try:
            car = fold_effects(request.vehicle, candidate, discovery.named.values)
            errors = _compute_errors(set_effects_to_null(discovery.named, candidate), car, drives)
        except StCoreError:  # values outside the limits of a vehicle file, or failed predictions
            continue
        if all(a.shape == b.shape and np.allclose(a, b, rtol=0.0, atol=POSE_TOLERANCE, equal_nan=True)
               for a, b in zip(errors, expected, strict=True)):
            folded = candidate
        else:
            not_folded[effect.name] = find_changed_entries(request.vehicle, effect, discovery.named.values[effect.name])
    if not folded:
        return _keep_original_file(request.vehicle, discovery.model, not_folded)
    car = fold_effects(request.vehicle, folded, discovery.named.values)
    model = _adapt_model(discovery, car, folded, drives, request.vehicle)
    required = _find_required_slip_speed(car, model)
    if required > car.minimum_slip_speed:  # the written file must keep the model stable
        car = replace(car, minimum_slip_speed=required)
        model = _adapt_model(discovery, car, folded, drives, request.vehicle)
    error, worse = _compute_held_out_error(discovery, request.vehicle, folded, drives)
    changes = {key: (*change, *_compute_interval(discovery, request.vehicle, folded, key))
               for key, change in _find_changes(request.vehicle, car).items()}
    if SLIP_SPEED_KEY in changes:  # computed for stability, not estimated
        changes[SLIP_SPEED_KEY] = (*changes[SLIP_SPEED_KEY][:2], car.minimum_slip_speed, car.minimum_slip_speed)
    runs = [run for run in discovery.runs if run.role == "suspect"]
    car = document_changes(request, car, changes, runs, ", ".join(e.name for e in folded))
    reported = {key: change for key, change in changes.items() if not key.endswith("lambda_ky")}
    text = edit_vehicle_text(request.vehicle_text, reported, car, SIGNIFICANT_DIGITS)
    vehicle = VehicleParameters.from_yaml(text, "vehicle.yaml")
    return VehicleUpdate(vehicle, text, model, tuple(effect.name for effect in folded), reported, not_folded, error,
                         worse, find_implausible_values(vehicle, request.vehicle))


def _keep_original_file(vehicle: VehicleParameters, model: AugmentedModel, not_folded: Mapping[str, Mapping[str, Any]],
                        *comparison: Any) -> VehicleUpdate:
    """Update that keeps the original file. comparison: `error` and `worse_drives`, if an updated file was tried."""
    required = _find_required_slip_speed(vehicle, model)
    return replace(VehicleUpdate(vehicle, "", model, (), {}, not_folded, *comparison),
                   required_slip_speed=required if required > vehicle.minimum_slip_speed else 0.0)


def _find_required_slip_speed(car: VehicleParameters, model: AugmentedModel) -> float:
    """Lowest minimum_slip_speed [m/s] at which the base models and this model are stable. Models that no value
    stabilises are ignored; if none is left, the result is the value of the car."""
    step = PredictionSettings().step
    required = [required_slip_speed((m,), car, STABILITY_SPEEDS, step) for m in (*map(get_model, TYRE_MODELS), model)]
    return max((speed for speed in required if speed is not None), default=car.minimum_slip_speed)


def _compute_held_out_error(discovery: Discovery, vehicle: VehicleParameters, folded: Sequence[type[Effect]],
                            drives: Sequence[DriveLog]) -> tuple[tuple[float, float], tuple[str, ...]]:
    """`error` and `worse_drives` of `VehicleUpdate`. Each drive is predicted with values fitted to the other drives, if
    any; if these are outside the limits of the file, the result is (0, inf) and this drive."""
    assert discovery.named is not None  # because there are reported effects
    errors, worse = [], []
    for drive in drives:
        values = {**discovery.named.values, **discovery.leave_one_out.get(drive.name, {})}
        try:
            car = fold_effects(vehicle, folded, values)
        except StCoreError:  # the values without this drive are outside the limits of a vehicle file
            return (0.0, math.inf), (drive.name,)
        pair = np.stack([np.hypot(*_compute_errors(discovery.base, v, [drive])[0][:, :2].T) for v in (vehicle, car)])
        before, after = pair = pair[:, np.isfinite(pair).all(axis=0)]
        errors.append(pair)
        if len(before) > 2 and stats.ttest_rel(after, before, alternative="greater").pvalue < SIGNIFICANCE_LEVEL:
            worse.append(drive.name)
    all_errors = np.concatenate(errors, axis=1)
    before_mean, after_mean = all_errors.mean(axis=1).tolist() if all_errors.size else (math.nan, math.nan)
    return (before_mean, after_mean), tuple(worse)


def _adapt_model(discovery: Discovery, car: VehicleParameters, folded: Sequence[type[Effect]],
                 drives: Sequence[DriveLog], vehicle: VehicleParameters) -> AugmentedModel:
    """Model for the updated vehicle. Effective corrections are dropped if they make its predictions differ from those
    of the complete model by more than MAX_POSITION_DIFFERENCE."""
    assert discovery.model is not None and discovery.named is not None
    values: dict[str, dict[str, float]] = {}
    for effect in folded:
        values[effect.name] = {}
        for p in (p for p in effect.parameters if p.fit):
            named, complete = discovery.named.values[effect.name][p.name], discovery.model.values[effect.name][p.name]
            remaining = complete / named if p.null == 1.0 else complete - named + p.null
            values[effect.name][p.name] = float(np.clip(remaining, *p.bounds))
    model = discovery.model.with_values(values)
    difference = np.concatenate([a - b for a, b in zip(
        _compute_errors(model, car, drives), _compute_errors(discovery.model, vehicle, drives), strict=True)])
    is_similar = np.nanmean(np.hypot(difference[:, 0], difference[:, 1])) < MAX_POSITION_DIFFERENCE
    return model if is_similar else set_effects_to_null(discovery.named, folded)


def _find_changes(vehicle: VehicleParameters, other: VehicleParameters) -> dict[str, tuple[float, float]]:
    """(before, after) of each key that differs between two vehicles."""
    pairs = {key: (value_of(vehicle, key), value_of(other, key)) for key in FILE_QUANTITIES}
    return {key: pair for key, pair in pairs.items() if not math.isclose(*pair, rel_tol=1e-9, abs_tol=1e-12)}


def find_changed_entries(vehicle: VehicleParameters, effect: type[Effect], values: Mapping[str, float]
                         ) -> dict[str, tuple[float, float]]:
    """(before, after) of each entry of the vehicle file that an effect changes; empty if it cannot be folded."""
    if not effect.fold:
        return {}
    try:
        pairs = _find_changes(vehicle, fold_effects(vehicle, (effect,), {effect.name: values}))
    except StCoreError:  # outside the limits of a vehicle file
        return {}
    return {key: pair for key, pair in pairs.items() if not key.endswith("lambda_ky")}


def _compute_errors(model: AugmentedModel, vehicle: VehicleParameters, drives: Sequence[DriveLog]) -> list[np.ndarray]:
    """Errors (starts, 3) [m, m, rad] of each drive at the end of the horizon. Steering-wheel angles are converted to
    road-wheel angles with `vehicle`."""
    errors = []
    for drive in drives:
        log = drive if drive.steering_wheel_angle is None else drive.with_steering(vehicle)
        signals = LogSignals(log, maximum_gap=0.1, filter_cutoff=5.0)
        starts, _ = usable_starts(signals, vehicle, regular_starts(log, START_INTERVAL), MIN_SPEED)
        batch = LogBatch(signals, starts, HORIZON, STEP, points=(HORIZON,), substeps="auto")
        errors.append(batch.errors(model, vehicle)[:, -1, :])
    return errors


def _compute_interval(discovery: Discovery, vehicle: VehicleParameters, folded: Sequence[type[Effect]],
                      key: str) -> tuple[float, float]:
    """95 % interval of an entry of the file, from those of the folded effects, which are assumed independent."""
    assert discovery.named is not None  # because there are reported effects
    values = {name: dict(entry) for name, entry in discovery.named.values.items()}
    centre = value_of(fold_effects(vehicle, folded, values), key)
    below = above = 0.0  # sums of squares
    names = {effect.name for effect in folded}
    for effect in (e for e in discovery.effects if e.name in names):
        fitted, bounds = values[effect.name], {p.name: p.bounds for p in get_effect(effect.name).parameters}
        for name, p in effect.parameters.items():
            ends = [centre]
            for end in p.interval:
                clipped = float(np.clip(fitted[name] + end - p.value, *bounds[name]))
                changed = {**values, effect.name: {**fitted, name: clipped}}
                ends.append(value_of(fold_effects(vehicle, folded, changed), key))
            below += (centre - min(ends)) ** 2
            above += (max(ends) - centre) ** 2
    return centre - math.sqrt(below), centre + math.sqrt(above)


def document_changes(request: Request, car: VehicleParameters, changes: Mapping[str, tuple[float, float, float, float]],
                     runs: Sequence[Run], effects: str) -> VehicleParameters:
    """The car with source and provenance of each changed entry. runs, effects: those of the discovery."""
    date, seconds = f"{datetime.now(UTC):%Y-%m-%d}", sum(run.seconds for run in runs)
    origin = f"st discover, {date}, {format_count(len(runs), 'run')}, {seconds:.0f} s: {effects}"
    provenance = Provenance(None, "st discover", ", ".join(run.name for run in runs), date)
    sources, entries = {**request.vehicle.sources}, {**request.vehicle.provenance}
    for key, (before, _, low, high) in changes.items():
        previous, *ends = (format_number(float(f"{x:.{SIGNIFICANT_DIGITS}g}")) for x in (before, low, high))
        source = (f"stable with steps of {1e3 * PredictionSettings().step:g} ms" if key == SLIP_SPEED_KEY else
                  f"{origin}, 95 % interval {' to '.join(ends)}")
        sources[key] = f"{source}; previously {previous} {FILE_QUANTITIES[key].si_unit}".removesuffix(" 1")
        deviation = float(f"{(high - low) / (2.0 * Z95):.3g}")
        entries[key] = replace(provenance, uncertainty=deviation if deviation > 0.0 else None)
    return replace(car, sources=sources, provenance=entries)


def edit_vehicle_text(text: str, keys: Iterable[str], car: VehicleParameters, digits: int | None = None) -> str:
    """A vehicle file with the entries of these keys replaced by those of `car`; comments and other entries are kept.

    digits: significant digits of the values; None: all. A lambda_ky that the file would derive differently is added. If
    the edited file still does not load as `car`, the result is a new file.
    """
    keys, tolerance = list(keys), 1e-12 if digits is None else 10.0 ** (1 - digits)  # twice the largest rounding error
    for _ in range(2):
        try:
            edited = _edit_entries(text, keys, car, digits)
            read = VehicleParameters.from_yaml(edited)
        except (ConfigurationError, yaml.YAMLError):
            break
        wrong_keys = [key for key in FILE_QUANTITIES if not math.isclose(
            value_of(read, key), value_of(car, key), rel_tol=tolerance, abs_tol=1e-4 * tolerance)]
        if not wrong_keys:
            return edited
        keys += [key for key in wrong_keys if key.endswith("lambda_ky")]
    return car.to_yaml()


def _format_entry(car: VehicleParameters, key: str, digits: int | None, unit: str, factor: float) -> str:
    """YAML entry of a key of `car`. unit, factor: unit of the entry, and its factor to SI."""
    def convert(value: float) -> float:
        return value / factor if digits is None else float(f"{value / factor:.{digits}g}")

    existing = car.provenance.get(key, Provenance())
    provenance = replace(existing, uncertainty=None if existing.uncertainty is None else convert(existing.uncertainty))
    source = car.sources[key] if key in car.provenance else SCALE_SOURCE
    return dump_flow({"value": convert(value_of(car, key)), "unit": unit, "source": source,
                      **provenance.to_document()})


def _edit_entries(text: str, keys: Iterable[str], car: VehicleParameters, digits: int | None) -> str:
    """A vehicle file with these entries replaced or inserted; keys such as "mass" or "tyre_front.p_dy1"."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    edits = []  # (start, end, replacement) in the text
    for key in keys:
        tyre, _, name = key.rpartition(".")
        section, units = _find_entry(root, tyre) if tyre else root, FILE_QUANTITIES[key].units
        assert isinstance(section, yaml.MappingNode)  # already parsed as a vehicle file
        node = _find_entry(section, name)
        unit = next(iter(units)) if node is None else next(v.value for k, v in node.value if k.value == "unit")
        entry = _format_entry(car, key, digits, unit, units[unit])
        if node is None:
            first = section.value[0][0].start_mark
            gap = ", " if section.flow_style else "\n" + " " * first.column
            edits.append((first.index, first.index, f"{name}: {entry}{gap}"))
        else:
            # A YAML block ends at the next key; the edit ends at its last value, to preserve the comments in between.
            last = node if node.flow_style else node.value[-1][1]
            edits.append((node.start_mark.index, last.end_mark.index, entry))
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text


def _find_entry(section: yaml.Node, key: str) -> yaml.MappingNode | None:
    return next((value for name, value in section.value if name.value == key), None)
