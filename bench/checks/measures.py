"""Findings in healthy and in real drives, time of a check, and the effect of each limit of the checks."""

import time
import timeit
from collections import Counter
from dataclasses import fields
from functools import lru_cache, partial
from itertools import product

from st_core.checks import Finding, Severity, compare_runs
from st_core.checks.finding import LIMITS
from st_sim.scenarios import SCENARIOS

from .._cases import FACTORS, map_parallel, multiplied, wilson
from .._drives import SOUND_DRIVES
from .._pages import format_table
from . import drives
from .corruptions import FAULTS
from .drives import virtual_drive
from .recording import Recording
from .score import Drive, check_as_recorded, format_finding, run_check, score_case

FIRST_SEED = 1000
SETS = {"hyundai_genesis_oxts": "The nine drives", "hyundai_genesis_more": "Other drives, most with known faults"}
MINUTES, REPEATS = (1, 10, 30), 3
ABLATION_DRIVE, ABLATION_SEED, ABLATION_DURATION = "virtual_S6", 2000, 40.0
"""Drive with faults; seed and duration [s] of the healthy drives, one of each scenario."""

Setting = tuple[str, float]


def check_healthy_drives(seeds: int, seconds: float, jobs: int) -> tuple[str, int]:
    """Checks `seeds` drives of every scenario; returns (text of the page, exit status 1 if there is an error)."""
    tasks = [(scenario, FIRST_SEED + seed, seconds) for scenario in SCENARIOS for seed in range(seeds)]
    begin, severities, names = time.monotonic(), Counter(), Counter()
    for (scenario, seed, _), findings in zip(tasks, map_parallel(_find_faults, tasks, jobs), strict=True):
        severities.update({finding.severity for finding in findings})
        names.update(finding.name for finding in findings)
        for finding in findings:
            print(f"{scenario} seed {seed}: {format_finding(finding)}", flush=True)
    errors, warnings = severities[Severity.ERROR], severities[Severity.WARNING]
    low, high = wilson(warnings, len(tasks))
    text = (f"{len(tasks)} drives of {seconds:g} s, {len(SCENARIOS)} scenarios: errors in {errors}, warnings in "
            f"{warnings} ({100 * warnings / len(tasks):.2f} %, 95 % interval {100 * low:.2f} to {100 * high:.2f} %)"
            + "".join(f"; `{name}` {count}" for name, count in names.items()) + ".")
    print(f"{text} {time.monotonic() - begin:.0f} s")
    return text, int(bool(errors))


def _find_faults(task: tuple[str, int, float]) -> list[Finding]:
    """Errors and warnings in a drive: (scenario, seed, duration [s])."""
    return [one for one in run_check(virtual_drive(*task)).findings if one.severity is not Severity.NOTE]


def check_real_drives() -> str:
    """Prints every finding; returns the text of the page: errors and warnings by drive, and consistent findings."""
    parts = []
    for folder, title in SETS.items():
        files = [file for file in drives.list_real_files() if file.parent.name == folder]
        results = {file.stem: run_check(drives.real_drive(file)) for file in files}
        for name, one in results.items():
            print(f"{folder}/{name}")
            for finding in one.findings:
                print(f"    {format_finding(finding)}\n        {finding.text}")
        rows = [(name, "; ".join(_format_value(f) for f in one.findings if f.severity is not Severity.NOTE) or "-",
                 str(len(one.with_severity(Severity.NOTE)))) for name, one in results.items()]
        parts.append(f"{title} (`{folder}`):\n\n" + format_table(("drive", "errors and warnings", "notes"), rows))
        common = [one for one in compare_runs(list(results.values())) if one.consistent]
        lines = [f"- `{one.name}` {one.mean:.3g} ± {0.5 * (one.interval[1] - one.interval[0]):.1g}"
                 + ("" if one.unit == "1" else f" {one.unit}") for one in common]
        print("\n".join(lines))
        if folder == SOUND_DRIVES.name:
            parts.append("Consistent across all nine:\n\n" + "\n".join(lines))
    return "\n\n".join(parts)


def _format_value(one: Finding) -> str:
    return f"`{one.name}`" + ("" if one.value is None else f" {one.value:.3g}")


def measure_time() -> str:
    """The Markdown table; prints each row as soon as it is ready."""
    longest = virtual_drive("S6", 1, 60.0 * MINUTES[-1])
    start = int(longest.log.ins_time_ns[0])
    rows = []
    for minutes in MINUTES:
        recording = longest.between(start, start + round(minutes * 60e9))
        seconds = min(timeit.repeat(partial(run_check, recording), timer=time.process_time, number=1, repeat=REPEATS))
        rows.append((str(minutes), str(len(recording.log.x)), f"{seconds:.2f}", f"{seconds / minutes:.3f}"))
        print(*rows[-1], flush=True)
    return format_table(("minutes at 100 Hz", "samples", "s of processor time", "s per minute"), rows)


def ablate_limits(jobs: int) -> str:
    """The results as a Markdown table; prints each row as soon as it is ready."""
    names = [field.name for field in fields(LIMITS)]
    settings: list[Setting] = [("", 1.0), *product(names, FACTORS)]
    verdicts: dict[Setting, str] = {}
    for setting, verdict in zip(settings, map_parallel(_score_setting, settings, jobs), strict=True):
        verdicts[setting] = verdict
        print(*setting, verdict, flush=True)
    rows = [(name, f"{getattr(LIMITS, name):g}", *(verdicts[name, factor] for factor in FACTORS)) for name in names]
    return format_table(("limit", "value", "at half", "at twice"), [("unchanged", "", verdicts["", 1.0], ""), *rows])


def _score_setting(setting: Setting) -> str:
    """Percentage of correct cases with the smaller sizes, cases with other findings, and false alarms, as text."""
    name, factor = setting
    check_as_recorded.cache_clear()
    with multiplied([(LIMITS, name)] if name else [], factor):
        drive = Drive(drives.load(ABLATION_DRIVE, "development"))
        records = [record for fault in FAULTS.values()
                   if (record := score_case(drive, fault, fault.sizes[0])) is not None]
        alarms = sum(any(one.severity is not Severity.NOTE for one in run_check(_healthy_drive(scenario)).findings)
                     for scenario in SCENARIOS)
    correct = 100.0 * sum(r["right"] for r in records) / len(records)
    additional = sum(bool(r["new"]["error"] or r["new"]["warning"]) for r in records)
    return f"{correct:.1f} % correct, {additional} with other findings, {alarms} false alarms"


@lru_cache
def _healthy_drive(scenario: str) -> Recording:
    return virtual_drive(scenario, ABLATION_SEED, ABLATION_DURATION)
