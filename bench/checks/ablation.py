"""Scores of the matrix and false alarms in healthy drives, with each limit of the checks halved and doubled."""

from dataclasses import fields
from functools import lru_cache

from st_core.checks import Severity
from st_core.checks.finding import LIMITS
from st_sim.scenarios import SCENARIOS

from .._pages import format_table
from .corruptions import FAULTS
from .drives import load
from .recording import Recording
from .run import map_parallel
from .score import Drive, check_as_recorded, run_check, score_case
from .virtual import virtual_drive

DRIVE = "virtual_S6"
SEED, DURATION = 2000, 40.0
"""Seed and duration [s] of the healthy drives, one of each scenario."""

Setting = tuple[str, float]


def main(jobs: int) -> str:
    """The results as a Markdown table; prints each row as soon as it is ready."""
    settings: list[Setting] = [("unchanged", 1.0)]
    settings += [(field.name, factor) for field in fields(LIMITS) for factor in (0.5, 2.0)]
    verdicts: dict[Setting, str] = {}
    for setting, verdict in zip(settings, map_parallel(_score_setting, settings, jobs), strict=True):
        verdicts[setting] = verdict
        print(*setting, verdict, flush=True)
    rows = [("unchanged", "", verdicts["unchanged", 1.0], "")]
    rows += [(field.name, f"{getattr(LIMITS, field.name):g}", verdicts[field.name, 0.5], verdicts[field.name, 2.0])
             for field in fields(LIMITS)]
    return format_table(("limit", "value", "at half", "at twice"), rows)


def _score_setting(setting: Setting) -> str:
    """Percentage of correct cases with the smaller sizes, cases with other findings, and false alarms, as text."""
    name, factor = setting
    before = None if factor == 1.0 else getattr(LIMITS, name)
    check_as_recorded.cache_clear()
    try:
        if before is not None:
            object.__setattr__(LIMITS, name, factor * before)  # a frozen dataclass
        drive = Drive(load(DRIVE, "development"))
        records = [record for fault in FAULTS.values()
                   if (record := score_case(drive, fault, fault.sizes[0])) is not None]
        alarms = sum(any(one.severity is not Severity.NOTE for one in run_check(_healthy_drive(scenario)).findings)
                     for scenario in SCENARIOS)
    finally:
        if before is not None:
            object.__setattr__(LIMITS, name, before)
    correct = 100.0 * sum(r["right"] for r in records) / len(records)
    additional = sum(bool(r["new"]["error"] or r["new"]["warning"]) for r in records)
    return f"{correct:.1f} % correct, {additional} with other findings, {alarms} false alarms"


@lru_cache
def _healthy_drive(scenario: str) -> Recording:
    return virtual_drive(scenario, SEED, DURATION)
