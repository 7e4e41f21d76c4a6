"""Options of a discovery, and the limits of its decisions.

Benchmark scores with most limits halved and doubled: docs/measurements/discovery_scores.md.
"""

from dataclasses import dataclass, field, fields

from ..channels import CHANNELS
from ..errors import ConfigurationError


@dataclass(frozen=True)
class Limits:
    """Thresholds of the decisions of a discovery, all above 0. Raises ConfigurationError naming one that is not."""

    # Significance level of an effect (corrected for the whole library), of its variation between subsets of the data,
    # of the rejection of the null by redundant sensors, and of the lower position error with a relation; differences of
    # combinations from the vehicle file (`unseparated_combinations`) are always tested at the default [1].
    false_alarm: float = 0.01
    # p-value above which a difference is undecided (between two effects, from the null, or from redundant sensors), and
    # above which a varying effect may be absent in new data; also the error probability of one-sided confidence bounds,
    # and the relative difference below which two gains count as equal [1].
    undecided_p: float = 0.05
    # Minimum relative error reduction by an effect [1]: it stays in the model only if it reduces the errors of all
    # channels together by this fraction, and is a cause only if it reduces the baseline error of one channel by it.
    relevant: float = 0.025
    # Reduction of the mean position error, overall or in one condition, that suffices instead of `relevant` [m].
    relevant_position: float = 0.02
    # Size of an effect in parameter scales that suffices instead of `relevant` if redundant sensors confirm the effect;
    # also size of the payload tested as the alternative explanation of a lower tyre stiffness [1].
    min_relative_size: float = 0.5
    # Relative reduction of the errors below which an effect is ignored, however significant [1].
    negligible: float = 0.01
    # Fraction of an effect's gain that a rival must reach in its place to be an alternative, after subtracting
    # what the rival gains when added to the effect [1].
    min_rival_gain: float = 0.5
    # Largest accepted deviation of a value from the vehicle file, in standard deviations [1].
    max_file_deviation: float = 3.0
    # Fraction of the peak force of an axle that the drives must reach for an effect on the peak to be reported [1].
    min_peak_force: float = 0.98
    # Distance to a bound, in parameter scales, below which a value counts as being at the bound [1].
    at_bound: float = 0.05
    # Largest gain that unmodelled effects may cause, if the residual exceeds `max_noise_ratio` times the noise [1]. An
    # effect must gain more to be reported as a cause. A rival that gains less than an effect by up to this amount
    # remains an alternative, and intervals include the values of effect sets that increase the loss by up to it.
    unexplained_share: float = 0.2
    max_noise_ratio: float = 2.0  # ratio of residual to noise above which the residual is reported as unexplained [1]
    detection_power: float = 0.8  # minimum power at which a size counts as detectable [1]
    max_effects: int = 16  # largest number of effects in a model

    def __post_init__(self) -> None:
        for limit in fields(self):
            if not getattr(self, limit.name) > 0:
                raise ConfigurationError(f"limit {limit.name}: {getattr(self, limit.name)!r} is not positive")


@dataclass(frozen=True)
class DiscoverySettings:
    """Options of a discovery. Raises ConfigurationError naming the key and its bounds."""

    # Measurements to use. Without velocity_y, sideslip is used neither as a measurement nor in initial states.
    channels: tuple[str, ...] = tuple(CHANNELS)
    seed: int = 0  # of all random numbers
    horizon: float = 5.0  # of a prediction [s]
    windows: int = 400  # approximate maximum number of predictions
    interval: float = 1.0  # shortest time between their starts [s]; closer starts add little with a horizon of 5 s
    block: float = 10.0  # duration of a block of driving [s]; blocks count as independent
    effects: tuple[str, ...] | None = None  # names to choose from; None for all that apply
    limits: Limits = field(default_factory=Limits)  # thresholds of the decisions
    simulate_power: bool = False  # measure the power with a search step on simulated drives instead of predicting it
    locate_errors: bool = True  # report the conditions, times and places of the largest errors

    def __post_init__(self) -> None:
        for channel in self.channels:
            if channel not in CHANNELS:
                raise ConfigurationError(f"channels: {channel!r} is not one of {', '.join(CHANNELS)}")
        if not self.channels:
            raise ConfigurationError(f"channels: at least one of {', '.join(CHANNELS)} is needed")
        for key, low, high in (("horizon", 1.0, 10.0), ("windows", 50, 20_000), ("interval", 0.1, 10.0),
                               ("block", 1.0, 60.0)):
            if not low <= getattr(self, key) <= high:
                raise ConfigurationError(f"{key}: {getattr(self, key):g} is outside {low:g} to {high:g}")
