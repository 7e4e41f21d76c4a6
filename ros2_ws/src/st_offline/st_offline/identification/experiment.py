"""An experiment of `st identify`: its table of data (units in the header, SI inside) and its results as table cells."""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from st_core.identification.result import Estimate, Identification
from st_core.models import MODELS, Model
from st_core.vehicle import VehicleParameters, quantity, value_of
from st_recordings.runs import ReadSettings
from st_recordings.runs.errors import RunError, check_readable

from ..evaluation.drawing import FigureOutput, PageFigure


@dataclass(frozen=True)
class Setup:
    """Inputs of every experiment in addition to its files. read: options for reading recordings. force: use drives that
    the checks reject. model: base model of fits by prediction.
    """

    vehicle: VehicleParameters
    read: ReadSettings = field(default_factory=ReadSettings)
    force: bool = False
    model: Model = MODELS["nonlinear"]

    def uncertainty_of(self, parameter: str) -> float:
        """Standard uncertainty of a value of the vehicle file, SI; 0 if the file has none."""
        known = self.vehicle.provenance.get(parameter)
        return (known.uncertainty or 0.0) if known else 0.0


@dataclass(frozen=True)
class Experiment:
    """name: as on the command line. what: description in a line. files: description of the required files.

    identify: reads the files and computes; several outcomes if one call performs several experiments.
    draw: the figure of an outcome of this experiment. drives: whether the files are recordings of drives.
    Both raise StCoreError or RunError, one line for the user.
    """

    name: str
    what: str
    files: str
    identify: Callable[[Sequence[Path], Setup], tuple[Identification, ...]]
    draw: Callable[[Identification, FigureOutput], PageFigure] | None = None
    files_needed: bool = True
    drives: bool = False


COLUMN_NAMES = ("parameter", "value", "±", "95 % interval", "unit", "in the file", "status")


def rows(found: Identification, vehicle: VehicleParameters) -> list[Sequence[str]]:
    """One row of COLUMN_NAMES per estimate; "in the file": value of `vehicle`."""
    return [_row(estimate, vehicle) for estimate in found.estimates]


def _row(estimate: Estimate, vehicle: VehicleParameters) -> Sequence[str]:
    factor, unit = (180.0 / math.pi, "deg") if estimate.unit == "rad" else (1.0, estimate.unit)
    spread = estimate.standard_uncertainty * factor
    before = ""
    if quantity(estimate.parameter) is not None:
        before = f"{value_of(vehicle, estimate.parameter) * factor:.5g}"
    low, high = (number(end * factor, spread) for end in estimate.interval95)
    return (estimate.parameter, number(estimate.value * factor, spread), number(spread, spread), f"{low} to {high}",
            unit, before, estimate.status)


def number(value: float, spread: float) -> str:
    """The value to the second significant digit of its uncertainty; five digits if it has none."""
    if not math.isfinite(value):
        return "unknown"
    if not math.isfinite(spread) or spread <= 0.0:
        return f"{value:.5g}"
    decimals = min(1 - math.floor(math.log10(spread)), 12)
    return f"{round(value, decimals):.{max(decimals, 0)}f}"


TO_SI = {"kg": 1.0, "n": 1.0, "kn": 1000.0, "m": 1.0, "mm": 0.001, "rad": 1.0, "deg": math.pi / 180.0}


@dataclass(frozen=True)
class Table:
    """numbers: by name without unit, (n,) SI; NaN where a cell is empty. units: as in the header. texts: by name."""

    file: Path
    numbers: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    texts: Mapping[str, tuple[str, ...]]

    def __len__(self) -> int:
        return len(next(iter(self.numbers.values())))


def read_columns(file: Path, required: Mapping[str, Sequence[str]], optional: Mapping[str, Sequence[str]] | None = None,
                 texts: Sequence[str] = ()) -> Table:
    """A table with all `required` columns, and the `optional` and `texts` ones it has.

    required, optional: units allowed by name. Raises RunError with the file and the invalid column or row.
    """
    check_readable(file)
    try:
        lines = [line for line in file.read_text(encoding="utf-8-sig").splitlines() if line.strip() and line[0] != "#"]
    except UnicodeDecodeError:
        raise RunError(file, "this is not a text file", "give a CSV table") from None
    delimiter = ";" if lines and ";" in lines[0] else ","
    header, *rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter)] or [[]]
    known = {**required, **(optional or {})}
    columns = _columns(file, header, known, texts)
    missing = [name for name in required if name not in columns]
    if missing:
        names = ", ".join(" or ".join(f"{name}_{unit}" for unit in required[name]) for name in missing)
        raise RunError(file, f"has no column {names}; its columns are {', '.join(header)[:200]}",
                       "name each column with its unit, as in docs/manual/identification.md")
    if not rows:
        raise RunError(file, "has a header and no rows", "add a row for each measurement")
    for row_number, row in enumerate(rows, 1):
        if len(row) != len(header):
            raise RunError(file, f"row {row_number} has {len(row)} cells, the header {len(header)}", "correct that row")
    numbers, units, words = {}, {}, {}
    for name, (column, unit) in columns.items():
        if name in known:
            cells = [_number(file, header[column], row_number, row[column]) for row_number, row in enumerate(rows, 1)]
            numbers[name], units[name] = np.array(cells) * TO_SI[unit], unit
        else:
            words[name] = tuple(row[column] for row in rows)
    for name in required:
        if not np.isfinite(numbers[name]).all():
            first = int(np.flatnonzero(~np.isfinite(numbers[name]))[0]) + 1
            raise RunError(file, f"row {first} has no {name}", "fill that cell, or leave the row out")
    return Table(file, numbers, units, words)


def _columns(file: Path, header: Sequence[str], known: Mapping[str, Sequence[str]],
             texts: Sequence[str]) -> dict[str, tuple[int, str]]:
    columns: dict[str, tuple[int, str]] = {}
    for column, title in enumerate(header):
        name, _, unit = title.rpartition("_")
        if name in known and unit.lower() in known[name]:
            key, unit = name, unit.lower()
        elif title in texts:
            key, unit = title, ""
        elif title in known or name in known:
            name = title if title in known else name
            units = " or ".join(f"{name}_{unit}" for unit in known[name])
            raise RunError(file, f"column {title} has no known unit", f"name it {units}")
        else:
            continue
        if key in columns:
            raise RunError(file, f"column {key} occurs twice", "remove one")
        columns[key] = column, unit
    return columns


def _number(file: Path, title: str, row: int, cell: str) -> float:
    if not cell:
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        raise RunError(file, f"row {row}: {title} is {cell[:40]!r}, not a number", "write a decimal point "
                       "and no unit") from None
    if not math.isfinite(value):
        raise RunError(file, f"row {row}: {title} is {cell}", "every number must be finite")
    return value
