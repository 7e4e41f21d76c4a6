"""Computes scores from records: fractions with 95 % Wilson intervals, required values and goals."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from st_core.effects import EFFECTS

from .._cases import Record, wilson
from ..plants.record import LEAF
from .edits import compare_edit
from .effects import is_similar, members
from .evaluation import plant_differences

Row = tuple[str, str, str, Record]
"""Name, required value, goal and result of a score."""
MIN_LOSS_RATIO = 1.10
"""A hidden effect is relevant if the oracle's held-out loss without it, divided by that with it, is at least this."""
CLOSABLE = 0.02, 0.1
"""Minimum gain of the oracle of which a fraction is computed: [m], and relative to the error of the base model."""
WORSE = 1.02
"""Ratio of the held-out position error to that of the base model above which an answer is worse."""
MIN_HIDDEN_LOSS_RATIO = 1.10
"""Block E: minimum ratio of the base model's loss to that for the healthy car, for a relevant hidden effect."""
STRATA = (("strong", 0.5), ("medium", 0.25), ("weak", 0.1), ("invisible", -math.inf))
MIN_CASES = 4  # of an effect, for a comparison of its predicted power with the results


def stratum(detectability: float) -> str:
    return next(name for name, low in STRATA if detectability > low)


def list_statements(r: Record) -> list[list[str]]:
    """The statements of an answer: for each, the name of the effect, then those of its alternatives."""
    return [_names(e) for e in r["effects"]]


def is_covered(name: str, hidden: str) -> bool:
    """Whether the statement `name` includes `hidden`: it is the same effect, or a composite of it."""
    return name == hidden or (name in EFFECTS and hidden in members(name))


def is_stated(r: Record, hidden: str) -> bool:
    """Whether an answer states a hidden effect, alone or with alternatives."""
    return any(is_covered(name, hidden) for group in list_statements(r) for name in group)


def is_false(r: Record, effect: Record) -> bool:
    """Whether a statement is false: no effect of it is hidden, similar to a hidden one, or a true difference between
    plant and model, and not all of its values are those of effects that every car has."""
    true = {*plant_differences(r["plant"]), *r.get("mistaken", ())}
    if any(name in true or any(is_similar(name, h) for h in r["hidden"]) for name in _names(effect)):
        return False
    parts = members(effect["name"]) if effect["name"] in EFFECTS else (effect["name"],)
    known = [r["scatter"].get(part) for part in parts]
    return not all(known) or not all(low <= value.get(n, math.inf) <= high for value in known
                                     for n, (_, low, high) in effect["values"].items())


def list_false(r: Record) -> list[list[str]]:
    """The statements that are false."""
    return [_names(e) for e in r["effects"] if is_false(r, e)]


def _names(effect: Record) -> list[str]:
    return [effect["name"], *effect["alternatives"]]


def is_exact(r: Record) -> bool:
    return len(r["effects"]) == 1 and list_statements(r)[0][0] == r["hidden"][0]


def relevant_effects(r: Record) -> list[str]:
    """Hidden effects that are relevant: without them, the oracle is worse (MIN_LOSS_RATIO)."""
    return [n for n, ratio in r.get("worth", {}).items() if ratio >= MIN_LOSS_RATIO]


def covered_values(r: Record) -> list[tuple[str, bool]]:
    """(effect, whether its interval contains the true value) for each value of a correctly named effect."""
    rows = []
    for effect in r["effects"]:
        parts = members(effect["name"]) if effect["name"] in EFFECTS else ()
        truths = [r["truth"][n] for n in parts if n in r["truth"]]
        if len(truths) != len(parts) or (len(truths) == 2 and truths[0] != truths[1]):
            continue
        rows += [(effect["name"], low <= truths[0][name] <= high)
                 for name, (_, low, high) in effect["values"].items() if name in truths[0]]
    return rows


def closed_fraction(r: Record) -> float | None:
    """Reduction of the held-out 5 s position error relative to that by the oracle; None if the latter is too small."""
    p = r.get("position", {})
    if "oracle" not in p or p["base"] - p["oracle"] < max(CLOSABLE[0], CLOSABLE[1] * p["base"]):
        return None
    return (p["base"] - p["found"]) / (p["base"] - p["oracle"])


def is_worse(r: Record) -> bool:
    return r["position"]["found"] > WORSE * r["position"]["base"]


def is_reported(r: Record) -> bool:
    """Block E: whether the error is reported as varying, unknown or unexplained, and nothing false is stated."""
    reported = bool(r["varying"]) or r["outcome"] in ("varying", "unknown") or r.get("unexplained", False)
    return reported and not list_false({**r, "hidden": []})


