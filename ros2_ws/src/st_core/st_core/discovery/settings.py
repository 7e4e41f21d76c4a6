"""What a discovery may be told."""

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

from ..errors import ConfigurationError

CHANNELS = ("velocity_y", "yaw_rate", "acceleration_y", "yaw", "position")
UNITS = {"velocity_y": "m/s", "yaw_rate": "rad/s", "acceleration_y": "m/s^2", "yaw": "rad", "position": "m",
         "position_5s": "m"}


@dataclass(frozen=True)
class DiscoverySettings:
    """Raises ConfigurationError naming the key and the limit.

    channels: what of the log is used as measurement. Without velocity_y the sideslip is not looked at at all, neither
    as a measurement nor as the start of a prediction. seed: of the resampling. maximum_effects: found at most.
    horizon, interval [s]: of the multi-step errors and between their starts. block [s]: data closer together count as
    one. confidence: of sets and intervals. false_alarm: probability of finding something in healthy data. effects:
    names that take part; None: all that apply. noise: one standard deviation by channel, as measured; None: from the
    data. resamples: of the bootstrap.
    """

    channels: tuple[str, ...] = CHANNELS
    seed: int = 0
    maximum_effects: int = 4
    horizon: float = 2.0
    interval: float = 0.5
    block: float = 4.0
    confidence: float = 0.95
    false_alarm: float = 0.01
    effects: tuple[str, ...] | None = None
    noise: Mapping[str, float] | None = None
    resamples: int = 1000
    drift: float = 0.03
    where: bool = True

    @property
    def deviations(self) -> float:
        """Standard deviations of a normal distribution that hold the confidence on both sides."""
        return NormalDist().inv_cdf(0.5 + 0.5 * self.confidence)

    @property
    def deviations_above(self) -> float:
        """The same on one side."""
        return NormalDist().inv_cdf(self.confidence)

    def __post_init__(self):
        for channel in (*self.channels, *(self.noise or {})):
            if channel not in CHANNELS:
                raise ConfigurationError(f"channels: {channel!r} is none of {', '.join(CHANNELS)}")
        if not self.channels:
            raise ConfigurationError(f"channels: at least one of {', '.join(CHANNELS)} is needed")
        for key, low, high in (("maximum_effects", 1, 8), ("horizon", 0.5, 10.0), ("interval", 0.1, 5.0),
                               ("block", 1.0, 60.0), ("confidence", 0.5, 0.999), ("false_alarm", 1e-4, 0.5),
                               ("resamples", 100, 100_000), ("drift", 0.0, 1.0)):
            if not low <= getattr(self, key) <= high:
                raise ConfigurationError(f"{key}: {getattr(self, key):g} is outside {low:g} to {high:g}")
