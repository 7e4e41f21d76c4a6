"""What is said of every recorded drive of the shared folders, and of the nine together."""

from collections.abc import Sequence

from st_core.checks import Finding, Severity, together

from . import drives
from .score import checked, short
from .tables import table

SETS = {"hyundai_genesis_oxts": "The nine drives", "hyundai_genesis_more": "Drives with faults of known cause"}


def main() -> str:
    """Prints every finding; the page's text."""
    parts = []
    for folder, title in SETS.items():
        files = [file for file in drives.real_files() if file.parent.name == folder]
        said = {file.stem: checked(drives.real_drive(file)) for file in files}
        for name, one in said.items():
            print(f"{folder}/{name}")
            for finding in one.findings:
                print(f"    {short(finding)}\n        {finding.text}")
        rows = [(name, _words(one.findings, Severity.ERROR, Severity.WARNING), _words(one.findings, Severity.NOTE))
                for name, one in said.items()]
        parts.append(f"{title} (`{folder}`):\n\n" + table(("drive", "errors and warnings", "notes"), rows))
        if folder == "hyundai_genesis_oxts":
            lines = [f"- {one.text}" for one in together(list(said.values()))]
            print("\n".join(lines))
            parts.append("All nine together:\n\n" + "\n".join(lines))
    return "\n\n".join(parts)


def _words(findings: Sequence[Finding], *severities: Severity) -> str:
    words = [f"`{one.name}` {_value(one)}".strip() for one in findings if one.severity in severities]
    return "; ".join(words) or "-"


def _value(one: Finding) -> str:
    if one.value is None:
        return ""
    if one.interval is None:
        return f"{one.value:.3g}"
    half = 0.5 * (one.interval[1] - one.interval[0])
    return f"{one.value:.3g} ± {half:.2g}" + ("" if one.unit == "1" else f" {one.unit}")
