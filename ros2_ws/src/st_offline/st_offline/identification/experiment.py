"""Defines the experiments of `st identify`, reads their CSV tables into SI units, and formats their estimates."""

import csv
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from st_core.identification.result import Identification
from st_core.models import Model
from st_core.vehicle import FILE_QUANTITIES, VehicleParameters, value_of
from st_recordings.runs import ReadSettings
from st_recordings.runs.errors import RunError, check_readable

from ..evaluation.drawing import FigureOutput, PageFigure

COLUMN_NAMES = ("parameter", "value", "standard uncertainty", "95 % interval", "unit", "in the file", "status")
SI_FACTORS = {"kg": 1.0, "n": 1.0, "kn": 1000.0, "m": 1.0, "mm": 0.001, "rad": 1.0, "deg": math.pi / 180.0}


@dataclass(frozen=True)
class IdentificationJob:
    """Options of `st identify`."""

    experiment: "Experiment"
    files: tuple[Path, ...]
    vehicle: VehicleParameters
    vehicle_file: str
    folder: Path
    read_settings: ReadSettings
    force: bool  # whether to use drives in which the checks find errors
    model: Model  # base model of fits to drives


@dataclass(frozen=True)
class Experiment:
    """An experiment: its files, its computation and its figure."""

    name: str  # as on the command line
    description: str
    required_files: str  # the files that it needs, as text
    # Reads the files and computes one or more results; raises StCoreError or RunError.
    identify: Callable[[IdentificationJob], tuple[Identification, ...]]
    draw: Callable[[Identification, FigureOutput], PageFigure] | None = None  # draws the figure of a result
    needs_files: bool = True  # whether files must be given
    uses_recordings: bool = False  # whether the files are recorded drives


def make_estimate_rows(outcome: Identification, vehicle: VehicleParameters) -> list[Sequence[str]]:
    """Rows with the columns of COLUMN_NAMES, angles in degrees; "in the file" is the value of `vehicle`, if any."""
    rows: list[Sequence[str]] = []
    for e in outcome.estimates:
        factor, unit = (180.0 / math.pi, "deg") if e.unit == "rad" else (1.0, e.unit)
        file_value = "" if e.parameter not in FILE_QUANTITIES else f"{value_of(vehicle, e.parameter) * factor:.6g}"
        value, uncertainty, low, high = (format_rounded(x * factor, e.standard_uncertainty * factor)
                                         for x in (e.value, e.standard_uncertainty, *e.interval95))
        rows.append((e.parameter, value, uncertainty, f"{low} to {high}", unit, file_value, e.status))
    return rows


def format_rounded(value: float, uncertainty: float) -> str:
    """A value to two significant digits of its uncertainty; without one, to five digits; "unknown" if not finite."""
    if not math.isfinite(value):
        return "unknown"
    if not math.isfinite(uncertainty) or uncertainty <= 0.0:
        return f"{value:.5g}"
    decimals = min(1 - math.floor(math.log10(uncertainty)), 12)
    return f"{round(value, decimals):.{max(decimals, 0)}f}"


@dataclass(frozen=True)
class MeasurementTable:
    """Columns of one or more CSV files, by name. numbers: SI values (n,), NaN for an empty cell or missing column.
    texts: cells as written, "" for a missing column. rows: file and number of each row."""

    numbers: Mapping[str, np.ndarray]
    texts: Mapping[str, list[str]]
    rows: Sequence[tuple[Path, int]]


def read_tables(files: Sequence[Path], required: Mapping[str, Sequence[str]],
                optional: Mapping[str, Sequence[str]] | None = None, texts: Sequence[str] = ()) -> MeasurementTable:
    """Read CSV tables. required: permitted units of the columns with a number in every row, by name. optional: those of
    the other number columns. texts: names of text columns. Raises RunError naming the file and the column or row."""
    units = {**required, **(optional or {})}
    numbers: dict[str, list[float]] = {name: [] for name in units}
    text_columns: dict[str, list[str]] = {name: [] for name in texts}
    rows = []
    for file in files:
        check_readable(file)
        try:
            content = file.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError:
            raise RunError(file, "this is not UTF-8 text", "save the table as CSV in UTF-8") from None
        lines = [line for line in content.splitlines() if line.strip() and line[0] != "#"]
        delimiter = ";" if lines and ";" in lines[0] else ","
        header, *body = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter)] or [[]]
        titles = _find_titles(file, header, units, required, texts)
        if not body:
            raise RunError(file, "has a header but no rows", "add a row for each measurement")
        for number, row in enumerate(body, 1):
            if len(row) != len(header):
                raise RunError(file, f"row {number} has {len(row)} cells, the header {len(header)}", "correct that row")
            cells = {name: row[header.index(title)] for name, title in titles.items()}
            for name, values in numbers.items():
                values.append(_parse_number(file, titles[name], number, cells[name]) if cells.get(name) else math.nan)
                if name in required and math.isnan(values[-1]):
                    raise RunError(file, f"row {number} has no {name}", "fill that cell, or remove the row")
            for name, column in text_columns.items():
                column.append(cells.get(name, ""))
            rows.append((file, number))
    return MeasurementTable({name: np.array(values) for name, values in numbers.items()}, text_columns, rows)


def _find_titles(file: Path, header: Sequence[str], units: Mapping[str, Sequence[str]], required: Collection[str],
                 texts: Sequence[str]) -> dict[str, str]:
    """Title of each column that is used, by its name."""
    names = {f"{name}_{unit}": name for name in units for unit in units[name]} | {name: name for name in texts}
    titles: dict[str, str] = {}
    for title in header:
        prefix, _, unit = title.rpartition("_")
        name = names.get(f"{prefix}_{unit.lower()}") or names.get(title)
        if name in titles:
            raise RunError(file, f"column {name} occurs twice", "remove one")
        if name is not None:
            titles[name] = title
        elif known := next((name for name in (title, prefix) if name in units), ""):
            permitted = " or ".join(f"{known}_{unit}" for unit in units[known])
            raise RunError(file, f"column {title} has no permitted unit", f"name it {permitted}")
    if missing := [name for name in required if name not in titles]:
        columns = ", ".join(" or ".join(f"{name}_{unit}" for unit in units[name]) for name in missing)
        raise RunError(file, f"has no column {columns}; its columns are {', '.join(header)[:200]}",
                       "name each column with its unit, as in docs/manual/identification.md")
    return titles


def _parse_number(file: Path, title: str, row: int, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise RunError(file, f"row {row}: {title} is {cell[:40]!r}, not a number",
                       "write a number with a decimal point and without a unit") from None
    if not math.isfinite(value):
        raise RunError(file, f"row {row}: {title} is {cell}", "give a finite number")
    return value * SI_FACTORS[title.rpartition("_")[2].lower()]
