"""Computes the scores of blocks L, M and N from their records."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from st_core.effects import get_effect
from st_core.relations.candidates import ALL_TERMS, split_name

from .cars import LEAF
from .effects import SCATTER
from .hidden_relations import BY_NAME, Hidden
from .judge import plant_differences
from .score import wilson

Record = dict[str, Any]
WORSE = 1.02  # ratio of the position errors with and without a relation above which the relation is worse
CLOSABLE = 0.02, 0.1
"""Minimum gain of the oracle for a meaningful fraction of it: [m], and relative to the error with the library."""
DURATION = 300.0  # s of driving for which the processor time is reported


def hidden_of(r: Record) -> Hidden:
    return BY_NAME[r["hidden"]]


def unexplained_error(r: Record) -> float:
    """Error with the library minus that of the oracle [m]."""
    return r["position"]["found"] - r["position"]["oracle"]


def is_closable(r: Record) -> bool:
    least, fraction = CLOSABLE
    return unexplained_error(r) > max(least, fraction * r["position"]["found"])


def is_noticed(r: Record) -> bool:
    """Whether the answer reports an error that no effect of the library explains; only then a relation is searched."""
    return r["searched"]


def is_proposed_or_unknown(r: Record) -> bool:
    """Whether the answer has a relation, or its outcome is unknown."""
    return r["law"] is not None or r["outcome"] == "unknown"


def is_place_right(r: Record) -> bool:
    return r["law"]["place"] in hidden_of(r).places


def is_slot_right(r: Record) -> bool:
    """Whether the place of the relation, or of one of its alternatives, is correct."""
    return bool(set(list_places(r)) & set(hidden_of(r).places))


def closed_fraction(r: Record, after: float | None = None) -> float:
    """Fraction of the unexplained error that the proposal removes; 0 without a proposal."""
    return (r["position"]["found"] - (r["position"]["proposed"] if after is None else after)) / unexplained_error(r)


def is_worse(r: Record) -> bool:
    return r["position"]["proposed"] > WORSE * r["position"]["found"]


def list_places(r: Record) -> list[str]:
    """Places of the proposed relation and of its alternatives."""
    return list(dict.fromkeys([r["law"]["place"], *(split_name(name)[0] for name in r["law"]["others"])]))


def list_wrong_effects_by_library(r: Record) -> list[str]:
    """Effects of the library that are stated alone, but are neither in the car nor in a slot of the relation."""
    true = {*plant_differences(r["plant"]), *SCATTER}
    return [n for n in r["alone"] if n not in true and get_effect(n).slot not in hidden_of(r).slots]


def list_wrong_effects(r: Record) -> list[str]:
    """Wrong effects stated alone that the proposal does not declare redundant."""
    return [n for n in list_wrong_effects_by_library(r) if n not in r.get("redundant", ())]


def is_shape_right(r: Record) -> bool:
    return r["law"]["shape"] in hidden_of(r).shapes


def seconds(r: Record) -> float:
    """Processor time for DURATION of driving [s]."""
    return sum(r["seconds"]) * DURATION / r["driven"]


def make_row(name: str, measured: str, required: str = "", goal: str = "") -> tuple[str, str, str, str]:
    return name, measured, required, goal


def format_ratio(hits: Iterable[bool]) -> str:
    values = list(hits)
    if not values:
        return "no cases"
    low, high = wilson(sum(values), len(values))
    return f"{sum(values)} of {len(values)}, {sum(values) / len(values):.0%} [{low:.0%}, {high:.0%}]"


def format_counts(numbers: Iterable[int]) -> str:
    values = list(numbers)
    return f"{np.median(values):g} / {max(values)}" if values else "no cases"


def format_spread(values: Sequence[float]) -> str:
    """Formats median and 10th percentile of fractions."""
    if not len(values):
        return "no cases"
    return f"{np.median(values):.0%} / {np.quantile(values, 0.1):.0%} ({len(values)} cases)"


def score_rows(records: Sequence[Record]) -> list[tuple[str, str, str, str]]:
    """(score, measured, required, goal)."""
    hidden = [r for r in records if r["block"] in "LM"]
    proposed, nothing = [r for r in hidden if r["law"]], [r for r in records if r["block"] == "N"]
    matter = [r for r in hidden if "oracle" in r["position"] and is_closable(r)]
    shaped = [r for r in proposed if is_place_right(r) and hidden_of(r).shapes]
    times = [seconds(r) for r in records]
    alarms = sum(r["law"] is not None for r in nothing)
    return [
        make_row("noticed (reported as missing)", format_ratio(map(is_noticed, hidden)), "85 %", "95 %"),
        make_row("... by a proposal, or as the outcome *unknown*", format_ratio(map(is_proposed_or_unknown, hidden))),
        make_row("... where the library leaves an error", format_ratio(map(is_noticed, matter))),
        make_row("... on the virtual Leaf, where nothing else is missing",
                 format_ratio(is_noticed(r) for r in hidden if r["plant"] == LEAF)),
        make_row("proposals with the correct slot, alone or among alternatives",
                 format_ratio(map(is_slot_right, proposed)), "80 %", "90 %"),
        make_row("... the place of the proposal itself", format_ratio(map(is_place_right, proposed))),
        make_row("... where the library leaves an error", format_ratio(is_slot_right(r) for r in matter if r["law"])),
        make_row(f"... places named, of {len(ALL_TERMS)}: median / largest",
                 format_counts(len(list_places(r)) for r in proposed)),
        make_row("unexplained error removed, relative to the oracle, median / 10th percentile",
                 format_spread([closed_fraction(r) for r in matter]), "70 / 40 %", "90 / 60 %"),
        make_row("held-out error increased, of proposals", format_ratio(map(is_worse, proposed)), "1 %", "0"),
        make_row("proposal without a hidden relation", f"{alarms} of {len(nothing)}", "1 of 60", "0"),
        make_row("... reported as missing", f"{sum(map(is_noticed, nothing))} of {len(nothing)}"),
        make_row("a wrong effect of the library stated alone",
                 format_ratio(bool(list_wrong_effects(r)) for r in hidden), "5 %", "2 %"),
        make_row("... before the corrections of the proposal",
                 format_ratio(bool(list_wrong_effects_by_library(r)) for r in hidden)),
        make_row("first formula of the correct shape, if the place is correct",
                 format_ratio(map(is_shape_right, shaped)), "60 %", "80 %"),
        make_row("time, 5 minutes of driving, one core, median / largest",
                 f"{np.median(times):.0f} / {max(times):.0f} s"
                 if times else "no cases", "90 s", "30 s"),
    ]


def method_rows(records: Sequence[Record]) -> list[tuple[str, str, str, str]]:
    """(method, unexplained error removed, error increased, names) for the cases with all methods."""
    given = [r for r in records if r.get("baselines") and is_closable(r)]
    everywhere = [r for r in records if r.get("baselines")]

    def one(name: str, after: Callable[[Record], float], names: str) -> tuple[str, str, str, str]:
        worse = format_ratio(after(r) > WORSE * r["position"]["found"] for r in everywhere)
        return name, format_spread([closed_fraction(r, after(r)) for r in given]), worse, names

    def regressed(r: Record) -> bool:
        return bool({get_effect(n).slot for n in r["baselines"]["regression_names"]} & set(hidden_of(r).slots))

    inputs = [name for r in everywhere for name in r["baselines"]["process_names"]]
    most = max(set(inputs), key=inputs.count) if inputs else "-"
    return [
        one("proposal, or none", lambda r: r["position"]["proposed"],
            "a relation; slot right in " + format_ratio(map(is_slot_right, [r for r in everywhere if r["law"]]))),
        one("sparse regression of residual accelerations", lambda r: r["baselines"]["regression"],
            f"its largest term; a name related to it acts in the slot in {format_ratio(map(regressed, everywhere))}"),
        one("Gaussian process on residual accelerations", lambda r: r["baselines"]["process"],
            f"nothing; its shortest length scale is most often that of the {most} "
            f"({inputs.count(most)} of {len(inputs)})"),
    ]
