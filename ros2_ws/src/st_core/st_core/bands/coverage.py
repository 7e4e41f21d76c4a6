"""Coverage of bands while driving, and a test for coverage significantly below the stated level.

The second is a sequential test. A window with a band of level p that its path leaves counts against the band, one it
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
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..evaluation import Score
from ..filtering import NANOSECOND
from .live import Stated
from .samples import Question, to_predicted_frame

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
