"""Consistency checks of a recording, which reveal faults of sensors, units, clocks and projections.

    checked = check(log, vehicle, auxiliary)
    for finding in checked.findings: print(finding.severity, finding.text, finding.advice)

All commands and the live node call the same function.
"""

from .across_runs import RunComparison, compare_runs, pool_estimates
from .check import check
from .finding import (
           SCHEMA,
           Advice,
           AuxiliaryData,
           Channel,
           Comparison,
           DriveCheck,
           Finding,
           InsQuality,
           Series,
           Severity,
)

__all__ = [
           "SCHEMA",
           "Advice",
           "AuxiliaryData",
           "Channel",
           "Comparison",
           "DriveCheck",
           "Finding",
           "InsQuality",
           "RunComparison",
           "Series",
           "Severity",
           "check",
           "compare_runs",
           "pool_estimates",
]
