"""A proposed law in tables: the error of every run with it, and the values of the car with and without it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from st_core.discovery import Discovery
from st_core.proposals import Proposal
from st_core.vehicle import VehicleParameters

from . import quantities, report_text
from .vehicle_update import changed


@dataclass(frozen=True)
class Table:
    """rows: as many texts as the head has."""

    title: str
    note: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


def by_run(one: Proposal, answer: Discovery) -> Table:
    """Where the law helps and where not."""
    first: Mapping[str, tuple[float, float]] = answer.steps[0].runs if answer.steps else {}
    rows = []
    for name, (without, with_it) in sorted(one.runs.items(), key=lambda item: item[1][1] - item[1][0]):
        before = first.get(name)
        rows.append((name, *_row(before[0] if before else None, without, with_it)))
    start = answer.steps[0].position_5s.base if answer.steps else None
    rows.append(("all windows", *_row(start, *one.position_5s)))
    return Table("Mean position error after 5 s, by run, m",
                 "Every run is predicted with values fitted to other driving. The run in which the law helps most is "
                 "first; + means a larger error.",
                 ("run", answer.start, "with what is stated", "with the law as well", "change by the law"), rows)


def _row(start: float | None, without: float, with_it: float) -> tuple[str, ...]:
    change = f"{with_it - without:+.3f} ({100.0 * (with_it / max(without, 1e-9) - 1.0):+.0f} %)".replace("-", "−")
    return "-" if start is None else f"{start:.3f}", f"{without:.3f}", f"{with_it:.3f}", change


def values_beside(one: Proposal, answer: Discovery, vehicle: VehicleParameters) -> list[Table]:
    """The same quantities without the law and with it: which belongs to which file."""
    if answer.model is None:
        return []
    rows = []
    for effect in one.model.effects:
        stated, beside = answer.model.values.get(effect.name), one.model.values[effect.name]
        free = [p for p in effect.parameters if p.fit]
        if stated is None or all(beside[p.name] == p.null == stated[p.name] for p in free):
            continue
        rows.append((quantities.plain(effect.name), *(
            "; ".join(filter(None, (quantities.fitted_shortly(effect.name, {p.name: v[p.name] for p in free}),
                                    report_text.keys(changed(vehicle, effect, v))))) for v in (stated, beside))))
    return [Table("The same quantities, without and with the law",
                  "Two fits of the same car: the law takes over a part of what the values had to explain. Without the "
                  "law: the values stated above, for vehicle.yaml and model.yaml. With the law: the values in "
                  "proposed.yaml, for no other use. A factor and the key after it are the same correction; the arrow "
                  "begins at the value of the vehicle file that was given.",
                  ("quantity", "without the law", "with the law"), rows)] if rows else []
