"""Options of a discovery, and the limits of its decision: every number that decides what is stated.

What the benchmark's scores become at half and twice each limit: docs/measurements/discovery_scores.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from ..channels import CHANNELS
from ..errors import ConfigurationError


@dataclass(frozen=True)
class Limits:
    """Raises ConfigurationError naming the limit that is not a positive number.

    false_alarm [1]: chance, over the whole library, that drives without any gap make one statement; and, of a law that
    is proposed, that the predicted path does not improve with it.
    doubt [1]: chance at which a comparison counts as undecided: two names, a value over runs, an interval.
    relevant [1]: share of the size of the errors an effect must take away to be relevant: of those without it, over all
    channels, to be kept; of those of the start, in one channel, to be named ...
    relevant_position [m]: ... or this much of the mean position error after 5 s, over all or in one driving condition.
    size [1]: ... or, of an effect that the sensors show among themselves, this share of its usual size; and the share a
    load must reach that the drives do not exclude, to be the other name of softer tyres.
    negligible [1]: share of the size of the errors below which nothing is looked at, however sure.
    rival [1]: share of an effect's gain another name must reach to be called an alternative.
    file [1]: standard deviations of a quantity of the vehicle file beyond which a value is refused as contradicting it.
    peak [1]: share of the peak force of an axle that must have been driven for a peak to be stated.
    bound [1]: distance to a bound, as share of the usual size of an effect, below which a value counts as on it.
    unexplained_share [1]: where more is left than `left` times the noise, share of that an effect must take away to be
    named, a name be better than another to be stated alone, and a set of effects be worse than the answer for its
    values not to be in the intervals: a smaller difference may imitate what no effect describes.
    left [1]: times the noise floor: errors beyond that need an explanation, or are reported as unexplained.
    shown [1]: share of drawn cases in which a size must be found to be called visible in these drives.
    most [1]: effects in one answer.
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

    channels: what of the log is used as measurement. Without velocity_y the sideslip is not looked at at all, neither
    as a measurement nor as the start of a prediction. seed: of every drawing of numbers. horizon [s]: of the
    predictions. windows: predictions looked at, about; their starts are as far apart as that makes them, `interval` [s]
    at least: closer ones bring next to nothing new over five seconds. block [s]: driving further apart counts as
    independent. effects: names that take part; None: all that apply. limits: of the decision. certify: run the whole
    search on drives with known effects. where: report where the model misses. noise: one standard deviation by channel,
    as measured; None: from the data.
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
    noise: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        for channel in (*self.channels, *(self.noise or {})):
            if channel not in CHANNELS:
                raise ConfigurationError(f"channels: {channel!r} is none of {', '.join(CHANNELS)}")
        if not self.channels:
            raise ConfigurationError(f"channels: at least one of {', '.join(CHANNELS)} is needed")
        for key, low, high in (("horizon", 1.0, 10.0), ("windows", 50, 20_000), ("interval", 0.1, 10.0),
                               ("block", 1.0, 60.0)):
            if not low <= getattr(self, key) <= high:
                raise ConfigurationError(f"{key}: {getattr(self, key):g} is outside {low:g} to {high:g}")
