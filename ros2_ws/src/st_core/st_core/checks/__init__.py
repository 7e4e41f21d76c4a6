"""Consistency checks of a recording, which reveal faults of sensors, units, clocks and projections.

    result = check(log, vehicle, auxiliary)
    for finding in result.findings: print(finding.severity, finding.text, finding.advice)
"""

from .across_runs import RunComparison, compare_runs, pool_estimates
from .check import check
from .finding import Advice, AuxiliaryData, Comparison, DriveCheck, Finding, InsQuality, Sampling, Series, Severity

__all__ = ["Advice", "AuxiliaryData", "Comparison", "DriveCheck", "Finding", "InsQuality",
           "RunComparison", "Sampling", "Series", "Severity", "check", "compare_runs", "pool_estimates"]
