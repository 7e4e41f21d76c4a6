"""Bands while driving: half-widths for all models and both questions, from what is known when a prediction starts.

Both functions run once a tick, each time after a tenth of a second of other work, with the caches cold. What counts
then is how many different operations there are: they take a few hundred microseconds more than their arithmetic.

Coverage while driving is tested for being significantly below the stated level.
The test is sequential. A window with a band of level p that its path leaves counts against the band, one it
keeps for it, as a likelihood ratio of a band that covers ALTERNATIVE only:

    l = log((1 - q) / (1 - p))  if left,   log(q / p)  if kept,     q = ALTERNATIVE p
    S <- max(0, S + w l),     warning from S >= log(HORIZONS) on

Windows that overlap repeat each other, so each weighs only the share w of a horizon by which it starts later than the
one before. That is the mean of log l over all ways to pick windows a whole horizon apart, and no larger than the log of
the mean of their likelihood ratios (Jensen): an e-detector. While each window is kept with probability p or more
whatever the ones before it did, HORIZONS horizons pass on average before the first warning, or more.
Source: Shin, Ramdas and Rinaldo, E-detectors, New England Journal of Statistics in Data Science 2023 (CUSUM kind).
Checked by: test_bands_live.py; false warnings and delays measured in docs/manual/bands.md.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from ..alignment import DERIVATIVE, VELOCITY_X, YAW_RATE, MeasurementHistory
from ..evaluation import Score
from ..log_evaluation import MODES
from ..timeseries import NANOSECOND
from .adaptive import AdaptiveBand
from .calibration import LEVELS
from .conditions import activity_instants, magnitudes, steering_activity
from .file import Bands
from .samples import Question, to_predicted_frame
from .scale import features_of_one, floor_at, interpolation

Stated = dict[tuple[str, float], np.ndarray]
"""By mode and level: half-widths (points + 1, 3), float32 as in messages, along, across [m] and yaw [rad], 0 at the
start."""


def conditions_now(history: MeasurementHistory, time_ns: int) -> tuple[float, ...]:
    """Four numbers as `conditions.CONDITIONS` at an instant [ns], as `conditions_at` has them of the recorded drive;
    NaN where not known.
    """
    row = history.ins.at(time_ns)
    activity = float(steering_activity(history.steering.sample(activity_instants(time_ns))[:, 0]))
    velocity, rate, acceleration = (math.nan if row is None else row[k] for k in (VELOCITY_X, YAW_RATE, DERIVATIVE))
    return magnitudes(velocity, rate, acceleration, activity)


class LiveBands:
    """The same half-widths as `Bands.half_widths`, of all models at once: one pass a tick instead of twelve.

    models: those that predict; each must be in the bands (see `Bands.check`). Levels: those of LEVELS that the file
    states.

    stated: by model, the half-widths of the last call that found any; the arrays stay the same, their content changes.
    """

    def __init__(self, bands: Bands, models: Iterable[str]):
        self._seen = bands.seen
        questions = [(model, mode) for model in models for mode in MODES if (model, mode) in bands.bands]
        self._row: dict[Question, int] = {question: row for row, question in enumerate(questions)}
        chosen = [bands.bands[question] for question in questions]
        self.levels = tuple(level for level in LEVELS if all(level in band.factors for band in chosen))
        scale = chosen[0].scale
        self._between = interpolation(scale.knots, scale.time).T
        coefficients = np.concatenate([2.0 * band.scale.coefficients for band in chosen])
        self._coefficients = coefficients.reshape(-1, coefficients.shape[-1])
        self._floor = np.square(np.concatenate([floor_at(band.scale.floor, band.scale.time).T for band in chosen]))
        factors = np.array([[band.factors[level] for band in chosen] for level in self.levels], np.float32)
        self._factors = factors.repeat(3, axis=1)[:, :, None]
        widths = np.zeros((len(self.levels), len(chosen), 3, len(scale.time) + 1), np.float32)
        self._ahead = widths.reshape(len(self.levels), -1, widths.shape[-1])[..., 1:]
        self.stated: Mapping[str, Stated] = {model: {} for model, _ in questions}
        for (model, mode), of_question in zip(questions, widths.swapaxes(0, 1), strict=True):
            for level, one in zip(self.levels, of_question, strict=True):
                self.stated[model][mode, level] = one.T

    def why_not(self, condition: Sequence[float]) -> str:
        """Reason, in one line, why conditions (four numbers) have no band; empty if they have one."""
        return self._seen.why_not(condition)

    def __call__(self, condition: Sequence[float]) -> bool:
        """Update `stated` for conditions, four numbers. False, without an update, outside the calibration domain."""
        if not self._seen(np.array([condition]))[0]:
            return False
        # Limited at the knots: between them lies nothing beyond, and they are few.
        logs = (self._coefficients @ features_of_one(condition)).clip(-60.0, 60.0)
        scale = np.exp(logs.reshape(-1, len(self._between)) @ self._between)
        scale += self._floor
        np.sqrt(scale, out=scale)
        self._scale = scale
        np.multiply(self._factors, scale.astype(np.float32), out=self._ahead)
        return True

    def scale_of(self, question: Question) -> np.ndarray | None:
        """(points, 3) along, across [m] and yaw [rad] of the last update; None for a question without calibration."""
        row = self._row.get(question)
        return None if row is None else self._scale[3 * row:3 * row + 3].T


class AdaptiveBands:
    """Bands of all models and modes of a run, each corrected by its scores (`adaptive.AdaptiveBand`).

    time: (points,) ahead, without the start [s]. bands: the calibrated ones of forecast and hindsight; None: learnt
    from the scores alone, as those of plan and course always are, and stated after `adaptive.WARM_UP`.

    stated: as in `LiveBands`. counts: scored windows and, by level, those with the whole path inside, by question.
    """

    def __init__(self, time: np.ndarray, models: Sequence[str], modes: Sequence[str] = MODES,
                 bands: Bands | None = None):
        self._calibrated = None if bands is None else LiveBands(bands, models)
        known = {} if bands is None else bands.bands
        self._bands = {question: AdaptiveBand(time, known.get(question)) for question in product(models, modes)}
        self.stated: Mapping[str, Stated] = {
            model: {(mode, level): np.zeros((len(time) + 1, 3), np.float32) for mode in modes for level in LEVELS}
            for model in models}
        self.counts: dict[Question, tuple[int, dict[float, int]]] = {}
        self._since: dict[Question, int] = {}  # start of the first prediction with a band [ns]

    @property
    def learning(self) -> float:
        """Scored driving [s] that is missing until the first band of a forecast may be stated."""
        return min(band.learning for (_, mode), band in self._bands.items() if mode == "forecast")

    def issue(self, start_ns: int, condition: Sequence[float], modes: Iterable[str]) -> tuple[set[Question], str]:
        """Update `stated` for predictions of these modes that start now [ns], under conditions as `conditions_now`.

        Returns the questions with a band, and the reason, in one line, why calibrated ones have none.
        """
        reason = ""
        if self._calibrated and not self._calibrated(condition):
            reason = self._calibrated.why_not(condition)
        found: set[Question] = set()
        for model, stated in self.stated.items():
            for mode in modes:
                question = model, mode
                scale = self._calibrated.scale_of(question) if self._calibrated and not reason else None
                band = self._bands[question]
                if reason and band.is_calibrated:
                    continue
                widths = band.issue(start_ns, np.empty(0), scale)
                if not band.learning:
                    found.add(question)
                    self._since[question] = min(self._since.get(question, start_ns), start_ns)  # time may jump back
                    for level, one in widths.items():
                        stated[mode, level][1:] = one
        return found, reason

    def observe(self, score: Score) -> None:
        """The score of an earlier prediction; those of a question arrive in order of time."""
        errors = to_predicted_frame(np.stack([score.longitudinal, score.lateral, score.yaw], axis=-1))[1:]
        question = score.model, score.mode
        inside = self._bands[question].observe(score.start_ns, errors)
        if inside and score.start_ns >= self._since.get(question, math.inf):
            n, kept = self.counts.get(question, (0, {}))
            self.counts[question] = n + 1, {level: kept.get(level, 0) + one for level, one in inside.items()}


ALTERNATIVE = 5.0 / 9.0
"""Of the level: a 90 % band that covers 50 %. Above 73 % nothing adds up: runs differ that much by themselves."""
HORIZONS = 7200.0
"""Of 5 s: ten hours."""
END_SHARE = 0.5
"""A warning ends when S is back at this share of its limit."""


@dataclass
class Coverage:
    """Of one model and question. n: scored windows with a band. kept: by level, those with the whole path inside."""

    n: int = 0
    kept: dict[float, int] = field(default_factory=dict)
    warns: bool = False
    evidence: float = 0.0
    _last_ns: int | None = None

    def share(self, level: float) -> float:
        """Of the windows, NaN without any."""
        return self.kept[level] / self.n if level in self.kept else math.nan

    def add(self, start_ns: int, horizon: float, kept: Mapping[float, bool]) -> None:
        """One window. kept: by level; horizon [s]. The test is of the highest level."""
        self.n += 1
        for level, inside in kept.items():
            self.kept[level] = self.kept.get(level, 0) + inside
        level = max(kept)
        before, self._last_ns = self._last_ns, start_ns
        later = 0.0 if before is None else (start_ns - before) * NANOSECOND / horizon
        # Time that jumped back, in a replay, weighs nothing.
        weight = min(max(later, 0.0), 1.0)
        limit, q = math.log(HORIZONS), ALTERNATIVE * level
        ratio = math.log(q / level) if kept[level] else math.log((1.0 - q) / (1.0 - level))
        self.evidence = min(max(self.evidence + weight * ratio, 0.0), limit)
        self.warns = self.evidence >= (END_SHARE * limit if self.warns else limit)


class Coverages:
    """Bands that were published with predictions, until the score of their horizon arrives.

    At most MAXIMUM_WAITING are kept; those of predictions that never arrived are dropped.
    """

    MAXIMUM_WAITING = 10_000

    def __init__(self) -> None:
        self.by_question: dict[Question, Coverage] = {}
        self._waiting: dict[tuple[str, str, int], dict[float, np.ndarray]] = {}

    def expect(self, model: str, start_ns: int, stated: Stated) -> None:
        """Half-widths published with a prediction."""
        for (mode, level), widths in stated.items():
            self._waiting.setdefault((model, mode, start_ns), {})[level] = widths
        while len(self._waiting) > self.MAXIMUM_WAITING:
            del self._waiting[next(iter(self._waiting))]

    def add(self, score: Score) -> None:
        """A score of a prediction; incomplete ones are ignored."""
        stated = self._waiting.pop((score.model, score.mode, score.start_ns), None)
        if stated is None or not score.complete:
            return
        errors = np.abs(to_predicted_frame(np.stack([score.longitudinal, score.lateral, score.yaw], axis=-1)))
        # The start is the measurement itself: nothing is stated of it.
        kept = {level: bool((errors[1:] <= widths[1:]).all()) for level, widths in stated.items()}
        one = self.by_question.setdefault((score.model, score.mode), Coverage())
        one.add(score.start_ns, float(score.horizon[-1]), kept)

    def warning(self) -> str:
        """Bands that cover significantly less than stated, in one line; empty without one."""
        found = [f"{mode} of {model} (the {max(one.kept):.0%} band {one.share(max(one.kept)):.0%} so far)"
                 for (model, mode), one in self.by_question.items() if one.warns]
        if not found:
            return ""
        return f"cover far less than they state: {', '.join(found)}; has the car, the road or the driving changed?"
