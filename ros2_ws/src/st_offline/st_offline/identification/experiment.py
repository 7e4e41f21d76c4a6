"""Defines the experiments of `st identify`, reads their CSV tables into SI units, and formats their estimates."""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from st_core.identification.result import Identification
from st_core.models import Model
from st_core.vehicle import VehicleParameters, find_quantity, value_of
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
    model: Model  # base model of fits by prediction


@dataclass(frozen=True)
class Experiment:
    """An experiment of `st identify`."""

    name: str  # as on the command line
    description: str
    required_files: str  # description of the files
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
        file_value = "" if find_quantity(e.parameter) is None else f"{value_of(vehicle, e.parameter) * factor:.5g}"
        value, uncertainty, low, high = (format_rounded(x * factor, e.standard_uncertainty * factor)
                                         for x in (e.value, e.standard_uncertainty, *e.interval95))
        rows.append((e.parameter, value, uncertainty, f"{low} to {high}", unit, file_value, e.status))
    return rows


def format_rounded(value: float, uncertainty: float) -> str:
    """A value to two significant digits of its uncertainty, or to five digits without one; "unknown" if not finite."""
    if not math.isfinite(value):
        return "unknown"
    if not math.isfinite(uncertainty) or uncertainty <= 0.0:
        return f"{value:.5g}"
    decimals = min(1 - math.floor(math.log10(uncertainty)), 12)
    return f"{round(value, decimals):.{max(decimals, 0)}f}"


@dataclass(frozen=True)
class MeasurementTable:
    """Columns of a table by name. numbers: SI values (n,), NaN for an empty cell. texts: cells as written."""

    file: Path
    numbers: Mapping[str, np.ndarray]
    texts: Mapping[str, tuple[str, ...]]

    def __len__(self) -> int:
        return len(next(iter(self.numbers.values())))


def read_columns(file: Path, required: Mapping[str, Sequence[str]], optional: Mapping[str, Sequence[str]] | None = None,
                 texts: Sequence[str] = ()) -> MeasurementTable:
    """Read a CSV table: all `required` columns, with a number in every row, and those of `optional` and `texts` that
    exist. required, optional: permitted units by name. Raises RunError naming the file and the column or row."""
    check_readable(file)
    try:
        lines = [line for line in file.read_text(encoding="utf-8-sig").splitlines() if line.strip() and line[0] != "#"]
    except UnicodeDecodeError:
        raise RunError(file, "this is not a text in UTF-8", "save the table as CSV in UTF-8") from None
    delimiter = ";" if lines and ";" in lines[0] else ","
    header, *rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter)] or [[]]
    units = {**required, **(optional or {})}
    names = {f"{name}_{unit}": name for name in units for unit in units[name]} | {name: name for name in texts}
    titles: dict[str, str] = {}  # by name of the column
    for title in header:
        prefix, _, unit = title.rpartition("_")
        name = names.get(f"{prefix}_{unit.lower()}") or names.get(title)
        if name in titles:
            raise RunError(file, f"column {name} occurs twice", "remove one")
        if name is not None:
            titles[name] = title
        elif without_unit := next((name for name in (title, prefix) if name in units), ""):
            permitted = " or ".join(f"{without_unit}_{unit}" for unit in units[without_unit])
            raise RunError(file, f"column {title} has no permitted unit", f"name it {permitted}")
    missing_columns = [name for name in required if name not in titles]
    if missing_columns:
        names = ", ".join(" or ".join(f"{name}_{unit}" for unit in required[name]) for name in missing_columns)
        raise RunError(file, f"has no column {names}; its columns are {', '.join(header)[:200]}",
                       "name each column with its unit, as in docs/manual/identification.md")
    if not rows:
        raise RunError(file, "has a header but no rows", "add a row for each measurement")
    for row_number, row in enumerate(rows, 1):
        if len(row) != len(header):
            raise RunError(file, f"row {row_number} has {len(row)} cells, the header {len(header)}", "correct that row")
    cells = {title: column for title, *column in zip(header, *rows, strict=True)}
    numbers = {name: SI_FACTORS[title.rpartition("_")[2].lower()] * np.array(
        [_parse_number(file, title, row_number, cell) for row_number, cell in enumerate(cells[title], 1)])
        for name, title in titles.items() if name in units}
    for name in required:
        if not np.isfinite(numbers[name]).all():
            raise RunError(file, f"row {int(np.isfinite(numbers[name]).argmin()) + 1} has no {name}",
                           "fill that cell, or remove the row")
    return MeasurementTable(file, numbers, {name: tuple(cells[name]) for name in texts if name in titles})


def _parse_number(file: Path, title: str, row: int, cell: str) -> float:
    if not cell:
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        raise RunError(file, f"row {row}: {title} is {cell[:40]!r}, not a number",
                       "write a number with a decimal point and without a unit") from None
    if not math.isfinite(value):
        raise RunError(file, f"row {row}: {title} is {cell}", "give a finite number")
    return value
