"""Laws no effect of the library describes: a smooth curve at one place of the model, fitted through the simulator."""

from .places import Candidate, candidates
from .propose import propose, wanted
from .readings import Reading, readings
from .result import Proposal, Proposals

__all__ = ["Candidate", "Proposal", "Proposals", "Reading", "candidates", "propose", "readings", "wanted"]
