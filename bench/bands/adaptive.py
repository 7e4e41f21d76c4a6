"""Coverage and interval score of adaptive bands over drives, starting from bands calibrated on other drives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from st_core.bands import AdaptiveBand, Band, CalibrationDomain, conditions_at
from st_core.bands.calibration import to_predicted_frame
from st_core.log import DriveLog
from st_core.log_evaluation import EvaluationSettings, evaluate_blocks, regular_starts, usable_starts
from st_core.models import get_model
from st_core.vehicle import VehicleParameters

INTERVAL = 0.1  # s between starts, as in the live predictor
SETTLING_TIME = 120.0  # s after the first start; the coverage after this time is also computed separately
MIN_SETTLED_STARTS = 300  # minimum number of later starts for a separate coverage of a drive
PAUSE_NS = 6_000_000_000  # between two drives that are joined
LEVELS = (0.9, 0.5)

ModelMode = tuple[str, str]


@dataclass(frozen=True, eq=False)
class Drive:
    """All starts of a drive: times (n,) [ns], conditions (n, 4), and errors (n, points, 3) by model and mode."""

    name: str
    starts_ns: np.ndarray
    conditions: np.ndarray
    errors: Mapping[ModelMode, np.ndarray]


def evaluate_drive(log: DriveLog, vehicle: VehicleParameters, model: str, settings: EvaluationSettings) -> Drive:
    """Predicts from every start of a log, and collects conditions and errors."""
    signals = settings.signals(log)
    starts, _ = usable_starts(signals, vehicle, regular_starts(log, INTERVAL), settings.prediction.minimum_speed)
    times, errors = [], {}
    for rows, block in evaluate_blocks([get_model(model)], vehicle, signals, starts, settings):
        times.append(starts[rows])
        for key, values in block.errors.items():
            errors.setdefault(key, []).append(to_predicted_frame(values[:, 1:]).astype(np.float32))
    starts = np.concatenate(times)
    return Drive(log.name, starts, conditions_at(signals, starts),
                 {key: np.concatenate(parts) for key, parts in errors.items()})


def join_drives(name: str, drives: Sequence[Drive]) -> Drive:
    """Joins drives into one, with a pause between them."""
    begin, times = 0, []
    for drive in drives:
        times.append(drive.starts_ns - drive.starts_ns[0] + begin)
        begin = int(times[-1][-1]) + PAUSE_NS
    return Drive(name, np.concatenate(times), np.concatenate([drive.conditions for drive in drives]),
                 {key: np.concatenate([drive.errors[key] for drive in drives]) for key in drives[0].errors})


class Score:
    """Coverage and interval score of adaptive bands of one model and mode; each drive starts with a new band."""

    def __init__(self, time: np.ndarray, model_mode: ModelMode):
        self._time, self._model_mode = time, model_mode
        self._parts: dict[float, list[tuple[np.ndarray, ...]]] = {level: [] for level in LEVELS}
        self._settled: dict[float, list[float]] = {level: [] for level in LEVELS}

    def add(self, drive: Drive, band: Band | None = None, domain: CalibrationDomain | None = None) -> None:
        """Scores a band that adapts during a drive. band: calibrated band at the start, or None; domain: its domain."""
        rows = np.isfinite(drive.conditions).all(axis=1)
        if domain is not None:
            rows[rows] = domain.contains(drive.conditions[rows])
        adaptive = AdaptiveBand(self._time, band)
        errors, initial = drive.errors[self._model_mode][rows].astype(float), adaptive.factors
        factors, scales = adaptive.replay(drive.starts_ns[rows], drive.conditions[rows], errors)
        scored = np.isfinite(errors).all(axis=(1, 2))
        settled = (drive.starts_ns[rows] - drive.starts_ns[0]) * 1e-9 >= SETTLING_TIME
        if band is None:  # without a calibrated band, none is issued within the settling time
            scored &= settled
        size, scale = np.abs(errors[scored]), scales[scored]
        highest = (size / scale).max(axis=(1, 2), initial=0.0)
        for level in LEVELS:
            factor = factors[level][scored]
            self._parts[level].append((factor, np.full(len(factor), initial[level]), highest,
                                       size[:, 4::5, :2], scale[:, 4::5, :2]))
            late = (highest <= factor)[settled[scored]]
            if len(late) >= MIN_SETTLED_STARTS:
                self._settled[level].append(float(late.mean()))

    def cells(self, calibrated: bool = True) -> dict[str, str]:
        """Cells of a table for each level: coverage of fixed and adaptive bands, coverage of the worst drive after the
        settling time, and interval score relative to fixed bands.

        For the score, one factor scales the fixed bands to the coverage of the adaptive bands.
        """
        cells = {}
        for level in LEVELS:
            factor, initial, highest, size, scale = map(np.concatenate, zip(*self._parts[level], strict=True))
            coverage, name = float((highest <= factor).mean()), f"{100.0 * level:.0f} %"
            fixed_factor = initial * float(np.quantile(highest / initial, coverage))
            ratio = _interval_score(factor, size, scale, level) / _interval_score(fixed_factor, size, scale, level)
            fixed = f"{100.0 * (highest <= initial).mean():.1f}" if calibrated else "-"
            cells[f"{name}: fixed, adaptive"] = f"{fixed}, {100.0 * coverage:.1f}"
            cells[f"{name}: worst drive"] = f"{100.0 * min(self._settled[level]):.1f}" if self._settled[level] else "-"
            cells[f"{name}: score"] = f"{ratio:.2f}" if calibrated else "-"
        return cells


def _interval_score(factor: np.ndarray, size: np.ndarray, scale: np.ndarray, level: float) -> float:
    """Mean of 2 h + 2 / (1 - level) max(|e| - h, 0), along and across [m]; Gneiting and Raftery 2007."""
    half_width = factor[:, None, None] * scale
    return float((2.0 * half_width + 2.0 / (1.0 - level) * np.maximum(size - half_width, 0.0)).mean())
