"""Virtual drives without a fault, for which the checks should report no error and almost no warning."""

import time
from collections import Counter

from st_core.checks import Severity
from st_sim.scenarios import SCENARIOS

from ..discovery.score import wilson
from .run import map_parallel
from .score import format_finding, run_check
from .virtual import virtual_drive

FIRST_SEED = 1000
BATCH = 5  # drives of one scenario in one task

Findings = tuple[str, int, list[tuple[str, str]]]


def main(seeds: int, seconds: float, jobs: int) -> tuple[str, int]:
    """Checks `seeds` drives of every scenario; returns (text of the page, exit status 1 if there is an error)."""
    tasks = [(scenario, range(FIRST_SEED + first, FIRST_SEED + min(first + BATCH, seeds)), seconds)
             for scenario in SCENARIOS for first in range(0, seeds, BATCH)]
    begin, counts, names = time.monotonic(), Counter(), Counter()
    for part in map_parallel(_check_batch, tasks, jobs):
        for scenario, seed, findings in part:
            counts["drives"] += 1
            severities = {severity for severity, _ in findings}
            counts["error"] += Severity.ERROR in severities
            counts["warning"] += Severity.WARNING in severities
            for _, text in findings:
                names[text.split()[1]] += 1
                print(f"{scenario} seed {seed}: {text}", flush=True)
    low, high = wilson(counts["warning"], counts["drives"])
    percent = 100 * counts["warning"] / counts["drives"]
    text = (f"{counts['drives']} drives of {seconds:g} s, {len(SCENARIOS)} scenarios: errors in {counts['error']}, "
            f"warnings in {counts['warning']} ({percent:.2f} %, 95 % interval {100 * low:.2f} to {100 * high:.2f} %)"
            + "".join(f"; `{name}` {count}" for name, count in names.items()) + ".")
    print(f"{text} {time.monotonic() - begin:.0f} s")
    return text, int(bool(counts["error"]))


def _check_batch(task: tuple[str, range, float]) -> list[Findings]:
    scenario, seeds, seconds = task
    rows = []
    for seed in seeds:
        result = run_check(virtual_drive(scenario, seed, seconds))
        rows.append((scenario, seed, [(f.severity, format_finding(f)) for f in result.findings
                                      if f.severity is not Severity.NOTE]))
    return rows
