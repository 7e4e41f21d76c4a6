"""Records the next drive that a discovery suggests, with the same car, and repeats the discovery with it."""

from collections.abc import Mapping
from typing import Any

from st_core.discovery import Discovery, DiscoverySettings, discover

from . import programmes
from .cases import Case
from .drives import Drives, record_more
from .plants import RunPlan
from .score import relevant_effects, stratum


def try_suggestion(case: Case, drives: Drives, found: Discovery, settings: DiscoverySettings,
                   record: Mapping[str, Any]) -> dict[str, Any]:
    """Result with the suggested drive; the case is settled if the hidden effect is now stated without alternatives.

    {} unless the case has one relevant hidden effect, is not yet settled, and has a suggested drive.
    record: the record of the case without this result.
    """
    suggested = found.next_manoeuvre
    visible = relevant_effects(record) or stratum(record.get("detectability", 0.0)) != "invisible"
    if case.kind != "one" or not visible or _is_settled(case, found) or suggested is None:
        return {}
    part = programmes.suggested_part(suggested.name)
    plans = [RunPlan(f"next_{i + 1}", (case.seed, 300 + i), case.settings, (part,))
             for i in range(suggested.repetitions)]
    runs = record_more(case, drives.vehicle, plans)
    again = discover((*drives.suspect, *runs), drives.vehicle, "nonlinear", drives.reference, settings)
    return {"suggested": suggested.name, "separates": list(suggested.separates), "settled": _is_settled(case, again),
            "again": [[e.name, *e.alternatives] for e in again.effects]}


def _is_settled(case: Case, found: Discovery) -> bool:
    return any(e.name == case.hidden[0] and not e.alternatives for e in found.effects)
