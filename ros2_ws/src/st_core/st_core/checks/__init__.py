"""Consistency checks of a recording: a violated identity is a fault of a sensor, unit, clock or projection.

    checked = check(log, vehicle, auxiliary)
    for finding in checked.findings: print(finding.severity, finding.text, finding.advice)

Pure: numbers in, findings out. The same call serves `st check`, every other verb and the live node.
"""

from .across_runs import AcrossRuns, across_runs, pooled
from .check import check
from .finding import (
    SCHEMA,
    Advice,
    AuxiliaryData,
    Channel,
    Checked,
    Finding,
    Identity,
    InsQuality,
    Series,
    Severity,
)

__all__ = ["SCHEMA", "AcrossRuns", "Advice", "AuxiliaryData", "Channel", "Checked", "Finding", "Identity", "InsQuality",
           "Series", "Severity", "across_runs", "check", "pooled"]
