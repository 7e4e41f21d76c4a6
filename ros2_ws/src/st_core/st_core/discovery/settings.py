"""Options of a discovery, and the limits of its decisions.

Scores of the benchmark with half and twice each limit: docs/measurements/discovery_scores.md.
"""

from dataclasses import dataclass, field, fields

from ..channels import CHANNELS
from ..errors import ConfigurationError


@dataclass(frozen=True)
class Limits:
    """Raises ConfigurationError naming the limit that is not a positive number.

    false_alarm [1]: significance level, over the whole library, of an effect; of the improvement of the path by a
    proposed relation; and, at its default, of a combination (`known_together`) that differs from the vehicle file.
    doubt [1]: p-value above which a comparison is undecided: two names, a value between runs, an interval.
    relevant [1]: relative reduction of the errors from which an effect is relevant: over all channels, of the errors
    without it, to be kept; in one channel, of the baseline errors, to be named ...
    relevant_position [m]: ... or this reduction of the mean position error after 5 s, overall or in one driving
    condition.
    size [1]: ... or, for an effect that the sensors measure among themselves, this share of its usual size; also the
    share that a load not excluded by the drives must reach to be an alternative to softer tyres.
    negligible [1]: relative reduction of the errors below which an effect is ignored, however significant.
    rival [1]: share of an effect's gain that another must reach in its place to be an alternative.
    file [1]: standard deviations from the value of the vehicle file beyond which a value is refused.
    peak [1]: share of the peak force of an axle that must have been driven for a peak to be named.
    bound [1]: distance to a bound, over the usual size of an effect, below which a value counts as on it.
    left [1]: residual over the noise beyond which it is reported as unexplained.
    unexplained_share [1]: share of a residual beyond `left` by which an effect must reduce it to be named, by which a
    name must explain more than another to be the only one, and by which a set must be worse than the answer for its
    values to be left out of the intervals; smaller differences may be due to unmodelled effects.
    shown [1]: power above which a size counts as visible in these drives.
    most [1]: largest number of effects in one answer.
    """

    false_alarm: float = 0.01
    doubt: float = 0.05
    relevant: float = 0.025
    relevant_position: float = 0.02
    size: float = 0.5
    negligible: float = 0.01
    rival: float = 0.5
    file: float = 3.0
    peak: float = 0.8
    bound: float = 0.05
    unexplained_share: float = 0.2
    left: float = 2.0
    shown: float = 0.8
    most: int = 16

    def __post_init__(self) -> None:
        for limit in fields(self):
            if not getattr(self, limit.name) > 0:
                raise ConfigurationError(f"limit {limit.name}: {getattr(self, limit.name)!r} is not above 0")


@dataclass(frozen=True)
class DiscoverySettings:
    """Raises ConfigurationError naming the key and the limit.

    channels: measurements that are used. Without velocity_y the sideslip is used neither as a measurement nor as the
    start of a prediction. seed: of all random numbers. horizon [s]: of the predictions. windows: approximate number of
    predictions; their starts are at least `interval` [s] apart, as closer ones add little over five seconds. block [s]:
    driving further apart counts as independent. effects: names to choose from; None: all that apply. limits: of the
    decisions. certify: measure the power by one step of the search on simulated drives, instead of predicting it.
    where: report the conditions, times and places of the largest errors.
    """

    channels: tuple[str, ...] = tuple(CHANNELS)
    seed: int = 0
    horizon: float = 5.0
    windows: int = 400
    interval: float = 1.0
    block: float = 10.0
    effects: tuple[str, ...] | None = None
    limits: Limits = field(default_factory=Limits)
    certify: bool = False
    where: bool = True

    def __post_init__(self) -> None:
        for channel in self.channels:
            if channel not in CHANNELS:
                raise ConfigurationError(f"channels: {channel!r} is none of {', '.join(CHANNELS)}")
        if not self.channels:
            raise ConfigurationError(f"channels: at least one of {', '.join(CHANNELS)} is needed")
        for key, low, high in (("horizon", 1.0, 10.0), ("windows", 50, 20_000), ("interval", 0.1, 10.0),
                               ("block", 1.0, 60.0)):
            if not low <= getattr(self, key) <= high:
                raise ConfigurationError(f"{key}: {getattr(self, key):g} is outside {low:g} to {high:g}")
