"""Discovery of the effects that a model lacks, from recorded drives; see `discover`."""

from ..channels import CHANNELS
from .discover import Progress, discover, fit_effects
from .result import BUDGET_PARTS, OUTCOMES, Discovery, Outcome
from .settings import DiscoverySettings, Limits

__all__ = ["BUDGET_PARTS", "CHANNELS", "OUTCOMES", "Discovery", "DiscoverySettings", "Limits", "Outcome", "Progress",
           "discover", "fit_effects"]
