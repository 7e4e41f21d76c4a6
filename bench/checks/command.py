"""Command line of the corruption matrix."""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

from st_recordings.paths import project_root, source_version

from .._pages import replace_part
from . import ablation, drives, healthy, real, speed, tables
from .corruptions import FAULTS
from .run import run_matrix
from .score import Drive, Record, check_as_recorded, format_finding, run_check

RESULTS = Path(__file__).with_name("results.json")
PAGE = project_root() / "docs" / "manual" / "checks.md"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="st bench checks", description=(
        "Adds known faults to real and virtual drives, and scores the findings of `st check`. Run the sealed drives "
        "only once, at the end, and those of development as often as you like."))
    parser.add_argument("--sealed", action="store_true", help="use the sealed drives, with random sizes")
    parser.add_argument("--kind", action="append", choices=sorted(FAULTS), metavar="NAME", help="may be repeated")
    parser.add_argument("--drive", action="append", metavar="NAME", help="may be repeated; with --kind and a single "
                        "drive, every finding is printed in full")
    parser.add_argument("--list", action="store_true", help="print faults, sizes, findings and drives")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--write", action="store_true",
                        help="write the result into docs/manual/checks.md, except that of --ablation")
    parser.add_argument("--healthy", type=int, metavar="SEEDS", help="check drives without a fault instead")
    parser.add_argument("--seconds", type=float, default=35.0, help="duration of a healthy drive")
    parser.add_argument("--speed", action="store_true", help="measure the time of a check instead")
    parser.add_argument("--ablation", action="store_true",
                        help="print the scores with each limit halved and doubled instead")
    parser.add_argument("--real", action="store_true", help="print the findings of every real drive instead")
    chosen = parser.parse_args(arguments)
    if chosen.list:
        return _list_faults()
    if chosen.healthy:
        text, status = healthy.main(chosen.healthy, chosen.seconds, chosen.jobs)
        return _write_page("healthy drives", text, chosen.write, status)
    if chosen.speed:
        return _write_page("time", speed.main(), chosen.write)
    if chosen.ablation:
        print(ablation.main(chosen.jobs))
        return 0
    if chosen.real:
        return _write_page("real drives", real.main(), chosen.write)
    return _run_matrix(parser, chosen)


def _run_matrix(parser: argparse.ArgumentParser, chosen: argparse.Namespace) -> int:
    set_ = "sealed" if chosen.sealed else "development"
    available, kinds = drives.list_drives(set_), chosen.kind or list(FAULTS)
    if unknown := [name for name in chosen.drive or () if name not in available]:
        parser.error(f"--drive {unknown[0]}: the {set_} set has {', '.join(available)}")
    if chosen.kind and chosen.drive and len(chosen.drive) == 1:
        return _print_in_full(set_, chosen.drive[0], kinds)
    records: list[Record] = []
    begin = time.monotonic()
    for part in run_matrix(set_, chosen.drive or available, kinds, chosen.jobs):
        for record in part:
            if not record["right"]:
                print("wrong: " + tables.describe_failure(record), flush=True)
        records += part
    version = {"set": set_, "version": source_version(), "date": time.strftime("%Y-%m-%d", time.gmtime())}
    document = {**version, **tables.summarise(records)}
    print(f"\n{tables.as_text(document)}\n{len(records)} cases in {time.monotonic() - begin:.0f} s")
    if chosen.write:
        _write_results(document, records)
    return 0


def _write_results(document: Record, records: Sequence[Record]) -> None:
    """Writes the results of a set to results.json, and those of both sets to the page."""
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    results[document["set"]] = {**document, "wrong": [tables.describe_failure(r) for r in records if not r["right"]]}
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    _write_page("corruption matrix", "\n\n".join(
        tables.as_markdown(results[name]) for name in ("development", "sealed") if name in results), True)


def _write_page(name: str, text: str, write: bool, status: int = 0) -> int:
    """Writes a part of the page if `write`; returns `status`."""
    if write:
        date = f"Version {source_version()}, {time.strftime('%Y-%m-%d', time.gmtime())}."
        text = text if name == "corruption matrix" else f"{text}\n\n{date}"
        replace_part(PAGE, name, f"\n{text}\n", "<!-- {} -->\n", "<!-- end -->\n")
    return status


def _print_in_full(set_: str, name: str, kinds: Sequence[str]) -> int:
    drive = Drive(drives.load(name, set_))
    for fault in map(FAULTS.__getitem__, kinds):
        for size in fault.sizes:
            clean = drive.clean(fault, size)
            if not fault.is_visible(clean, size.value):
                print(f"== {fault.name} {size.label}: not visible in {name}")
                continue
            corrupted, truth = fault.edit(clean, size.value)
            expected = " or ".join(fault.findings)
            print(f"== {fault.name} {size.label}: {fault.operation} {truth:.5g}; expected {expected}")
            for title, result in (("as recorded", check_as_recorded(clean)), ("corrupted", run_check(corrupted))):
                print(f"-- {title}")
                for finding in result.findings:
                    advice = finding.advice.line if finding.advice else "-"
                    print(f"{format_finding(finding)}\n    {finding.text}\n    where {finding.times}; "
                          f"correction: {advice}")
    return 0


def _list_faults() -> int:
    for fault in FAULTS.values():
        sizes = " / ".join(size.label for size in fault.sizes)
        print(f"{fault.name:32} {sizes:28} {fault.operation:6} {' or '.join(fault.findings)}")
    print(f"{len(FAULTS)} faults; drives: {', '.join(drives.list_drives('development'))}")
    return 0
