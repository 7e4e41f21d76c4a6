"""Options of a discovery."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from ..channels import CHANNELS
from ..errors import ConfigurationError
from .limits import Limits


@dataclass(frozen=True)
class DiscoverySettings:
    """Raises ConfigurationError naming the key and the limit.

    channels: what of the log is used as measurement. Without velocity_y the sideslip is not looked at at all, neither
    as a measurement nor as the start of a prediction. seed: of every drawing of numbers. horizon [s]: of the
    predictions. windows: predictions looked at, about; their starts are as far apart as that makes them, `interval` [s]
    at least: closer ones bring next to nothing new over five seconds. block [s]: driving further apart counts as
    independent. effects: names that take part; None: all that apply. limits: of the decision. certify: run the whole
    search on drives with known effects. where: say where the model misses. noise: one standard deviation by channel, as
    measured; None: from the data.
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
