"""Inputs and result of a clock alignment: shared signals, and the alignment with its verdict."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

AMBIGUOUS_PEAK_RATIO = 0.9  # largest second peak of an unambiguous correlation, divided by the first
MAX_SPAN = 48 * 3600.0  # s, longest duration of a recording; if it is longer, its clock was set while recording


class Verdict(StrEnum):
    """Verdict on an alignment. doubtful: the user should check its figure. refused: no usable alignment was found. not
    needed: all signals were recorded on one clock."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    REFUSED = "refused"
    NOT_NEEDED = "not needed"


@dataclass(frozen=True)
class SharedSignal:
    """One quantity in both recordings, each on its own clock. Times are int64 [ns], strictly increasing. Values are NaN
    where unusable (standstill, sensor not ready); those of the recordings agree up to a gain > 0 and a bias."""

    name: str
    reference_time_ns: np.ndarray
    reference: np.ndarray
    other_time_ns: np.ndarray
    other: np.ndarray
    latency: float = 0.0  # delay from the measurement of a value to its stamp in the other recording [s]
    latency_uncertainty: float = 0.0  # standard deviation [s]
    min_deviation: float = 0.0  # standard deviation at or below which the signal counts as constant
    is_angle: bool = False  # angle [rad], wrapped or not; its rate is compared, because the zeros may differ


class Peak(NamedTuple):
    """Peak of the correlation between two recordings."""

    offset: float  # reference time minus other time [s]
    correlation: float


@dataclass(frozen=True)
class SignalAgreement:
    """Agreement of one signal with the alignment by all signals."""

    name: str
    difference: float  # offset fitted to this signal alone minus the common offset [s]
    deviation: float  # standard deviation of its offset [s]
    residual: float  # RMS with the common offset, divided by the standard deviation of the signal
    correlation: float  # with the common offset


@dataclass(frozen=True)
class Alignment:
    """Conversion of the other clock to the reference clock; the defaults are for recordings on one clock."""

    at_ns: int = 0  # instant on the other clock at which `offset_ns` applies
    offset_ns: int = 0
    drift_ppm: float = 0.0  # rate of the reference clock relative to the other, minus 1
    offset_deviation: float = 0.0  # standard deviation, latency included [s]
    drift_deviation: float = 0.0  # standard deviation [ppm]
    method: str = "none"  # "time frame", "shared signals", "by hand" or "none"
    verdict: Verdict = Verdict.NOT_NEEDED
    reasons: tuple[str, ...] = ()
    signals: tuple[SignalAgreement, ...] = ()
    peak: Peak | None = None  # of the coarse search; None if it was not run
    second_peak: Peak | None = None
    overlap: float = 0.0  # duration of the overlap [s]

    def to_reference_ns(self, other_ns: np.ndarray | int) -> np.ndarray:
        """Time on the reference clock [ns] of a time on the other clock [ns]."""
        elapsed = np.asarray(other_ns, dtype=np.int64) - self.at_ns
        return elapsed + self.at_ns + self.offset_ns + np.round(elapsed * (self.drift_ppm * 1e-6)).astype(np.int64)

    def offset_at_ns(self, other_ns: int) -> int:
        """Reference time minus other time at an instant of the other clock [ns]."""
        return int(self.to_reference_ns(other_ns)) - other_ns

    @property
    def is_ambiguous(self) -> bool:
        """Whether a different offset fits nearly as well."""
        return (self.peak is not None and self.second_peak is not None
                and self.second_peak.correlation > AMBIGUOUS_PEAK_RATIO * self.peak.correlation)

    def with_doubts(self, *reasons: str) -> "Alignment":
        """The alignment with further reasons; if there are any, the verdict good becomes doubtful."""
        if not reasons:
            return self
        verdict = Verdict.DOUBTFUL if self.verdict is Verdict.GOOD else self.verdict
        return replace(self, verdict=verdict, reasons=(*self.reasons, *reasons))


def refused_alignment(*reasons: str) -> Alignment:
    """Alignment with the verdict refused, for these reasons."""
    return Alignment(0, 0, 0.0, float("inf"), float("inf"), "none", Verdict.REFUSED, reasons)


def describe_step(size: float, time: float) -> str:
    """Reason for a verdict: the offset steps by `size` [s], at `time` [s] after the middle of the overlap."""
    return (f"a clock steps by {size * 1e3:+.0f} ms about {round(time):+d} s from the middle of the overlap: "
            "align the parts before and after it separately")
