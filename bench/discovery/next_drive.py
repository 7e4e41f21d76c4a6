"""The next drive suggested by a discovery, driven by the same car; then the discovery repeated with it."""

from collections.abc import Mapping
from typing import Any

from st_core.discovery import Discovery, DiscoverySettings, discover

from . import programmes as m
from .cases import Case
from .drives import Drives, record_more
from .plants import Order
from .score import relevant_effects, stratum


def try_suggestion(case: Case, drives: Drives, found: Discovery, settings: DiscoverySettings,
                   record: Mapping[str, Any]) -> dict[str, Any]:
    """Whether the suggested drive settles what was hidden: then it is stated by its own name alone.

    For cases with one hidden effect that matters, which is not yet settled, and with a suggested drive. record: of the
    case so far.
    """
    suggested = found.next_manoeuvre
    visible = relevant_effects(record) or stratum(record.get("detectability", 0.0)) != "invisible"
    if case.kind != "one" or not visible or _is_settled(case, found) or suggested is None:
        return {}
    part = m.suggested_part(suggested.name)
    orders = [Order(f"next_{i + 1}", (case.seed, 300 + i), case.settings, (part,)) for i in range(suggested.times)]
    runs = record_more(case, drives.vehicle, orders)
    again = discover((*drives.suspect, *runs), drives.vehicle, "nonlinear", drives.reference, settings)
    return {"suggested": suggested.name, "separates": list(suggested.separates), "settled": _is_settled(case, again),
            "again": [[e.name, *e.alternatives] for e in again.effects]}


def _is_settled(case: Case, found: Discovery) -> bool:
    return any(e.name == case.hidden[0] and not e.alternatives for e in found.effects)
