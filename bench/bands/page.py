"""Writes the rows of the benchmark of bands to bands_held_out.csv, and their comparison with targets to bands.md."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from st_core.models import MODELS
from st_recordings.paths import project_root

from .._pages import format_records, replace_part

PAGE = project_root() / "docs" / "measurements" / "bands.md"
ROWS = PAGE.with_name("bands_held_out.csv")
TARGETS_PART = "comparison with the targets"
COVERAGE_90, COVERAGE_50 = "90 % band: coverage", "50 % band: coverage"
WORST_CELL = "worst cell with 200 starts or more"
TARGETS = {COVERAGE_90: (86.0, 94.0), COVERAGE_50: (45.0, 55.0), WORST_CELL: (80.0, 100.0)}
"""Column -> lower and upper bound of the coverage [%]."""
MAX_SCORE_RATIO = 1.15
"""Target for the interval score divided by that of the best alternative."""
BAND, CALIBRATED = "conformal", "scaled to nominal coverage"


def write_rows(rows: Mapping[str, Mapping[str, str]], page: Path = PAGE, file: Path = ROWS) -> None:
    """Replaces the rows with the same titles in the file, and the summary on the page."""
    with file.open(encoding="utf-8", newline="") as stream:
        merged = {row["held out"]: row for row in csv.DictReader(stream)}
    merged |= {title: {"held out": title, **row} for title, row in rows.items()}
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, ["held out", *next(iter(rows.values()))], lineterminator="\n")
        writer.writeheader()
        writer.writerows(merged.values())
    replace_part(page, TARGETS_PART, format_records(summarise_groups(list(merged.values()))))


def summarise_groups(rows: Sequence[Mapping[str, str]]) -> list[dict[str, str]]:
    """Ranges over all models for each held-out group and mode, in bold if the target is missed."""
    groups: dict[str, dict[str, list[Mapping[str, str]]]] = {}
    for row in (row for row in rows if row["interval score"] != "-"):
        title, mode, method = _split_title(row["held out"])
        name = ", ".join(word for word in title.split(", ") if word not in MODELS)
        groups.setdefault(f"{name}: {mode}", {}).setdefault(method, []).append(row)
    summaries = []
    for name, methods in groups.items():
        entry = {"held out": name}
        for column, (low, high) in TARGETS.items():
            percents = (_leading_percent(row[column]) for row in methods[BAND])
            known = [percent for percent in percents if percent is not None]
            text = _format_range(known, "{:.0f}", " %")
            entry[column] = f"**{text}**" if known and not low <= min(known) <= max(known) <= high else text
        calibrated = {method: rows for method, rows in methods.items() if method.endswith(CALIBRATED)}
        others = {method: rows for method, rows in methods.items() if method not in calibrated and method != BAND}
        entry["score / best alternative scaled to nominal coverage"] = _format_ratios(methods[BAND], calibrated)
        entry["score / best unscaled alternative"] = _format_ratios(methods[BAND], others)
        coverages = [_leading_percent(row[COVERAGE_90]) for row in _best_rows(others)]
        entry["90 % band of the best unscaled alternative: coverage"] = _format_range(coverages, "{:.0f}", " %")
        summaries.append(entry)
    return summaries


def _format_ratios(band: Sequence[Mapping[str, str]], others: Mapping[str, Sequence[Mapping[str, str]]]) -> str:
    """Formats the range over the models of the larger of both axes' score ratios, in bold if the target is missed."""
    ratios = [max(score / best for score, best in zip(_interval_scores(row), _interval_scores(other), strict=True))
              for row, other in zip(band, _best_rows(others), strict=False)]
    text = _format_range(ratios, "{:.2f}", "")
    return f"**{text}**" if ratios and max(ratios) > MAX_SCORE_RATIO else text


def _best_rows(others: Mapping[str, Sequence[Mapping[str, str]]]) -> list[Mapping[str, str]]:
    """For each model, the row of the method with the smallest product of both scores."""
    return [min(rows, key=lambda row: _interval_scores(row)[0] * _interval_scores(row)[1])
            for rows in zip(*others.values(), strict=True)] if others else []


def _split_title(title: str) -> tuple[str, str, str]:
    """(held-out group, mode, method) of a title."""
    for mode in ("hindsight", "forecast"):
        before, separator, method = title.partition(f", {mode}, ")
        if separator:
            return before, mode, method
    raise ValueError(f"{title}: no mode")


def _interval_scores(row: Mapping[str, str]) -> tuple[float, float]:
    along, across = row["interval score"].split(" | ")
    return float(along), float(across)


def _leading_percent(cell: str) -> float | None:
    """The percentage at the beginning of a cell; None if there is none."""
    number, separator, _ = cell.partition("%")
    return float(number) if separator else None


def _format_range(values: Sequence[float | None], form: str, unit: str) -> str:
    known = [form.format(value) for value in sorted(v for v in values if v is not None)]
    if not known:
        return "-"
    return f"{known[0]}{unit}" if known[0] == known[-1] else f"{known[0]} to {known[-1]}{unit}"
