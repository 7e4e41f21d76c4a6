"""The drive a discovery asks for, driven with the hidden effect; then the question again with it added."""

from typing import Any

from st_core.discovery import Discovery, DiscoverySettings, discover

from . import manoeuvres as m
from .cases import NOMINAL, Case, Drives, driven, without_vy

# Scenario of st_sim -> what is driven here; lateral acceleration [m/s^2] as st_sim drives it.
_PARTS = {
    "sweep": (m.sweep, 3.5), "step": (m.steps, 4.0), "lane_change": (m.slalom, 4.0),
    "ramp_to_limit": (m.ramp_to_limit, 12.0), "brake_in_turn": (m.brake_in_turn, 4.0), "weave": (m.weave, 0.8),
    "S1": (m.ordinary, 1.4), "S2": (m.circle, 1.5), "S3": (m.circle, 3.8), "S4": (m.circle, 6.4),
    "S6": (m.ordinary, 2.5), "S7": (m.ordinary, 2.0), "circle": (m.circle, 3.0), "straight": (m.weave, 0.2),
}


def driven_again(case: Case, drives: Drives, found: Discovery, settings: DiscoverySettings) -> dict[str, Any]:
    """What comes out with the suggested drive added; no_drive: it said that none would settle it;
    empty for answers that are not ambiguous."""
    suggested = found.next_manoeuvre
    if case.kind != "single" or found.outcome != "ambiguous":
        return {}
    if suggested is None:
        return {"no_drive": True}
    part = _PARTS.get(suggested.scenario)
    if part is None:
        return {"suggested": suggested.scenario, "settled": False, "again": ["not driven: no such manoeuvre"]}
    drive, lateral = part
    part = m.Part(drive, (suggested.speed, suggested.speed), (lateral, lateral))
    # Manoeuvres are shorter here: as many of them as last as long.
    parts = (part,) * max(1, round(suggested.duration / m.duration(NOMINAL, part)))
    runs = tuple(driven(f"next_{i + 1}", drives.faulty, (case.seed, 300 + i), parts) for i in range(suggested.times))
    if not case.with_vy:
        runs = tuple(without_vy(log) for log in runs)
    again = discover((*drives.suspect, *runs), drives.vehicle, "nonlinear", drives.reference, settings)
    return {"suggested": suggested.scenario, "settled": again.outcome == "named"
            and again.effects[0].name == case.truth[0], "again": [[e.name, *e.alternatives] for e in again.effects]}
