"""Scores as Markdown, put between two marks of docs/discovery.md."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .score import is_exact, is_exact_pair, is_found, is_untestable, shown

Record = dict[str, Any]
BEGIN, END = "<!-- scores: written by st bench discovery -->", "<!-- end of scores -->"
FAILURES = 120


def as_markdown(document: Record, records: Sequence[Record]) -> str:
    counts = ", ".join(f"{n} {kind}" for kind, n in sorted(document["counts"].items()) if n)
    strata, wrong = document["strata"], _failures(records)
    versions = ", ".join(sorted({r["version"] for r in records}))
    levels = ", ".join(f"{strata.get(name, 0)} {name}" for name in ("strong", "medium", "weak", "invisible"))
    parts = [
        f"Version {versions}. Cases run: {counts}. Single effects by stratum: {levels}.",
        _table(("score", "measured (95 % interval)", "floor", "goal"),
               [(r["name"], shown(r), r["floor"], r["goal"]) for r in document["scores"]]),
        "The same cases, other methods (single effects with D > 0.1; healthy cases for alarms):",
        _table(("method", "held-out gap closed, median / 10th percentile", "made worse", "names the effect",
                "false alarm"), [_baseline(b) for b in document["baselines"]]),
        f"What went wrong, case by case ({min(len(wrong), FAILURES)} of {len(wrong)}):",
        _table(("case", "hidden", "D", "said"), wrong[:FAILURES]),
    ]
    return "\n\n".join(parts)


def put_into(page: Path, text: str) -> None:
    """Replaces what is between the marks. Raises ValueError where the page has none."""
    before, begin, rest = page.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{page}: the marks {BEGIN} and {END} are not there")
    page.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _baseline(b: Record) -> tuple[str, ...]:
    def share(row: Record | None) -> str:
        return "-" if row is None or not row["of"] else f"{100 * row['share']:.0f} % ({row['hits']}/{row['of']})"
    gap = b["gap"]
    closed = "-" if gap is None or not gap["of"] else f"{100 * gap['median']:.0f} % / {100 * gap['tenth']:.0f} %"
    return b["name"], closed, share(b["worse"]), share(b["named"]), share(b["alarm"])


def _failures(records: Sequence[Record]) -> list[tuple[str, ...]]:
    rows = []
    for r in records:
        if _right(r):
            continue
        said = " + ".join(" or ".join(group) for group in r["names"]) or "-"
        rows.append((f"{r['kind']} {r['index']}", r["hidden"] + ("" if r["with_vy"] else ", no v_y"),
                     f"{r['detectability']:.2f}" if "detectability" in r else "-", f"{r['outcome']}: {said}"))
    return rows


def _right(r: Record) -> bool:
    """Whether nothing about the answer needs saying; effects that cannot be seen and gaps that are none do not."""
    kind = r["kind"]
    if kind == "untestable":
        return is_untestable(r)
    if kind == "unknown":
        return r["outcome"] == "unknown" or r.get("base", 2.0) <= 1.0 / 0.9
    if not r["truth"]:
        return not is_found(r)
    if r.get("detectability", 1.0) <= 0.1:
        return True
    return is_exact_pair(r) if kind == "double" else is_exact(r)
