"""Is a recording what it says it is? What breaks an identity is a sensor, a unit, a clock or a projection.

    checked = check(log, vehicle, extras)
    for finding in checked.findings: print(finding.severity, finding.text, finding.cure)

Pure: numbers in, findings out. The same call serves `st check`, every other verb and the live node.
"""

from .check import check
from .extras import Extras, InsQuality, Series
from .finding import SCHEMA, Channel, Checked, Cure, Finding, Identity, Severity
from .together import Together, pooled, together

__all__ = ["SCHEMA", "Channel", "Checked", "Cure", "Extras", "Finding", "Identity", "InsQuality", "Series", "Severity",
           "Together", "check", "pooled", "together"]
