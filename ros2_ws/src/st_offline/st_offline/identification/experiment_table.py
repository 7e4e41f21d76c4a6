"""Experiment tables: CSV with the unit in each header name, `pitch_deg` or `pitch_rad`; SI inside."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from st_recordings.runs.errors import RunError, check_readable

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

    required, optional: units allowed by name. Raises RunError naming the file and the column or row that is wrong.
    """
    check_readable(file)
    try:
        lines = [line for line in file.read_text(encoding="utf-8-sig").splitlines() if line.strip() and line[0] != "#"]
    except UnicodeDecodeError:
        raise RunError(file, "this is not a text file", "give a CSV table") from None
    delimiter = ";" if lines and ";" in lines[0] else ","
    header, *rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter)] or [[]]
    known = {**required, **(optional or {})}
    places = _places(file, header, known, texts)
    missing = [name for name in required if name not in places]
    if missing:
        names = ", ".join(" or ".join(f"{name}_{unit}" for unit in required[name]) for name in missing)
        raise RunError(file, f"has no column {names}; its columns are {', '.join(header)[:200]}",
                       "name each column with its unit, as in docs/manual/identification.md")
    if not rows:
        raise RunError(file, "has a header and no rows", "fill it in")
    for number, row in enumerate(rows, 1):
        if len(row) != len(header):
            raise RunError(file, f"row {number} has {len(row)} cells, the header {len(header)}", "correct that row")
    numbers, units, words = {}, {}, {}
    for name, (place, unit) in places.items():
        if name in known:
            cells = [_number(file, header[place], number, row[place]) for number, row in enumerate(rows, 1)]
            numbers[name], units[name] = np.array(cells) * TO_SI[unit], unit
        else:
            words[name] = tuple(row[place] for row in rows)
    for name in required:
        if not np.isfinite(numbers[name]).all():
            first = int(np.flatnonzero(~np.isfinite(numbers[name]))[0]) + 1
            raise RunError(file, f"row {first} has no {name}", "fill that cell, or leave the row out")
    return Table(file, numbers, units, words)


def _places(file: Path, header: Sequence[str], known: Mapping[str, Sequence[str]],
            texts: Sequence[str]) -> dict[str, tuple[int, str]]:
    places: dict[str, tuple[int, str]] = {}
    for place, title in enumerate(header):
        name, _, unit = title.rpartition("_")
        if name in known and unit.lower() in known[name]:
            key, unit = name, unit.lower()
        elif title in texts:
            key, unit = title, ""
        elif title in known or name in known:
            name = title if title in known else name
            units = " or ".join(f"{name}_{unit}" for unit in known[name])
            raise RunError(file, f"column {title} has no unit that is known", f"name it {units}")
        else:
            continue
        if key in places:
            raise RunError(file, f"column {key} is there twice", "remove one")
        places[key] = place, unit
    return places


def _number(file: Path, title: str, row: int, cell: str) -> float:
    if not cell:
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        raise RunError(file, f"row {row}: {title} is {cell[:40]!r}, not a number", "decimal point, no unit in the "
                       "cell") from None
    if not math.isfinite(value):
        raise RunError(file, f"row {row}: {title} is {cell}", "every number must be finite")
    return value
