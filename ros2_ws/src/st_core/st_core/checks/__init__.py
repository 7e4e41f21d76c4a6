"""Consistency checks of a recording: a violated identity reveals a fault of a sensor, unit, clock or projection.

    checked = check(log, vehicle, auxiliary)
    for finding in checked.findings: print(finding.severity, finding.text, finding.advice)

`st check`, every other command and the live node call the same function.
"""

from .across_runs import AcrossRuns, compare_runs, pool_estimates
from .check import check
from .finding import (
    SCHEMA,
    Advice,
    AuxiliaryData,
    Channel,
    Checked,
    Comparison,
    Finding,
    InsQuality,
    Series,
    Severity,
)

__all__ = ["SCHEMA", "AcrossRuns", "Advice", "AuxiliaryData", "Channel", "Checked", "Comparison", "Finding",
           "InsQuality", "Series", "Severity", "check", "compare_runs", "pool_estimates"]
