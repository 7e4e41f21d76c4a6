"""Writes the tables of docs/measurements/discovery_scores.md and draws the confusion matrix."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from st_recordings.paths import project_root

from .._cases import Record
from .._pages import format_table, replace_part
from ..plants.record import LEAF
from . import score
from .cases import COUNTS
from .edits import compare_edit
from .effects import KNOWN, PLANT_DIFFERENCES
from .evaluation import plant_differences
from .score import format_result, list_statements, relevant_effects, share_of, value_of

matplotlib.use("Agg")
from matplotlib import pyplot as plt

PAGE = project_root() / "docs" / "measurements" / "discovery_scores.md"
FIGURE = project_root() / "docs" / "images" / "discovery_confusion.png"
NOT_RUN = "Not run with these records."
OTHERS = ("several", "unknown", "none")
"""Columns of the confusion matrix that are not effects."""


def write(records: Sequence[Record]) -> None:
    """Writes the parts of the page and the figure."""
    unchanged = [r for r in records if "limit" not in r]
    for name, text in {
        "set and version": _origin(unchanged),
        "scores": format_table(("score", "measured", "required", "goal"), [
            (r["name"].strip(), format_result(r), r["required"], r["goal"]) for r in _score_all_plants(unchanged)]),
        "scores by plant": _plants(unchanged), "scores by effect": _by_effect(unchanged),
        "other methods": _methods(unchanged), "limits": _ablation([r for r in records if "limit" in r]),
        "plant differences": format_table(("plant", "effect", "why"), [
            (plant, name, why) for plant, rows in PLANT_DIFFERENCES.items() for name, why in rows.items()]),
        "wrong answers": "\n\n".join(_failure_tables(unchanged)),
    }.items():
        replace_part(PAGE, name, text)
    draw_confusion(unchanged, FIGURE)


def _origin(records: Sequence[Record]) -> str:
    """Set, versions and numbers of cases, with a warning if not all cases are from the sealed set."""
    counts = Counter(r["block"] for r in records if r["index"] >= 0)
    sets, versions = (sorted({r[key] for r in records}) for key in ("set", "version"))
    text = (f"Set: {', '.join(sets)}. Version {', '.join(versions)}. Cases: "
            + ", ".join(f"{counts[block]} {block} of {n}" for block, n in COUNTS.items()) + ".")
    development = sum(r["set"] != "sealed" for r in records if r["index"] >= 0)
    if not development:
        return text
    cases = f"All {development}" if development == counts.total() else f"{development} of the {counts.total()}"
    warning = (f"**Development cases.** {cases} cases below were known during the development of "
               "the decision: they show progress, not quality.")
    if "sealed" not in sets:
        warning += " **The sealed set has not been opened yet.**"
    if len(versions) > 1:
        warning += f" The answers are from {len(versions)} versions, so no score belongs to one version."
    return f"{warning}\n\n{text}"


def _score_all_plants(records: Sequence[Record]) -> list[Record]:
    """The scores, without those of the multi-body cars, which `_plants` lists."""
    return [r for r in score.score_rows(records) if not r["name"].strip().startswith("multi-body")]


def _plants(records: Sequence[Record]) -> str:
    """The scores of blocks A to C for each plant."""
    names, columns = [], []
    for leaf in (True, False):
        chosen = [r for r in records if r["block"] in "ABC" and (r["plant"] == LEAF) == leaf]
        rows = [r for r in _score_all_plants(chosen) if r.get("of")]
        names = names or [r["name"] for r in rows]
        columns.append({r["name"]: format_result(r) for r in rows})
    return format_table(("score", "virtual Leaf", "multi-body cars"),
                        [(n.strip(), *(c.get(n, "no cases") for c in columns)) for n in names])


def _by_effect(records: Sequence[Record]) -> str:
    ab = [r for r in records if r["block"] in "AB"]
    rows = []
    for name in [h.library for h in KNOWN]:
        found = share_of([score.is_stated(r, name) for r in ab if name in relevant_effects(r)])
        right = share_of([inside for r in ab for n, inside in score.covered_values(r) if n == name])
        rows.append((name, format_result(found), format_result(right)))
    return format_table(("effect", "stated", "value inside its interval"), rows)


def _methods(records: Sequence[Record]) -> str:
    compared = [r for r in records if r.get("baselines") and score.closed_fraction(r) is not None]
    if not compared:
        return NOT_RUN

    def row(name: str, position: Callable[[Record], float]) -> tuple[str, ...]:
        shares = [(r["position"]["base"] - position(r)) / (r["position"]["base"] - r["position"]["oracle"])
                  for r in compared]
        worse = share_of(position(r) > score.WORSE * r["position"]["base"] for r in compared)
        return (name, *(format_result({**value_of(shares, lambda v, q=q: np.quantile(v, q)), "name": "",
                                       "percent": True})
                        for q in (0.5, 0.1)), format_result(worse))
    rows = [row("no change", lambda r: r["position"]["base"]),
            row("tyres refitted (three parameters)", lambda r: r["baselines"]["tyres"]),
            row("paramsd's equations (ratio, stiffness, offset)", lambda r: r["baselines"]["paramsd"]),
            row("discover", lambda r: r["position"]["found"]),
            row("oracle: the true effects fitted", lambda r: r["position"]["oracle"])]
    regressed = [r for r in compared if "regression" in r["baselines"]]
    named = share_of(bool(set(r["baselines"]["regression"]["names"]) & set(r["hidden"])) for r in regressed)
    worse = share_of(r["baselines"]["regression"]["after"] > r["baselines"]["regression"]["before"] for r in regressed)
    text = ("Sparse regression of the residual accelerations predicts no positions. Its largest term names a hidden "
            f"effect in {format_result(named)}; the residual on held-out drives grows in {format_result(worse)}.")
    return format_table(("method", "median", "10th percentile", "error increased"), rows) + "\n\n" + text


ABLATED = ("A and B: relevant effects stated, alone or with alternatives", "A and B: false statements",
           "A and B: mean number of effects per statement", "A and B: values inside their 95 % interval",
           "C: false statements", "D: alarms, same conditions", "E: reported as varying or unknown, not named")


def _ablation(records: Sequence[Record]) -> str:
    if not records:
        return NOT_RUN
    by: dict[tuple[str, float], list[Record]] = defaultdict(list)
    for r in records:
        by[r["limit"][0], r["limit"][1]].append(r)
    rows = {f"{name} x {factor:g}" if name else "unchanged": _measure_ablated(matching)
            for (name, factor), matching in sorted(by.items())}
    unchanged = by["", 1.0]
    cases = ", ".join(f"{n} {block}" for block, n in sorted(Counter(r["block"] for r in unchanged).items()))
    about = (f"The same cases with half and twice each limit; set {unchanged[0]['set']}, version "
             f"{unchanged[0]['version']}, {cases}. So few cases only show which changes of a limit do harm, not which "
             "value is best.")
    return "\n\n".join((about, format_ablation(rows)))


def _measure_ablated(records: Sequence[Record]) -> tuple[str, ...]:
    measured = {r["name"]: format_result(r) for r in score.score_rows(records)}
    return tuple(measured[name] for name in ABLATED)


def format_ablation(rows: Mapping[str, Sequence[str]]) -> str:
    """A table of the rows and scores that change; the others are listed after it."""
    unchanged = rows["unchanged"]
    varying = [i for i in range(len(ABLATED)) if any(row[i] != unchanged[i] for row in rows.values())]
    same = [title for title, row in rows.items() if row == unchanged and title != "unchanged"]
    table = format_table(("limit", *(ABLATED[i] for i in varying)), [
        (title, *(row[i] for i in varying)) for title, row in rows.items() if title not in same])
    constant = "; ".join(f"{name}, {unchanged[i]}" for i, name in enumerate(ABLATED) if i not in varying)
    return (f"{table}\n\nAs unchanged: {', '.join(same) or 'none'}.\n\n"
            f"Equal in all rows: {constant or 'none'}.")


def _failure_tables(records: Sequence[Record]) -> list[str]:
    """A table for each block: case, hidden effects, answer, errors."""
    plain = next((r for r in records if r["block"] == "F" and r["index"] < 0), None)
    parts = []
    for block in "ABCDEF":
        rows = []
        for r in records:
            if r["block"] == block and r["index"] >= 0:
                wrong = list_failures(r, plain)
                if wrong:
                    hidden = f"{r['plant']}: {r['words']}" if "words" in r else f"{r['kind']} {r['size']:+.3g}"
                    rows.append((f"{block} {r['index']}", hidden, f"{r['outcome']}: {format_answer(r)}",
                                 "; ".join(wrong)))
        if rows:
            parts.append(format_table(("case", "hidden", "answer", "wrong"), rows))
    return parts or ["None."]


def format_answer(r: Record) -> str:
    names = [" or ".join(group) for group in list_statements(r)] + [
        f"{name} varies with {partition}" for name, partition in r["varying"]]
    return " + ".join(names) or "-"


def list_failures(r: Record, plain: Record | None) -> list[str]:
    """Errors of an answer; empty for a correct one."""
    if r["outcome"] == "error":
        return [r["error"]]
    block = r["block"]
    if block == "F":
        if plain is None:
            return []
        e = compare_edit(plain, r)
        value = "not stated" if e.stated is None else f"{e.stated[0]:.4g} ({e.stated[1]:.4g} to {e.stated[2]:.4g})"
        return [*([] if e.moved else [f"expected {e.expected:.4g}, {value}"]),
                *([f"also changed: {', '.join(e.others)}"] if e.others else [])]
    if block == "D":
        alarm = r["kind"] == "healthy" and r["outcome"] != "none"
        missed = r["kind"] == "one" and r.get("detectability", 0.0) > 0.1 and not score.is_exact(r)
        return ["alarm"] * alarm + [f"not the exact name (D {r.get('detectability', 0.0):.2f})"] * missed
    if block == "E":
        counts = r.get("loss_ratio", 0.0) >= score.MIN_HIDDEN_LOSS_RATIO
        return ["not reported, or a false statement"] if counts and not score.is_reported(r) else []
    if block == "C" and r["kind"] == "base":
        return ["an effect is stated"] if r["effects"] else []
    wrong = [f"false: {' or '.join(names)}" for names in score.list_false(r)]
    wrong += [f"missed: {n} (x{r['worth'][n]:.2f})" for n in relevant_effects(r) if not score.is_stated(r, n)]
    wrong += [f"value of {n} outside" for n, inside in score.covered_values(r) if not inside]
    if "position" in r and score.is_worse(r):
        wrong.append("held-out error increased")
    return wrong


def count_confusion(records: Sequence[Record]) -> tuple[list[str], list[str], np.ndarray]:
    """(hidden effects, stated effects, counts) for the cases of block A with a relevant effect.

    If several effects are stated, the hidden one counts if it is among them.
    """
    truths = [h.library for h in KNOWN]
    single = [r for r in records if r["block"] == "A" and relevant_effects(r)]
    stated = [_stated(r) for r in single]
    columns = truths + sorted(set(stated) - set(truths) - set(OTHERS)) + list(OTHERS)
    counts = np.zeros((len(truths), len(columns)), int)
    for r, name in zip(single, stated, strict=True):
        counts[truths.index(r["hidden"][0]), columns.index(name)] += 1
    return truths, columns, counts


def _stated(r: Record) -> str:
    # True differences between plant and model count only if they are hidden.
    names = [e["name"] for e in r["effects"] if e["name"] in r["hidden"]
             or e["name"] not in plant_differences(r["plant"])]
    if r["hidden"][0] in names:
        return r["hidden"][0]
    return "several" if len(names) > 1 else names[0] if names else "unknown" if r["outcome"] == "unknown" else "none"


def draw_confusion(records: Sequence[Record], file: Path) -> None:
    truths, columns, counts = count_confusion(records)
    figure, axes = plt.subplots(figsize=(11, 8.5), layout="constrained")
    fraction = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    image = axes.imshow(fraction, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(range(len(columns)), columns, rotation=90)
    axes.set_yticks(range(len(truths)), [f"{t} ({n})" for t, n in zip(truths, counts.sum(axis=1), strict=True)])
    for i, j in zip(*np.nonzero(counts), strict=True):
        axes.text(j, i, counts[i, j], ha="center", va="center", color="white" if fraction[i, j] > 0.6 else "black")
    axes.axvline(len(columns) - len(OTHERS) - 0.5, color="0.5", lw=0.8)
    axes.set_xlabel("stated effect")
    axes.set_ylabel("hidden effect (block A, relevant)")
    figure.colorbar(image, label="fraction of the row [1]")
    figure.savefig(file, dpi=110)
    plt.close(figure)
