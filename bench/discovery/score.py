"""Records to scores: shares with 95 % Wilson intervals, beside what is wanted."""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .oracle import stratum

Record = dict[str, Any]
FOUND = ("named", "ambiguous", "several", "unknown")
WORSE = 1.02
"""A held-out loss above so many times the base's is worse."""
STRONG, MEDIUM, WEAK = "strong", "medium", "weak"


def wilson(hits: int, of: int, z: float = 1.959964) -> tuple[float, float]:
    """95 % interval of a share: (p + z^2/2n +- z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n). (0, 1) for no cases.

    Source: Wilson, JASA 22 (1927). Checked by: test_discovery_score.py.
    """
    if not of:
        return 0.0, 1.0
    p, square = hits / of, z * z
    middle = p + square / (2 * of)
    half = z * math.sqrt(p * (1 - p) / of + square / (4 * of * of))
    return max(0.0, (middle - half) / (1 + square / of)), min(1.0, (middle + half) / (1 + square / of))


def is_found(r: Record) -> bool:
    return r["outcome"] in FOUND


def is_exact(r: Record) -> bool:
    """One effect, and its best name is the true one."""
    return len(r["names"]) == 1 and len(r["truth"]) == 1 and r["names"][0][0] == r["truth"][0]


def in_set(r: Record) -> bool:
    return any(name in group for group in r["names"] for name in r["truth"])


def is_wrong_name(r: Record) -> bool:
    """One name stated without an alternative, and it is not the true one."""
    return r["outcome"] == "named" and len(r["names"]) == 1 and len(r["names"][0]) == 1 and not is_exact(r)


def is_exact_pair(r: Record) -> bool:
    return sorted(group[0] for group in r["names"]) == sorted(r["truth"])


def is_untestable(r: Record) -> bool:
    return r["outcome"] in ("none", "not_testable") and r["truth"][0] in r["not_testable"]


def closed(r: Record) -> float | None:
    """Share of the oracle's gain on held-out drives; None where the oracle gains too little to speak of."""
    if r.get("detectability", 0.0) <= 0.1:
        return None
    return (r["base"] - r["found"]) / (r["base"] - r["oracle"])


def _share(rows: Sequence[Record], test: Callable[[Record], bool]) -> Record:
    hits = sum(map(test, rows))
    low, high = wilson(hits, len(rows))
    return {"hits": hits, "of": len(rows), "share": hits / len(rows) if rows else None, "low": low, "high": high}


def _values(values: Sequence[float], **quantiles: float) -> Record:
    given = [v for v in values if v is not None]
    return {"of": len(given), **{name: float(np.quantile(given, q)) if given else None
                                 for name, q in quantiles.items()}}


def scores(records: Sequence[Record]) -> Record:
    """{"counts", "scores": [{name, floor, goal, hits, of, share, low, high} ...], "baselines", "timing"}."""
    kinds = defaultdict(list)
    for r in records:
        kinds[r["kind"]].append(r)
    judged = [r for r in kinds["single"] if "detectability" in r]
    strata = defaultdict(list)
    for r in judged:
        strata[stratum(r["detectability"])].append(r)
    healthy = kinds["healthy"]
    rows: list[Record] = []

    def add(name: str, wanted: tuple[str, str], result: Record) -> None:
        rows.append({"name": name, "floor": wanted[0], "goal": wanted[1], **result})

    add("false alarm, healthy, same conditions", ("≤ 2 %", "≤ 1 %"),
        _share([r for r in healthy if not r["shifted"]], is_found))
    add("false alarm, healthy, shifted conditions", ("≤ 5 %", "≤ 2 %"),
        _share([r for r in healthy if r["shifted"]], is_found))
    for level, floor, goal in ((STRONG, "99 %", "100 %"), (MEDIUM, "97 %", "99 %"), (WEAK, "85 %", "95 %")):
        add(f"detection, {level}", (floor, goal), _share(strata[level], is_found))
    for level, floor, goal in ((STRONG, "95 %", "98 %"), (MEDIUM, "80 %", "92 %"), (WEAK, "65 %", "80 %")):
        add(f"exact name, with v_y, {level}", (floor, goal),
            _share([r for r in strata[level] if r["with_vy"]], is_exact))
    add("exact name, without v_y, strong and medium", ("80 %", "90 %"),
        _share([r for r in (*strata[STRONG], *strata[MEDIUM]) if not r["with_vy"]], is_exact))
    for level in (STRONG, MEDIUM, WEAK):
        add(f"truth in the reported set, {level}", ("≥ 93 %", "≥ 95 %"),
            _share([r for r in strata[level] if r["names"]], in_set))
    for level, floor, goal in ((STRONG, "≤ 2.0", "≤ 1.3"), (MEDIUM, "≤ 2.5", "≤ 1.6")):
        sizes = [len(r["names"][0]) for r in strata[level] if len(r["names"]) == 1]
        add(f"mean set size, {level}", (floor, goal),
            {"of": len(sizes), "value": float(np.mean(sizes)) if sizes else None})
    visible = [*strata[STRONG], *strata[MEDIUM], *strata[WEAK]]
    add("one name stated and wrong", ("≤ 3 %", "≤ 1 %"), _share(visible, is_wrong_name))
    add("suggested drive, once driven, settles it", ("≥ 60 %", "≥ 85 %"),
        _share([r for r in visible if "settled" in r], lambda r: r["settled"]))
    add("  ambiguous, and said that no drive would settle it", ("", ""),
        _share([r for r in visible if r["outcome"] == "ambiguous"], lambda r: r.get("no_drive", False)))
    gap = [r for r in kinds["unknown"] if r.get("base", 0.0) > 1.0 / 0.9]
    add("unknown effect flagged", ("≥ 50 %", "≥ 75 %"), _share(gap, lambda r: r["outcome"] == "unknown"))
    add("  of these, no effect equals it", ("", ""),
        _share([r for r in gap if r["note"] == "foreign"], lambda r: r["outcome"] == "unknown"))
    add("  of these, left out of the library", ("", ""),
        _share([r for r in gap if r["note"] == "left out"], lambda r: r["outcome"] == "unknown"))
    add("false \"unknown\"", ("≤ 5 %", "≤ 3 %"),
        _share([*kinds["single"], *healthy], lambda r: r["outcome"] == "unknown"))
    add("untestable effect answered so", ("≥ 80 %", "≥ 95 %"), _share(kinds["untestable"], is_untestable))
    both = [r for r in kinds["double"] if r.get("detectability", 0.0) > 0.1]
    add("two effects, exact pair", ("60 %", "75 %"), _share(both, is_exact_pair))
    add("  both in the reported sets", ("", ""), _share(both, lambda r: all(
        any(name in group for group in r["names"]) for name in r["truth"])))
    shares = [closed(r) for r in visible]
    add("held-out gap closed relative to the oracle, median", ("90 %", "97 %"), _values(shares, value=0.5))
    add("held-out gap closed relative to the oracle, 10th percentile", ("70 %", "85 %"), _values(shares, value=0.1))
    add("held-out made worse", ("≤ 5 %", "≤ 1 %"), _share(
        [r for r in records if "found" in r and r["kind"] != "real"], lambda r: r["found"] > WORSE * r["base"]))
    real = kinds["real"]
    add("semi-blind real drives, exact name", ("80 %", "93 %"), _share([r for r in real if r["truth"]], is_exact))
    add("semi-blind real drives, false alarm", ("≤ 5 %", "≤ 2 %"),
        _share([r for r in real if not r["truth"]], is_found))
    seconds = [r["cpu_s"] for r in records if "cpu_s" in r]
    add("CPU time of discover per case [s], median", ("≤ 60 s", "≤ 10 s"), _values(seconds, value=0.5))
    add("CPU time of discover per case [s], largest", ("≤ 60 s", "≤ 10 s"), _values(seconds, value=1.0))
    partial = kinds["partial"]
    add("effect in part of the drive: detected", ("", ""), _share(partial, is_found))
    add("effect in part of the drive: exact name", ("", ""), _share(partial, is_exact))
    add("invisible (D ≤ 0.1): something stated", ("", ""), _share(strata["invisible"], is_found))
    add("raised an error", ("0", "0"), _share(records, lambda r: r["outcome"] == "error"))
    return {"counts": {kind: len(rows) for kind, rows in kinds.items()},
            "strata": {name: len(found) for name, found in strata.items()}, "scores": rows,
            "baselines": _baselines(visible, healthy)}


