"""Writes scores, other methods, relations and wrong answers of blocks L, M and N to docs/measurements/proposals.md."""

from collections import defaultdict
from collections.abc import Sequence

from st_recordings.paths import project_root

from .._cases import Record
from .._pages import format_table, replace_part
from . import score
from .cases import COUNTS
from .hidden import BY_NAME

PAGE = project_root() / "docs" / "measurements" / "proposals.md"


def write(records: Sequence[Record]) -> None:
    replace_part(PAGE, "scores", f"\n{as_markdown(records)}\n")


def as_markdown(records: Sequence[Record]) -> str:
    return "\n\n".join([
        _origin(records),
        format_table(("score", "measured", "required", "goal"), score.score_rows(records)),
        *_methods(records),
        "By relation; position after 5 s on held-out drives, mean over the cases, m:",
        format_table(("hidden", "cases", "noticed", "slot right", "vehicle file", "library", "with the proposal",
                      "oracle"), _relation_rows(records)),
        "Wrong answers by case:",
        format_table(("case", "hidden", "answer", "wrong"), _failure_rows(records) or [("-",) * 4])])


def _methods(records: Sequence[Record]) -> list[str]:
    """The table of other methods; empty if no case has them."""
    if not any(r.get("baselines") for r in records):
        return []
    return ["Other methods on the same cases, starting from the same answer of `st discover`, simulated the same way:",
            format_table(("method", "unexplained error removed, median / 10th percentile", "error increased", "names"),
                         score.method_rows(records))]


def _origin(records: Sequence[Record]) -> str:
    sets, versions = (", ".join(sorted({r[key] for r in records})) for key in ("set", "version"))
    counts = ", ".join(f"{sum(r['block'] == b for r in records)} of {n} {b}" for b, n in COUNTS.items())
    warning = ("" if sets.startswith("sealed") else
               " **Development cases: they were known during the development of the method.**")
    return (f"Set: {sets}. Version {versions}. Cases: {counts} (L: relations not in the library, M: an effect removed "
            f"from the library, N: no hidden relation).{warning} In brackets: 95 % Wilson interval.")


def _relation_rows(records: Sequence[Record]) -> list[tuple[str, ...]]:
    by: dict[str, list[Record]] = defaultdict(list)
    for r in records:
        by[r["hidden"]].append(r)

    def mean(rows: Sequence[Record], model: str) -> str:
        values = [r["position"][model] for r in rows if model in r["position"]]
        return f"{sum(values) / len(values):.2f}" if values else "-"

    lines = []
    for name in [*BY_NAME, "nothing"]:
        rows = by.get(name, [])
        if rows:
            relations = [r for r in rows if r["law"]]
            slot = "-" if name == "nothing" else f"{sum(map(score.is_slot_right, relations))} of {len(relations)}"
            lines.append((name, str(len(rows)), str(sum(map(score.is_noticed, rows))), slot,
                          *(mean(rows, model) for model in ("base", "found", "proposed", "oracle"))))
    return lines


def _failure_rows(records: Sequence[Record]) -> list[tuple[str, ...]]:
    rows = []
    for r in sorted(records, key=lambda r: (r["block"], r["index"])):
        wrong = list_failures(r)
        if wrong:
            relation = r["law"]
            by = f" * {relation['by']}" if relation and relation["by"] else ""
            answer = f"{r['outcome']}, no proposal"
            if relation:
                answer = f"{relation['place']}({relation['quantity']}){by}, {relation['reads']}"
            rows.append((f"{r['block']} {r['index']}", f"{r['plant']}: {r['hidden']} x {r['scale']:g}",
                         answer, "; ".join(wrong)))
    return rows


def list_failures(r: Record) -> list[str]:
    """Errors of an answer; empty for a correct one."""
    if r["block"] == "N":
        return ["a proposal without a hidden relation"] if r["law"] else []
    wrong = []
    # Without an oracle it is unknown whether there is an error to notice.
    if ("oracle" not in r["position"] or score.is_closable(r)) and not score.is_noticed(r):
        wrong.append("not noticed")
    if r["law"]:
        wrong += [] if score.is_slot_right(r) else ["another slot"]
        wrong += ["error increased"] if score.is_worse(r) else []
        if score.is_place_right(r) and score.hidden_of(r).shapes and not score.is_shape_right(r):
            wrong.append(f"shape read as {r['law']['shape'] or 'none'}")
    effects = score.list_wrong_effects(r)
    return [*wrong, *([f"stated alone: {', '.join(effects)}"] if effects else [])]
