"""Answers of the discovery with each limit halved and doubled.

Development cases only. Each case is driven and searched once; limits that act after the search reuse its result. Limits
of the error regions are applied to the errors of the model with the given vehicle file. Limits that act only on
suggested drives are not included. The discovery has no estimates of `st check` for the sensors.
One JSON line for each case and variant is appended to .st/strangers/ablation.jsonl, from which the table is written.
"""

import importlib
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from st_core.discovery import axles, error_regions, evidence, fit, library_fit, loss
from st_core.discovery.partitions import make_partitions
from st_core.discovery.search import Search
from st_core.discovery.settings import DiscoverySettings
from st_core.effects import EFFECTS
from st_recordings.car import read_vehicle
from st_recordings.paths import project_root
from st_recordings.runs.columns import Layout
from st_recordings.runs.csv import build_drive
from st_recordings.runs.csv_table import read_table

from .._cases import FACTORS, multiplied
from .._pages import format_records, replace_part
from . import score
from .cases import cases
from .recordings import write_case

Analysis = importlib.import_module("st_core.discovery.discover")._Analysis  # `discover` of the package is a function
PAGE = project_root() / "docs" / "measurements" / "discovery_limits.md"
LINES = project_root() / ".st" / "strangers" / "ablation.jsonl"
DIVERSE_CASES = ("light_ev_ratio", "suv_worn_rear", "van_lever", "escort_ratio", "saloon_worn_front",
                 "bmw_320i_gyro_bias", "hatchback_load", "light_ev_load", "estate_healthy")
LIMITS = ("max_file_deviation", "min_relative_size", "min_peak_force", "unexplained_share", "max_noise_ratio")
SEARCH, PARTITIONS = sys.modules[Search.__module__], sys.modules[make_partitions.__module__]
IN_SEARCH: dict[str, Any] = {
    **dict.fromkeys(("MAX_QUADRATIC_RISE", "RMS_CLIP_LIMIT", "DIVERGED_ERROR"), fit),
    **dict.fromkeys(("MIN_CURVATURE", "PART_PRIOR", "MIN_INFORMATION_FRACTION", "SIGN_DRAWS"), evidence),
    **dict.fromkeys(("NU", "DIFFERENCE_STEP", "MAX_SCALED_ERROR"), loss),
    **dict.fromkeys(("CONTENDERS", "CONTENDER_FRACTION"), SEARCH),
    **dict.fromkeys(("MIN_RUNS", "MIN_PARTS", "SAME_SITE_FRACTION", "PLACE_SIZE"), PARTITIONS),
    "JOINT_DEVIATION": (fit, library_fit, SEARCH)}
IN_REGIONS = dict.fromkeys(("MIN_EXCESS", "MIN_CONTRAST", "MIN_ERROR_RATIO", "MAX_EXCESS_RATIO", "MAX_CELL_DISTANCE",
                            "CELL_SIZE", "MIN_SEGMENT_DURATION", "MAX_CHANGE_POINTS", "MIN_TURNING_ACCELERATION"),
                           error_regions)
IN_AXLES = dict.fromkeys(("MIN_FORCE_CHANGE", "MAX_SLIP", "SMALL_SLIP", "DRAWS", "GAIN_SPEED", "MIN_SAMPLES"), axles)
CONSTANTS: dict[str, Any] = {"UNSELECTED_DEVIATION": evidence, **IN_AXLES, **IN_SEARCH, **IN_REGIONS}
"""Module of each constant, or all modules that import it."""
NUMBERS = (*LIMITS, "model_error", *CONSTANTS)
SEARCHED = ("max_file_deviation", "min_relative_size", *IN_SEARCH)
"""Limits that act during the search; all others act after it."""


def run_variants(names: Sequence[str], numbers: Sequence[str], write: bool) -> None:
    """Runs the cases with each of the limits `numbers` changed; writes the table of all lines if `write`."""
    LINES.parent.mkdir(parents=True, exist_ok=True)
    for name in names:
        for line in count_variants(name, numbers):
            with LINES.open("a") as file:
                file.write(json.dumps(line) + "\n")
            print(line, flush=True)
    if write:
        replace_part(PAGE, "ablation", page_table([json.loads(line) for line in LINES.read_text().splitlines()]))


