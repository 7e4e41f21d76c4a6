"""Computes the scores of blocks L, M and N from their records."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from st_core.effects import get_effect
from st_core.relations.candidates import ALL_TERMS, split_name

from .._cases import Record, wilson
from ..discovery.effects import SCATTER
from ..discovery.evaluation import plant_differences
from ..plants.record import LEAF
from .hidden import BY_NAME, Hidden

WORSE = 1.02  # ratio of the position errors with and without a relation above which the relation is worse
CLOSABLE = 0.02, 0.1
"""Minimum unexplained error for the fraction removed: [m], and relative to the error with the library."""
DURATION = 300.0  # s of driving to which the processor time is scaled


def hidden_of(r: Record) -> Hidden:
    return BY_NAME[r["hidden"]]


def unexplained_error(r: Record) -> float:
    """Error with the library minus that of the oracle [m]."""
    return r["position"]["found"] - r["position"]["oracle"]


def is_closable(r: Record) -> bool:
    minimum, fraction = CLOSABLE
    return unexplained_error(r) > max(minimum, fraction * r["position"]["found"])


def is_noticed(r: Record) -> bool:
    """Whether the answer reports an unexplained error, without which there is no search for a relation."""
    return r["searched"]


def is_proposed_or_unknown(r: Record) -> bool:
    """Whether the answer proposes a relation, or its outcome is *unknown*."""
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
    """Effects of the library stated without alternatives that are neither in the car nor in a slot of the relation."""
    true = {*plant_differences(r["plant"]), *SCATTER}
    return [n for n in r["alone"] if n not in true and get_effect(n).slot not in hidden_of(r).slots]


def list_wrong_effects(r: Record) -> list[str]:
    """Those of them that the proposal does not declare redundant."""
    return [n for n in list_wrong_effects_by_library(r) if n not in r.get("redundant", ())]


def is_shape_right(r: Record) -> bool:
    return r["law"]["shape"] in hidden_of(r).shapes


def seconds(r: Record) -> float:
    """Processor time for DURATION of driving [s]."""
    return sum(r["seconds"]) * DURATION / r["driven"]


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


def score_rows(records: Sequence[Record]) -> list[tuple[str, ...]]:
    """(score, measured, required, goal)."""
    hidden = [r for r in records if r["block"] in "LM"]
    proposed, nothing = [r for r in hidden if r["law"]], [r for r in records if r["block"] == "N"]
    closable = [r for r in hidden if "oracle" in r["position"] and is_closable(r)]
    shaped = [r for r in proposed if is_place_right(r) and hidden_of(r).shapes]
    times = [seconds(r) for r in records]
    alarms = sum(r["law"] is not None for r in nothing)
    rows: list[tuple[str, ...]] = [
        ("noticed (reported as missing)", format_ratio(map(is_noticed, hidden)), "85 %", "95 %"),
        ("... by a proposal, or as the outcome *unknown*", format_ratio(map(is_proposed_or_unknown, hidden))),
        ("... where the library leaves an error", format_ratio(map(is_noticed, closable))),
        ("... on the virtual Leaf, where nothing else is missing",
         format_ratio(is_noticed(r) for r in hidden if r["plant"] == LEAF)),
        ("proposals with the correct slot, alone or among alternatives",
         format_ratio(map(is_slot_right, proposed)), "80 %", "90 %"),
        ("... the place of the proposal itself", format_ratio(map(is_place_right, proposed))),
        ("... where the library leaves an error", format_ratio(is_slot_right(r) for r in closable if r["law"])),
        (f"... places named, of {len(ALL_TERMS)}: median / largest",
         format_counts(len(list_places(r)) for r in proposed)),
        ("unexplained error removed, relative to the oracle, median / 10th percentile",
         format_spread([closed_fraction(r) for r in closable]), "70 / 40 %", "90 / 60 %"),
        ("proposals that increase the held-out error", format_ratio(map(is_worse, proposed)), "1 %", "0"),
        ("proposal without a hidden relation", f"{alarms} of {len(nothing)}", "1 of 60", "0"),
        ("... reported as missing", f"{sum(map(is_noticed, nothing))} of {len(nothing)}"),
        ("a wrong effect of the library stated alone",
         format_ratio(bool(list_wrong_effects(r)) for r in hidden), "5 %", "2 %"),
        ("... before the corrections of the proposal",
         format_ratio(bool(list_wrong_effects_by_library(r)) for r in hidden)),
        ("first formula of the correct shape, if the place is correct",
         format_ratio(map(is_shape_right, shaped)), "60 %", "80 %"),
        ("time, 5 minutes of driving, one core, median / largest",
         f"{np.median(times):.0f} / {max(times):.0f} s"
         if times else "no cases", "90 s", "30 s"),
    ]
    return [(*row, *[""] * (4 - len(row))) for row in rows]


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
