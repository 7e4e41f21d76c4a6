"""Scores of blocks L, M and N from their records, and their part of docs/measurements/proposals.md."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from st_core.effects import get_effect
from st_core.relations.candidates import ALL_TERMS, split_name
from st_recordings.paths import project_root

from .._cases import Record, wilson
from .._pages import format_table, replace_part
from ..discovery.effects import SCATTER
from ..discovery.evaluation import plant_differences
from ..plants.record import LEAF
from .cases import COUNTS
from .hidden import BY_NAME

PAGE = project_root() / "docs" / "measurements" / "proposals.md"
WORSE = 1.02  # ratio of the position errors with and without a relation above which the relation is worse
CLOSABLE = 0.02, 0.1
"""Minimum unexplained error for the fraction removed: [m], and relative to the error with the library."""
DURATION = 300.0  # s of driving to which the processor time is scaled


def judge(r: Record) -> Record:
    """The record, and what is right in its answer.

    noticed: an unexplained error is reported, without which there is no search for a relation. places: of the proposed
    relation and of its alternatives. unexplained: error with the library minus that of the oracle [m], None without an
    oracle. wrong: effects of the library stated without alternatives that are neither in the car nor in a slot of the
    relation; not_redundant: those of them that the proposal does not declare redundant.
    """
    relation, hidden, position = r["law"], BY_NAME.get(r["hidden"]), r["position"]
    places, place_right, slot_right, shape_right, wrong = [], False, False, False, []
    if relation:
        places = list(dict.fromkeys([relation["place"], *(split_name(name)[0] for name in relation["others"])]))
    if hidden:
        true = {*plant_differences(r["plant"]), *SCATTER}
        wrong = [n for n in r["alone"] if n not in true and get_effect(n).slot not in hidden.slots]
        place_right, slot_right = places[:1] and places[0] in hidden.places, bool(set(places) & set(hidden.places))
        shape_right = relation and relation["shape"] in hidden.shapes
    unexplained = position["found"] - position["oracle"] if "oracle" in position else None
    return r | {
        "noticed": r["searched"], "proposed_or_unknown": bool(relation) or r["outcome"] == "unknown", "places": places,
        "place_right": bool(place_right), "slot_right": slot_right, "shape_right": bool(shape_right),
        "has_shape": bool(place_right and hidden.shapes), "unexplained": unexplained,
        "closable": unexplained is not None and unexplained > max(CLOSABLE[0], CLOSABLE[1] * position["found"]),
        "worse": position["proposed"] > WORSE * position["found"], "wrong": wrong,
        "not_redundant": [name for name in wrong if name not in r.get("redundant", ())],
        "time": sum(r["seconds"]) * DURATION / r["driven"]}


def format_share(records: Iterable[Record], key: str) -> str:
    """Number and fraction of the records in which `key` is true or not empty, with the interval of the fraction."""
    values = [bool(r[key]) for r in records]
    if not values:
        return "no cases"
    low, high = wilson(sum(values), len(values))
    return f"{sum(values)} of {len(values)}, {sum(values) / len(values):.0%} [{low:.0%}, {high:.0%}]"


def format_closed(records: Sequence[Record], method: Callable[[Record], float]) -> str:
    """Median and 10th percentile of the fraction of the unexplained error that a method removes; 0 without a proposal.

    method: position error with it [m].
    """
    closed = [(r["position"]["found"] - method(r)) / r["unexplained"] for r in records if r["closable"]]
    if not closed:
        return "no cases"
    return f"{np.median(closed):.0%} / {np.quantile(closed, 0.1):.0%} ({len(closed)} cases)"


def score_rows(records: Sequence[Record]) -> list[tuple[str, ...]]:
    """(score, measured, required, goal)."""
    judged = [judge(r) for r in records]
    hidden, nothing = [r for r in judged if r["block"] in "LM"], [r for r in judged if r["block"] == "N"]
    proposed, closable = [r for r in hidden if r["law"]], [r for r in hidden if r["closable"]]
    alarms, times = sum(r["law"] is not None for r in nothing), [r["time"] for r in judged]
    counts = [len(r["places"]) for r in proposed]
    rows: list[tuple[str, ...]] = [
        ("noticed (reported as missing)", format_share(hidden, "noticed"), "85 %", "95 %"),
        ("... by a proposal, or as the outcome *unknown*", format_share(hidden, "proposed_or_unknown")),
        ("... where the library leaves an error", format_share(closable, "noticed")),
        ("... on the virtual Leaf, where nothing else is missing",
         format_share([r for r in hidden if r["plant"] == LEAF], "noticed")),
        ("proposals with the correct slot, alone or among alternatives", format_share(proposed, "slot_right"), "80 %",
         "90 %"),
        ("... the place of the proposal itself", format_share(proposed, "place_right")),
        ("... where the library leaves an error", format_share([r for r in closable if r["law"]], "slot_right")),
        (f"... places named, of {len(ALL_TERMS)}: median / largest",
         f"{np.median(counts):g} / {max(counts)}" if counts else "no cases"),
        ("unexplained error removed, relative to the oracle, median / 10th percentile",
         format_closed(hidden, lambda r: r["position"]["proposed"]), "70 / 40 %", "90 / 60 %"),
        ("proposals that increase the held-out error", format_share(proposed, "worse"), "1 %", "0"),
        ("proposal without a hidden relation", f"{alarms} of {len(nothing)}", "1 of 60", "0"),
        ("... reported as missing", f"{sum(r['noticed'] for r in nothing)} of {len(nothing)}"),
        ("a wrong effect of the library stated alone", format_share(hidden, "not_redundant"), "5 %", "2 %"),
        ("... before the corrections of the proposal", format_share(hidden, "wrong")),
        ("first formula of the correct shape, if the place is correct",
         format_share([r for r in proposed if r["has_shape"]], "shape_right"), "60 %", "80 %"),
        ("time, 5 minutes of driving, one core, median / largest",
         f"{np.median(times):.0f} / {max(times):.0f} s" if times else "no cases", "90 s", "30 s"),
    ]
    return [(*row, *[""] * (4 - len(row))) for row in rows]


def method_rows(records: Sequence[Record]) -> list[tuple[str, str, str, str]]:
    """(method, unexplained error removed, error increased, names) for the cases with all methods."""
    judged = [judge(r) for r in records if r.get("baselines")]

    def row(name: str, method: Callable[[Record], float], names: str) -> tuple[str, str, str, str]:
        worse = [{"worse": method(r) > WORSE * r["position"]["found"]} for r in judged]
        return name, format_closed(judged, method), format_share(worse, "worse"), names

    in_slot = [{"right": {get_effect(n).slot for n in r["baselines"]["regression_names"]}
                & set(BY_NAME[r["hidden"]].slots)} for r in judged]
    inputs = [name for r in judged for name in r["baselines"]["process_names"]]
    most = max(set(inputs), key=inputs.count) if inputs else "-"
    proposals = format_share([r for r in judged if r["law"]], "slot_right")
    return [
        row("proposal, or none", lambda r: r["position"]["proposed"], f"a relation; slot right in {proposals}"),
        row("sparse regression of residual accelerations", lambda r: r["baselines"]["regression"],
            f"its largest term; a name related to it acts in the slot in {format_share(in_slot, 'right')}"),
        row("Gaussian process on residual accelerations", lambda r: r["baselines"]["process"],
            f"nothing; its shortest length scale is most often that of the {most} "
            f"({inputs.count(most)} of {len(inputs)})")]


def write(records: Sequence[Record]) -> None:
    """Writes scores, other methods, relations and wrong answers to the page."""
    sets, versions = (", ".join(sorted({r[key] for r in records})) for key in ("set", "version"))
    counts = ", ".join(f"{sum(r['block'] == b for r in records)} of {n} {b}" for b, n in COUNTS.items())
    warning = ("" if sets.startswith("sealed") else
               " **Development cases: they were known during the development of the method.**")
    parts = [
        f"\nSet: {sets}. Version {versions}. Cases: {counts} (L: relations not in the library, M: an effect removed "
        f"from the library, N: no hidden relation).{warning} In brackets: 95 % Wilson interval.",
        format_table(("score", "measured", "required", "goal"), score_rows(records))]
    if any(r.get("baselines") for r in records):
        parts += ["Other methods on the same cases, starting from the same answer of `st discover`, simulated the same "
                  "way:", format_table(("method", "unexplained error removed, median / 10th percentile",
                                        "error increased", "names"), method_rows(records))]
    parts += [
        "By relation; position after 5 s on held-out drives, mean over the cases, m:",
        format_table(("hidden", "cases", "noticed", "slot right", "vehicle file", "library", "with the proposal",
                      "oracle"), relation_rows(records)),
        "Wrong answers by case:",
        format_table(("case", "hidden", "answer", "wrong"), failure_rows(records) or [("-",) * 4])]
    replace_part(PAGE, "scores", "\n\n".join(parts) + "\n")


def relation_rows(records: Sequence[Record]) -> list[tuple[str, ...]]:
    lines = []
    for name in [*BY_NAME, "nothing"]:
        rows = [judge(r) for r in records if r["hidden"] == name]
        if rows:
            right = [r["slot_right"] for r in rows if r["law"]]
            errors = ([r["position"][key] for r in rows if key in r["position"]]
                      for key in ("base", "found", "proposed", "oracle"))
            lines.append((name, str(len(rows)), str(sum(r["noticed"] for r in rows)),
                          "-" if name == "nothing" else f"{sum(right)} of {len(right)}",
                          *(f"{sum(values) / len(values):.2f}" if values else "-" for values in errors)))
    return lines


def failure_rows(records: Sequence[Record]) -> list[tuple[str, ...]]:
    rows = []
    for r in sorted(map(judge, records), key=lambda r: (r["block"], r["index"])):
        if wrong := list_failures(r):
            relation, answer = r["law"], f"{r['outcome']}, no proposal"
            if relation:
                factor = f" * {relation['by']}" if relation["by"] else ""
                answer = f"{relation['place']}({relation['quantity']}){factor}, {relation['reads']}"
            rows.append((f"{r['block']} {r['index']}", f"{r['plant']}: {r['hidden']} x {r['scale']:g}", answer,
                         "; ".join(wrong)))
    return rows


def list_failures(r: Record) -> list[str]:
    """Errors of a judged answer; empty for a correct one."""
    if r["block"] == "N":
        return ["a proposal without a hidden relation"] if r["law"] else []
    # Without an oracle it is unknown whether there is an error to notice.
    wrong = ["not noticed"] if (r["unexplained"] is None or r["closable"]) and not r["noticed"] else []
    if r["law"]:
        wrong += [] if r["slot_right"] else ["another slot"]
        wrong += ["error increased"] if r["worse"] else []
        if r["has_shape"] and not r["shape_right"]:
            wrong.append(f"shape read as {r['law']['shape'] or 'none'}")
    return [*wrong, *([f"stated alone: {', '.join(r['not_redundant'])}"] if r["not_redundant"] else [])]
