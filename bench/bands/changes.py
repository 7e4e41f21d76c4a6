"""Delay of the evaluator's coverage warning after a change of the virtual car, and number of false warnings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from st_core.bands import Band, CalibrationDomain, ErrorSamples, calibrate, compute_error_samples, conditions_at
from st_core.bands.live import CoverageMonitor
from st_core.evaluation import make_score
from st_core.log import DriveLog
from st_core.log_evaluation import evaluate_blocks, regular_starts, usable_starts
from st_core.models import get_model
from st_core.vehicle import VehicleParameters

from ..plants import programmes
from ..plants.record import LEAF, RunPlan, healthy_car, record_run, vehicle_of
from .methods import SETTINGS, TIME

MODELS, MODES = ("linear", "nonlinear"), ("hindsight", "forecast")
SEED, CALIBRATION_DRIVES, HEALTHY_DRIVES, CHANGED_DRIVES = 22, 24, 2, 5
# Number of manoeuvres, of about 8 s each: an hour, four minutes, one minute.
HEALTHY_PARTS, CHANGED_PARTS, CALIBRATION_PARTS = 450, 30, 9
STYLES = {"ordinary": ("ORDINARY", "CIRCLE", "ORDINARY", "SWEEP", "ORDINARY", "STEPS", "WEAVE", "SLALOM",
                       "SLOW_CIRCLE"),
          "brisk": ("STEPS", "SLALOM", "SWEEP", "BRAKING", "CIRCLE")}
"""Style -> manoeuvres of plants.programmes. Lateral acceleration: mostly below 2.5 m/s^2, and up to 5 m/s^2."""
CHANGES = {
    "steering offset 0.005 rad": {"steering_offset": 0.005}, "steering offset 0.01 rad": {"steering_offset": 0.01},
    "steering offset 0.02 rad": {"steering_offset": 0.02}, "friction 0.7": {"friction_factor": 0.7},
    "friction 0.5": {"friction_factor": 0.5}, "friction 0.4": {"friction_factor": 0.4},
    "friction 0.3": {"friction_factor": 0.3},
    "friction 0.5 and stiffness 0.6": {"friction_factor": 0.5, "front_stiffness_factor": 0.6,
                                       "rear_stiffness_factor": 0.6},
}

DETECTED, DELAY = "warnings within a minute", "median delay, or coverage without a change"
Bands = Mapping[tuple[str, str], Band]
Row = dict[str, str]


@dataclass
class DriveWarnings:
    """Duration of a drive [s]; by model and mode, times at which a warning began [s], and coverage of the 90 % band."""

    seconds: float
    warning_times: dict[tuple[str, str], list[float]] = field(default_factory=dict)
    coverage: dict[tuple[str, str], float] = field(default_factory=dict)


def count_warnings(log: DriveLog, vehicle: VehicleParameters, bands: Bands, domain: CalibrationDomain) -> DriveWarnings:
    """Warnings of the evaluator during a drive; each score is available one horizon after its start."""
    signals, monitor = SETTINGS.signals(log), CoverageMonitor()
    models = [get_model(model) for model in {model: None for model, _ in bands}]
    starts, _ = usable_starts(signals, vehicle, regular_starts(log, SETTINGS.interval),
                              SETTINGS.prediction.minimum_speed)
    warnings, horizon = DriveWarnings(log.overlap, {key: [] for key in bands}), SETTINGS.prediction.horizon
    warned = dict.fromkeys(bands, False)
    for rows, block in evaluate_blocks(models, vehicle, signals, starts, SETTINGS):
        conditions = conditions_at(signals, starts[rows])
        in_domain = domain.contains(conditions)
        widths = {key: {level: np.pad(factor * band.scale(conditions[in_domain]), ((0, 0), (1, 0), (0, 0)))
                        for level, factor in band.factors.items() if level in (0.5, 0.9)}
                  for key, band in bands.items()}
        width_row = np.cumsum(in_domain) - 1
        for row in np.flatnonzero(in_domain):
            start = int(starts[rows][row])
            for (model, mode), by_level in widths.items():
                monitor.add_bands(model, start, {(mode, level): half_widths[width_row[row]]
                                                 for level, half_widths in by_level.items()})
                errors = list(block.errors[model, mode][row].T)
                monitor.add_score(make_score(model, mode, start, SETTINGS.prediction.step, errors))
                coverage = monitor.by_pair.get((model, mode))
                if coverage and coverage.has_warning and not warned[model, mode]:
                    warnings.warning_times[model, mode].append((start - log.start_ns) * 1e-9 + horizon)
                warned[model, mode] = bool(coverage and coverage.has_warning)
    warnings.coverage = {key: coverage.coverage_at(0.9) for key, coverage in monitor.by_pair.items()}
    return warnings


def calibrate_all(runs: Sequence[ErrorSamples]) -> tuple[Bands, CalibrationDomain]:
    return ({(model, mode): calibrate(runs, (model, mode), TIME, (0.5, 0.9)) for model in MODELS for mode in MODES},
            CalibrationDomain.from_runs([r.conditions for r in runs]))


def measure_changes() -> list[Row]:
    """Rows for each style of driving: first drives without a change, then drives with each change."""
    return [row for number, style in enumerate(STYLES) for row in _measure_style(number, style)]


def _measure_style(number: int, style: str) -> list[Row]:
    healthy = healthy_car(LEAF, (SEED,)).settings
    file = vehicle_of(LEAF, healthy)
    manoeuvres = [getattr(programmes, name) for name in STYLES[style]]

    def drive(group: int, index: int, count: int, after: Mapping[str, float] | None = None) -> DriveLog:
        """Log of `count` manoeuvres. after: settings of the car from the middle of the drive on."""
        parts = tuple(manoeuvres[k % len(manoeuvres)] for k in range(count))
        changed: dict[str, Any] = {} if after is None else {"before": healthy, "change_at": 0.5}
        plan = RunPlan(f"{group} {index}", (SEED, number, group, index), after or healthy, parts, **changed)
        return record_run(LEAF, file, plan)

    models = [get_model(model) for model in MODELS]
    runs = [compute_error_samples(models, file, SETTINGS.signals(log), SETTINGS)
            for log in (drive(0, k, CALIBRATION_PARTS) for k in range(CALIBRATION_DRIVES))]
    bands, domain = calibrate_all(runs)
    rows = _healthy_rows(style, [count_warnings(drive(1, k, HEALTHY_PARTS), file, bands, domain)
                                 for k in range(HEALTHY_DRIVES)])
    for group, (name, change) in enumerate(CHANGES.items(), 2):
        changed = {key: healthy[key] + v if key == "steering_offset" else healthy[key] * v for key, v in change.items()}
        drives = [drive(group, k, CHANGED_PARTS, healthy | changed) for k in range(CHANGED_DRIVES)]
        rows += _changed_rows(style, name, [count_warnings(log, file, bands, domain) for log in drives])
        print(*rows[-len(bands):], sep="\n", flush=True)
    return rows


def _healthy_rows(style: str, drives: Sequence[DriveWarnings]) -> list[Row]:
    hours = sum(drive.seconds for drive in drives) / 3600.0
    return [_row(style, f"none, {hours:.1f} h", key,
                 f"{sum(len(drive.warning_times[key]) for drive in drives)} false warnings",
                 f"coverage at 90 %: {np.mean([drive.coverage[key] for drive in drives]):.1%}")
            for key in drives[0].warning_times]


def _changed_rows(style: str, name: str, drives: Sequence[DriveWarnings]) -> list[Row]:
    """Rows with the delay from the change, in the middle of each drive, to the first warning after it."""
    rows = []
    for key in drives[0].warning_times:
        delays = [min((t - 0.5 * drive.seconds for t in drive.warning_times[key] if t > 0.5 * drive.seconds),
                      default=np.inf) for drive in drives]
        early = sum(any(t <= 0.5 * drive.seconds for t in drive.warning_times[key]) for drive in drives)
        median, detected = float(np.median(delays)), sum(delay <= 60.0 for delay in delays)
        before = f", {early} before the change" if early else ""
        rows.append(_row(style, name, key, f"{detected} of {len(drives)}{before}",
                         f"{median:.0f} s" if np.isfinite(median) else "none"))
    return rows


def _row(style: str, change: str, key: tuple[str, str], detected: str, delay: str) -> Row:
    return {"style": style, "change": change, "model": key[0], "mode": key[1], DETECTED: detected, DELAY: delay}
