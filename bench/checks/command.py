"""Corruption matrix of `st check`: the findings for known faults in real and virtual drives."""

import argparse
import time
from collections.abc import Sequence

from st_recordings.paths import project_root, source_version

from .._cases import map_parallel, wilson
from .._pages import format_table, replace_part
from . import drives, measures, score
from .corruptions import FAULTS

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
    status, version = 0, f"ersion {source_version()}, {time.strftime('%Y-%m-%d', time.gmtime())}"
    if chosen.list:
        return _list_faults()
    if chosen.ablation:
        print(measures.ablate_limits(chosen.jobs))
        return 0
    if chosen.healthy:
        name, (text, status) = "healthy drives", measures.check_healthy_drives(
            chosen.healthy, chosen.seconds, chosen.jobs)
    elif chosen.speed:
        name, text = "time", measures.measure_time()
    elif chosen.real:
        name, text = "real drives", measures.check_real_drives()
    else:
        set_ = "sealed" if chosen.sealed else "development"
        available, kinds = drives.list_drives(set_), chosen.kind or list(FAULTS)
        if unknown := [drive for drive in chosen.drive or () if drive not in available]:
            parser.error(f"--drive {unknown[0]}: the {set_} set has {', '.join(available)}")
        if chosen.kind and chosen.drive and len(chosen.drive) == 1:
            return _print_in_full(set_, chosen.drive[0], kinds)
        records = _run_matrix(set_, chosen.drive or available, kinds, chosen.jobs)
        name, text = f"corruption matrix, {set_}", f"Set {set_}, v{version}: {as_markdown(records)}"
    if chosen.write:
        text = text if name.startswith("corruption") else f"{text}\n\nV{version}."
        replace_part(PAGE, name, f"\n{text}\n")
    return status


def _run_matrix(set_: str, names: Sequence[str], kinds: Sequence[str], jobs: int) -> list[score.Record]:
    """Runs all cases of a set, drive by drive, and prints the wrong ones and all counts."""
    records: list[score.Record] = []
    begin = time.monotonic()
    for part in map_parallel(score.score_drive, [(set_, name, tuple(kinds)) for name in names], jobs):
        for record in part:
            if not record["right"]:
                print("wrong: " + describe_failure(record), flush=True)
        records += part
    for key in ("kind", "drive"):
        print("", *(as_line(value, rows) for value, rows in _group(records, key).items()), sep="\n")
    print("", *(f"{which}: {format_accuracy(rows)} of {len(rows)} right" for which, rows in _totals(records).items()),
          f"{len(records)} cases in {time.monotonic() - begin:.0f} s", sep="\n")
    return records


def _group(records: Sequence[score.Record], key: str) -> dict[str, list[score.Record]]:
    return {value: [r for r in records if r[key] == value] for value in dict.fromkeys(r[key] for r in records)}


def _totals(records: Sequence[score.Record]) -> dict[str, Sequence[score.Record]]:
    groups = _group(records, "real")
    return {name: groups[real] for name, real in (("real", True), ("virtual", False)) if real in groups} | {
        "all": records}


def format_accuracy(records: Sequence[score.Record]) -> str:
    right = sum(r["right"] for r in records)
    low, high = (100 * end for end in wilson(right, len(records)))
    return f"{100 * right / max(len(records), 1):.1f} % ({low:.1f} to {high:.1f})"


def as_line(name: str, records: Sequence[score.Record]) -> str:
    """Counts of the cases of a kind or drive, for the console."""
    named, as_note, inside, right = (sum(r[key] for r in records) for key in ("named", "as_note", "inside", "right"))
    errors, warnings = (sum(bool(r["new"][severity]) for r in records) for severity in ("error", "warning"))
    return (f"{name:32} {len(records):4} cases  named {named:4} ({as_note} as a note)  inside {inside:4}  right "
            f"{right:4}  new errors in {errors}, warnings in {warnings}")


def as_markdown(records: Sequence[score.Record]) -> str:
    """Formats the totals, and the kinds of faults with wrong cases."""
    kinds = _group(records, "kind")
    missed = [(kind, len(rows), right) for kind, rows in kinds.items()
              if (right := sum(r["right"] for r in rows)) < len(rows)]
    parts = [f"{len(kinds)} kinds, {len(kinds) - len(missed)} of them without a miss.",
             format_table(("drives", "cases", "right (95 % interval)"), [
                 (which, len(rows), format_accuracy(rows)) for which, rows in _totals(records).items()])]
    return "\n\n".join([*parts, format_table(("kind", "cases", "right"), missed)] if missed else parts)


def describe_failure(r: score.Record) -> str:
    others = "; ".join((*r["new"]["error"], *r["new"]["warning"])) or "nothing"
    truth = "" if r["truth"] is None else f", true {r['truth']:.4g} (from {r['truth_from']})"
    reported = r["reported"] or "no expected finding"
    return f"{r['drive']}: {r['kind']} {r['size']}{truth}: reported {reported}; others {others}"


def _print_in_full(set_: str, name: str, kinds: Sequence[str]) -> int:
    drive = score.Drive(drives.load(name, set_))
    for fault in map(FAULTS.__getitem__, kinds):
        for size in fault.sizes:
            clean = drive.clean(fault, size)
            if not fault.is_visible(clean, size.value):
                print(f"== {fault.name} {size.label}: not visible in {name}")
                continue
            corrupted, truth = fault.edit(clean, size.value)
            expected = " or ".join(fault.findings)
            print(f"== {fault.name} {size.label}: {fault.operation} {truth:.5g}; expected {expected}")
            for title, result in (("as recorded", score.check_as_recorded(clean)),
                                  ("corrupted", score.run_check(corrupted))):
                print(f"-- {title}")
                for finding in result.findings:
                    advice = finding.advice.line if finding.advice else "-"
                    print(f"{score.format_finding(finding)}\n    {finding.text}\n    where {finding.times}; "
                          f"correction: {advice}")
    return 0


def _list_faults() -> int:
    for fault in FAULTS.values():
        sizes = " / ".join(size.label for size in fault.sizes)
        print(f"{fault.name:32} {sizes:28} {fault.operation:6} {' or '.join(fault.findings)}")
    print(f"{len(FAULTS)} faults; drives: {', '.join(drives.list_drives('development'))}")
    return 0
