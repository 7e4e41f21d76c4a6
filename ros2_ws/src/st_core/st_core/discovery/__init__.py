"""From drives to the name of what a model lacks: `discover`."""

from .discover import Progress, discover
from .result import (
    OUTCOMES,
    Candidate,
    Discovery,
    FittedParameter,
    FoundEffect,
    Gap,
    NextManoeuvre,
    NotTestable,
    Outcome,
    Separability,
    Split,
    WhereStatement,
)
from .settings import CHANNELS, UNITS, DiscoverySettings

__all__ = ["CHANNELS", "OUTCOMES", "UNITS", "Candidate", "Discovery", "DiscoverySettings", "FittedParameter",
           "FoundEffect", "Gap", "NextManoeuvre", "NotTestable", "Outcome", "Progress", "Separability", "Split",
           "WhereStatement", "discover"]