def predicted_powers(records: Iterable[Record]) -> list[tuple[str, float, bool]]:
    """(effect, predicted power for the hidden size, whether it was found) for cases with a power analysis."""
    pairs = []
    for r in records:
        for name in r["hidden"]:
            predicted = predicted_power(r, name)
            if predicted is not None:
                pairs.append((name, predicted, is_stated(r, name)))
    return pairs


def predicted_power(r: Record, name: str) -> float | None:
    """Predicted power for the true size of a hidden effect, interpolated over the logarithm of the size."""
    rows = [(p, abs(size), found) for e, p, size, found in r.get("powers", ()) if e == name]
    truth = r["truth"].get(name)
    if not rows or truth is None or rows[0][0] not in truth:
        return None
    parameter = next(p for p in EFFECTS[name].parameters if p.name == rows[0][0])
    size = abs(truth[parameter.name] - parameter.null)
    sizes, found = zip(*sorted((s, f) for p, s, f in rows if p == parameter.name), strict=True)
    return float(np.interp(math.log(max(size, 1e-12)), np.log(sizes), found))


def budget_errors(r: Record) -> list[float]:
    """Absolute errors of the estimated error contributions, each part added last."""
    return [abs(r["budget"].get(part, [0.0])[0] - last) for part, (last, _) in r.get("shares", {}).items()]


def share_of(cases: Iterable[bool]) -> Record:
    """Number and fraction of the true values, with the interval of the fraction."""
    hits = list(cases)
    low, high = wilson(sum(hits), len(hits))
    return {"hits": sum(hits), "of": len(hits), "share": sum(hits) / len(hits) if hits else None, "low": low,
            "high": high}


def value_of(values: Iterable[float | None], reduce: Callable[[Sequence[float]], float] = np.mean) -> Record:
    given = [v for v in values if v is not None]
    return {"of": len(given), "value": float(reduce(given)) if given else None}


def score_rows(records: Sequence[Record]) -> list[Record]:
    """All scores as dicts with name, required, goal, and hits, of, share, low, high or value."""
    return [{"name": name, "required": required, "goal": goal, **result}
            for name, required, goal, result in _score_blocks(records)]


def _score_blocks(records: Sequence[Record]) -> Iterator[Row]:
    blocks: dict[str, list[Record]] = defaultdict(list)
    for r in records:
        blocks[r["block"]].append(r)
    yield from _score_found_effects([*blocks["A"], *blocks["B"]], "")
    yield from _score_healthy(blocks["C"], "")
    yield from _score_with_reference(blocks["D"])
    relevant = [r for r in blocks["E"] if r.get("loss_ratio", 0.0) >= MIN_HIDDEN_LOSS_RATIO]
    yield ("E: reported as varying or unknown, not named", "80 %", "92 %", share_of(map(is_reported, relevant)))
    for kind in ("place", "time", "unknown"):
        yield (f"  {kind}", "", "", share_of(is_reported(r) for r in relevant if r["kind"] == kind))
    yield from _score_edits(blocks["F"])
    away = {b: [r for r in blocks[b] if r["plant"] != LEAF] for b in "ABC"}
    yield from _score_found_effects([*away["A"], *away["B"]], "multi-body, ")
    yield from _score_healthy(away["C"], "multi-body, ")
    yield ("suggested drive settles the case", "60 %", "85 %",
           share_of(r["settled"] for r in records if "settled" in r))
    judged = [r for r in (*blocks["A"], *blocks["B"]) if r.get("shares")]
    yield ("error budget against truth, mean difference", "≤ 12 %", "≤ 6 %",
           {**value_of([m for r in judged for m in budget_errors(r)]), "percent": True})
    yield ("power analysis: predicted power against measured, mean difference", "≤ 12 %", "≤ 6 %",
           {**_power_error([*blocks["A"], *blocks["B"]]), "percent": True})
    everything = [r["cpu_s"] for r in records if "cpu_s" in r]
    yield ("processor time of discover per case [s], median", "≤ 20", "≤ 5", value_of(everything, np.median))
    yield ("processor time of discover per case [s], largest", "≤ 20", "≤ 5", value_of(everything, np.max))
    yield ("exceptions", "0", "0", share_of(r["outcome"] == "error" for r in records))