def _baselines(visible: Sequence[Record], healthy: Sequence[Record]) -> list[Record]:
    """On the single effects with D > 0.1, and on the healthy cases."""
    def gap(key: str) -> Record:
        shares = [(r["base"] - r[key]) / (r["base"] - r["oracle"]) for r in visible if key in r]
        return _values(shares, median=0.5, tenth=0.1)

    def worse(key: str) -> Record:
        return _share([r for r in (*visible, *healthy) if key in r], lambda r: r[key] > WORSE * r["base"])
    regressed = [r for r in visible if "sindy_finds" in r]
    quiet = [r for r in healthy if "sindy_finds" in r]
    return [
        {"name": "no change", "gap": {"of": len(visible), "median": 0.0, "tenth": 0.0}, "worse": None, "named": None,
         "alarm": None},
        {"name": "tyres tuned again", "gap": gap("tyres"), "worse": worse("tyres"), "named": _share(
            [r for r in visible if "tyres" in r], lambda r: r["truth"][0] in ("front_stiffness", "rear_stiffness",
                                                                              "friction")), "alarm": None},
        {"name": "sparse regression of residual accelerations", "gap": None, "worse": _share(
            regressed, lambda r: r["sindy_after"] > r["sindy_before"]), "named": _share(
            regressed, lambda r: r["truth"][0] in r["sindy_group"]),
         "alarm": _share(quiet, lambda r: r["sindy_finds"])},
        {"name": "discover", "gap": gap("found"), "worse": worse("found"), "named": _share(visible, is_exact),
         "alarm": _share(healthy, is_found)},
        {"name": "oracle", "gap": gap("oracle"), "worse": worse("oracle"), "named": None, "alarm": None},
    ]


def shown(row: Record) -> str:
    """The value of a row of scores in words."""
    if row.get("of") == 0:
        return "no cases"
    if "hits" in row:
        share, low, high = (100 * row[key] for key in ("share", "low", "high"))
        return f"{share:.1f} % ({row['hits']}/{row['of']}; {low:.1f} to {high:.1f})"
    percent = row["name"].startswith("held-out gap")
    return f"{100 * row['value']:.1f} % (of {row['of']})" if percent else f"{row['value']:.2f} (of {row['of']})"


def as_text(document: Record) -> str:
    lines = [f"cases {document['counts']}, single by stratum {document['strata']}"]
    lines += [f"{r['name']:62s} {shown(r):40s} {r['floor']} / {r['goal']}" for r in document["scores"]]
    return "\n".join(lines)


def short(r: Record) -> Record:
    """What is kept of a case in the results."""
    keys = ("kind", "index", "truth", "hidden", "with_vy", "shifted", "outcome", "names", "base", "found", "oracle",
            "detectability", "tyres", "settled", "suggested", "no_drive", "cpu_s", "error")
    return {k: r[k] for k in keys if k in r}