def count_variants(name: str, numbers: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yields the counts of one case, unchanged and with each limit changed."""
    with tempfile.TemporaryDirectory(prefix="st-ablation-") as temporary:
        folder = Path(temporary)
        truth = write_case(cases("development")[name], folder)
        vehicle = read_vehicle(folder / "car" / "vehicle.yaml")
        tables = [read_table(path, Layout()) for path in sorted((folder / "drives").glob("*.csv"))]
    logs = [build_drive(table, vehicle).log for table in tables]
    analysis = Analysis(logs, vehicle, "nonlinear", (), DiscoverySettings(), None, {}, 1, {})
    searched, limits = _search(analysis), analysis.limits
    unchanged, regions = _count(analysis, searched, truth), _find_regions(analysis, searched)
    yield {"case": name, "number": "", "factor": 1.0, "changed": False, **unchanged, "regions": len(regions)}
    for number, factor in product(numbers, FACTORS):
        found, found_regions = unchanged, regions
        analysis.limits = replace(limits)  # `searched` keeps the unchanged ones
        with multiplied(_find_owners(analysis, number), factor):
            if number in IN_REGIONS:
                found_regions = _find_regions(analysis, searched)
            else:
                found = _count(analysis, _search(analysis) if number in SEARCHED else searched, truth)
        yield {"case": name, "number": number, "factor": factor,
               "changed": found != unchanged or found_regions != regions, **found, "regions": len(found_regions)}


def _find_owners(analysis: Any, number: str) -> list[tuple[Any, str]]:
    """(module or object, name) wherever a limit is defined or imported."""
    if number in LIMITS:
        return [(analysis.limits, number)]
    if number == "model_error":
        return [(parameter, number) for effect in EFFECTS.values() for parameter in effect.parameters]
    modules = CONSTANTS[number]
    return [(module, number) for module in (modules if isinstance(modules, tuple) else (modules,))]


def _search(analysis: Any) -> tuple[Any, ...]:
    """(problem, noise of the channels, partitions of the windows, search, its result)."""
    problem, by_column = analysis._make_problem()
    parts = make_partitions(analysis.windows)
    search = Search(problem, analysis.limits, parts, analysis.sensors, analysis.settings.seed)
    return problem, analysis._channel_noise(by_column), parts, search, search.run()


def _find_regions(analysis: Any, searched: tuple[Any, ...]) -> set[tuple[str, str]]:
    """(channel, condition) of the regions of large errors of the model with the given vehicle file."""
    noise = {channel: value for channel, value in searched[1].items() if channel != "position_5s"}
    found = error_regions.find_error_regions(
        analysis.runs, analysis.space.at(analysis.space.null), analysis.vehicle, analysis.settings, (), noise)
    return {(region.channel, region.condition) for region in found}


def _count(analysis: Any, searched: tuple[Any, ...], truth: Mapping[str, Any]) -> dict[str, int]:
    """Counts of statements, hidden errors, values and points of the axle curves, and of the correct ones among them."""
    analysis.problem, floor, parts, search, found = searched
    names = analysis._judge_effects(search, found, parts, floor)
    answer = {"effects": [_as_dict(one) for one in names.named], "minor": [_as_dict(one) for one in names.minor],
              "combinations": [vars(one) for one in names.combinations],
              "axle_curves": [vars(one) for one in names.curves]}
    result = {"truth": truth, "answer": answer}
    stated, hidden = score.list_statements(result), score.named_errors(result)
    compared = [one["inside"] for one in stated if one["inside"] is not None]
    inside, points = score.count_in_band(result)
    return {"statements": len(stated), "false": sum(not one["in_car"] for one in stated), "hidden": len(hidden),
            "named": sum(hidden.values()), "values": len(compared), "inside": sum(compared), "points": points,
            "in band": inside}


def _as_dict(effect: Any) -> dict[str, Any]:
    return {"name": effect.name, "alternatives": effect.alternatives, "joint": effect.joint,
            "parameters": {name: vars(value) for name, value in effect.parameters.items()}}


def page_table(lines: Sequence[Mapping[str, Any]]) -> str:
    """The table: for each limit and factor that changes a case, sums over the cases and number of cases changed.

    The other limits and factors follow in one sentence. The error regions are a column if their number changes.
    """
    newest = {(line["case"], line["number"], line["factor"]): line for line in lines}
    rows, unchanged = [], list[tuple[str, float]]()
    for number, factor in dict.fromkeys((number, factor) for _, number, factor in newest):
        matching = [line for key, line in newest.items() if key[1:] == (number, factor)]
        total = {key: sum(line[key] for line in matching) for key in matching[0] if isinstance(matching[0][key], int)}
        if number and not total["changed"]:
            unchanged.append((number, factor))
            continue
        rows.append({"number": f"`{number}` × {factor:g}" if number else "unchanged",
                     "hidden errors named": f"{total['named']} of {total['hidden']}",
                     "false statements": f"{total['false']} of {total['statements']}",
                     "values inside": f"{total['inside']} of {total['values']}",
                     "points in the band": f"{total['in band']} of {total['points']}",
                     "error regions": str(total["regions"]),
                     "cases changed": f"{total['changed']} of {len(matching)}"})
    if len({row["error regions"] for row in rows}) == 1:
        rows = [{name: cell for name, cell in row.items() if name != "error regions"} for row in rows]
    return format_records(rows) + "\n\n" + _format_unchanged(unchanged)


def _format_unchanged(unchanged: Sequence[tuple[str, float]]) -> str:
    """A sentence that lists the limits without effect, with the factor if only one of both has no effect."""
    by_number: dict[str, list[float]] = {}
    for number, factor in unchanged:
        by_number.setdefault(number, []).append(factor)
    names = [f"`{number}`" + "".join(f" × {factor:g}" for factor in factors if len(factors) < len(FACTORS))
             for number, factors in by_number.items()]
    return f"Without effect on any count: {', '.join(names) or 'none'}."
