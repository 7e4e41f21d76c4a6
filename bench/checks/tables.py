"""Formats the records of the matrix for the console, results.json and docs/manual/checks.md."""

from collections.abc import Sequence

from .._pages import format_table
from ..discovery.score import wilson
from .score import Record


def count_row(records: Sequence[Record], **first: object) -> Record:
    counts = {key: sum(r[key] for r in records) for key in ("named", "as_note", "inside", "right")}
    errors = sum(bool(r["new"]["error"]) for r in records)
    warnings = sum(bool(r["new"]["warning"]) for r in records)
    share = [round(end, 4) for end in wilson(counts["right"], len(records))]
    return {**first, "cases": len(records), **counts, "interval": share, "new_errors": errors,
            "new_warnings": warnings}


def summarise(records: Sequence[Record]) -> Record:
    """Counts for each fault, each drive, and in total."""
    def by(key: str) -> list[Record]:
        values = dict.fromkeys(r[key] for r in records)
        return [count_row([r for r in records if r[key] == value], **{key: value}) for value in values]
    groups = [count_row([r for r in records if r["real"] is real], which="real" if real else "virtual")
              for real in (True, False) if any(r["real"] is real for r in records)]
    return {"kinds": by("kind"), "drives": by("drive"), "total": [*groups, count_row(records, which="all")]}


def format_accuracy(r: Record) -> str:
    low, high = r["interval"]
    percent = 100 * r["right"] / r["cases"] if r["cases"] else 0.0
    return f"{percent:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def as_markdown(document: Record) -> str:
    """Formats the totals, and the faults with wrong cases."""
    total = [(r["which"], str(r["cases"]), format_accuracy(r)) for r in document["total"]]
    missed = [(r["kind"], str(r["cases"]), str(r["right"])) for r in document["kinds"] if r["right"] < r["cases"]]
    count = len(document["kinds"])
    heading = (f"Set {document['set']}, version {document['version']}, {document['date']}: {count} kinds, "
               f"{count - len(missed)} of them without a miss.")
    parts = [heading, format_table(("drives", "cases", "right (95 % interval)"), total)]
    return "\n\n".join([*parts, format_table(("kind", "cases", "right"), missed)] if missed else parts)


def as_text(document: Record) -> str:
    def lines(rows: Sequence[Record], key: str) -> list[str]:
        return [f"{r[key]:32} {r['cases']:4} cases  named {r['named']:4} ({r['as_note']} as a note)  inside "
                f"{r['inside']:4}  right {r['right']:4}  new errors in {r['new_errors']}, warnings in "
                f"{r['new_warnings']}" for r in rows]
    total = [f"{r['which']}: {format_accuracy(r)} of {r['cases']} right" for r in document["total"]]
    return "\n".join([*lines(document["kinds"], "kind"), "", *lines(document["drives"], "drive"), "", *total])


def describe_failure(r: Record) -> str:
    others = "; ".join((*r["new"]["error"], *r["new"]["warning"])) or "nothing"
    truth = "" if r["truth"] is None else f", true {r['truth']:.4g} (from {r['truth_from']})"
    reported = r["reported"] or "no expected finding"
    return f"{r['drive']}: {r['kind']} {r['size']}{truth}: reported {reported}; others {others}"
