"""Findings in every real drive, and those that are consistent across the nine drives without a known fault."""

from st_core.checks import Finding, Severity, compare_runs

from .._cars import SOUND_DRIVES
from .._pages import format_table
from . import drives
from .score import format_finding, run_check

SETS = {"hyundai_genesis_oxts": "The nine drives", "hyundai_genesis_more": "Other drives, most with known faults"}


def main() -> str:
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