def _score_found_effects(rows: list[Record], prefix: str) -> Iterator[Row]:
    """Rows of blocks A and B. prefix: of their names."""
    slack = "within 6 points of " if prefix else ""
    yield (f"{prefix}A and B: relevant effects stated, alone or with alternatives", slack + "90 %", "97 %",
           share_of(is_stated(r, n) for r in rows for n in relevant_effects(r)))
    yield (f"{prefix}A and B: false statements", slack + "≤ 4 %", "≤ 1 %",
           share_of([is_false(r, e) for r in rows for e in r["effects"]]))
    yield (f"{prefix}A and B: mean number of effects per statement", "≤ 1.6", "≤ 1.25",
           value_of([len(g) for r in rows for g in list_statements(r)]))
    yield (f"{prefix}A and B: values inside their 95 % interval", slack + "85 %", "92 %",
           share_of([inside for r in rows for _, inside in covered_values(r)]))
    fractions = [closed_fraction(r) for r in rows]
    for name, q, required, goal in (("median", 0.5, "92 %", "98 %"), ("10th percentile", 0.1, "75 %", "90 %")):
        yield (f"{prefix}A and B: held-out 5 s position error reduced, relative to the oracle, {name}",
               slack + required, goal, {**value_of(fractions, lambda v, q=q: np.quantile(v, q)), "percent": True})
    yield (f"{prefix}A and B: held-out error increased", "≤ 1 %", "0",
           share_of(is_worse(r) for r in rows if "position" in r))


def _score_healthy(rows: list[Record], prefix: str) -> Iterator[Row]:
    base = [r for r in rows if r["kind"] == "base"]
    identified = [r for r in rows if r["kind"] == "identified"]
    yield (f"{prefix}C: false statements", "≤ 3 %", "≤ 1 %",
           share_of([*(bool(r["effects"]) for r in base), *(bool(list_false(r)) for r in identified)]))
    yield (f"  {prefix}car equal to the base model: anything stated", "", "",
           share_of(bool(r["effects"]) for r in base))
    yield (f"  {prefix}file identified: false statements", "", "", share_of(bool(list_false(r)) for r in identified))
    yield (f"  {prefix}file identified: anything stated", "", "",
           share_of(bool(r["effects"]) for r in identified))
    yield (f"  {prefix}C: held-out error increased", "≤ 1 %", "0",
           share_of(is_worse(r) for r in rows if "position" in r))


def _score_with_reference(rows: list[Record]) -> Iterator[Row]:
    single = [r for r in rows if r["kind"] == "one" and "detectability" in r]
    for level, required, goal in (("strong", "95 %", "98 %"), ("medium", "85 %", "94 %"), ("weak", "70 %", "85 %")):
        yield (f"D: exact name, {level}, with v_y", required, goal, share_of(
            is_exact(r) for r in single if r["with_vy"] and stratum(r["detectability"]) == level))
    yield ("  exact name, strong and medium, without v_y", "", "", share_of(
        is_exact(r) for r in single if not r["with_vy"] and stratum(r["detectability"]) in ("strong", "medium")))
    healthy = [r for r in rows if r["kind"] == "healthy"]
    for name, shifted, required, goal in (("same", False, "≤ 2 %", "≤ 1 %"), ("shifted", True, "≤ 4 %", "≤ 2 %")):
        yield (f"D: alarms, {name} conditions", required, goal, share_of(
            r["outcome"] not in ("none", "not_testable") for r in healthy if r["shifted"] == shifted))
    yield ("  D: held-out error increased", "≤ 1 %", "0",
           share_of(is_worse(r) for r in rows if "position" in r))


def _score_edits(rows: list[Record]) -> Iterator[Row]:
    plain = next((r for r in rows if r["index"] < 0), None)
    compared = [] if plain is None else [compare_edit(plain, r) for r in rows if r["index"] >= 0]
    yield ("F: the edited value changes by the edit, and no other changes, within their intervals", "90 %", "96 %",
           share_of([e.moved and not e.others for e in compared]))
    yield ("  the edited value changes by the edit", "", "", share_of([e.moved for e in compared]))
    yield ("  no other value changes", "", "", share_of([not e.others for e in compared]))


def _power_error(rows: Iterable[Record]) -> Record:
    """Mean, over the effects, of the difference between mean predicted power and fraction of cases that state them."""
    by: dict[str, list[tuple[float, bool]]] = defaultdict(list)
    for name, predicted, found in predicted_powers(rows):
        by[name].append((predicted, found))
    return value_of([abs(float(np.mean([p for p, _ in v])) - float(np.mean([f for _, f in v])))
                     for v in by.values() if len(v) >= MIN_CASES])


def format_result(row: Record) -> str:
    """Formats the value of a row of scores."""
    if row.get("of") == 0:
        return "no cases"
    if "hits" in row:
        low, high = 100 * row["low"], 100 * row["high"]
        return f"{100 * row['share']:.1f} % ({row['hits']}/{row['of']}; {low:.1f} to {high:.1f})"
    if row.get("percent"):
        return f"{100 * row['value']:.1f} % (of {row['of']})"
    return f"{row['value']:.2f} (of {row['of']})"


def as_text(rows: Sequence[Record]) -> str:
    return "\n".join(f"{r['name']:86s} {format_result(r):34s} {r['required']:>24s} / {r['goal']}" for r in rows)
