"""A CSV file as numbers: header, units and rows, whatever delimiter, decimal sign and holes it has."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .columns import COLUMNS, Layout, Place, find_columns
from .errors import RunError, check_readable
from .units import unit_named

LATEST = 9.0e9  # s, year 2255; whole nanoseconds since 1970 do not reach much further


@dataclass(frozen=True)
class Table:
    """names: of all columns. places: of the channels. columns: channel -> values in SI, NaN where there is no number.

    time_ns: of all rows that have a time, in the order of the file; rows without one are nowhere, and counted in
    `timeless`. rising: of these rows, those newer than all before. warnings name the file.
    """

    file: Path
    names: tuple[str, ...]
    places: Mapping[str, Place]
    columns: Mapping[str, np.ndarray]
    time_ns: np.ndarray
    timeless: int
    rising: np.ndarray
    warnings: tuple[str, ...]

    @property
    def absolute(self) -> bool:
        """Whether the times are UTC."""
        return len(self.time_ns) > 0 and int(self.time_ns[0]) > 10**18


def header_of(file: Path) -> list[str]:
    """Names of the columns; empty for what is no text."""
    try:
        with file.open(encoding="utf-8-sig") as stream:
            return _parted(stream.readline())[0]
    except (OSError, UnicodeDecodeError):
        return []


def read_table(file: Path, layout: Layout) -> Table:
    """Raises RunError for what is no text, has no time, or has a row that does not fit its header."""
    check_readable(file)
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise RunError(file, "this is not a text file", "give it the extension of what it is") from None
    header, _, body = text.partition("\n")
    names, delimiter = _parted(header)
    places = find_columns(file, names, layout)
    if delimiter != ",":
        body = body.replace(",", ".")  # decimal commas
    places, body = _with_unit_row(places, body, delimiter, layout)
    warnings: list[str] = []
    rows = _rows(file, body, delimiter, len(names), warnings)
    with np.errstate(over="ignore"):
        columns = {channel: rows[:, place.column] * place.factor for channel, place in places.items()}
    columns = {channel: np.where(np.isfinite(values), values, np.nan) for channel, values in columns.items()}
    if "t" not in columns:
        return Table(file, tuple(names), places, columns, np.empty(0, np.int64), 0, np.empty(0, bool), tuple(warnings))
    seconds = columns.pop("t")
    timed = np.abs(seconds) <= LATEST
    if not timed.any() and np.isfinite(seconds).any():
        raise RunError(file, f"times like {np.nanmax(np.abs(seconds)):.3g} in column {places['t'].name} are no "
                       f"{places['t'].unit}", "declare their unit in a run.yaml, as units: {t: ns}")
    # Microseconds: what decimal seconds since 1970 still carry as a float.
    time_ns = np.round(seconds[timed] * 1e6).astype(np.int64) * 1000
    rising = np.diff(np.maximum.accumulate(time_ns), prepend=time_ns[:1] - 1) > 0
    columns = {channel: values[timed] for channel, values in columns.items()}
    return Table(file, tuple(names), places, columns, time_ns, int((~timed).sum()), rising, tuple(warnings))


def _parted(header: str) -> tuple[list[str], str]:
    """(names, delimiter)."""
    delimiter = next((mark for mark in (";", "\t") if mark in header), ",")
    try:
        names = next(csv.reader([header.strip("\r\n")], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        names = header.split(delimiter)
    return [name.strip() for name in names], delimiter


def _with_unit_row(places: dict[str, Place], body: str, delimiter: str,
                   layout: Layout) -> tuple[dict[str, Place], str]:
    """Some write the units below the names: then the first row holds no number, and units of its columns."""
    first, _, rest = body.partition("\n")
    cells = [cell.strip(' \r"') for cell in first.split(delimiter)]
    if any(np.isfinite(_number(cell)) for cell in cells):
        return places, body
    said = {channel: unit_named(COLUMNS[channel].kind, cells[place.column].strip("[]()"))
            for channel, place in places.items() if place.column < len(cells)}
    if not any(said.values()):
        return places, body
    units = {channel: unit for channel, unit in said.items() if unit and channel not in layout.units}
    return {channel: replace(place, unit=units[channel], said=True) if channel in units else place
            for channel, place in places.items()}, rest


def _rows(file: Path, body: str, delimiter: str, width: int, warnings: list[str]) -> np.ndarray:
    try:
        return _parsed(body, delimiter, width)
    except ValueError as first:
        error = first
    whole, _, rest = body.rpartition("\n")
    if rest:
        try:
            rows = _parsed(whole, delimiter, width)
            warnings.append(f"{file}: the last row is cut; it was left out")
            return rows
        except ValueError as second:
            error = second
    raise RunError(file, f"a row cannot be read ({' '.join(str(error).split())[:120]})",
                   "mend or remove that row (rows count from 0 behind the header)") from None


def _parsed(body: str, delimiter: str, width: int) -> np.ndarray:
    if all(not line or line.isspace() or line.lstrip().startswith("#") for line in io.StringIO(body)):
        return np.zeros((0, width))
    try:
        rows = np.loadtxt(io.StringIO(body), delimiter=delimiter, ndmin=2)
    except ValueError:  # a hole or a word somewhere: cell by cell, which takes three times as long
        rows = np.loadtxt(io.StringIO(body), delimiter=delimiter, ndmin=2, quotechar='"', converters=_number)
    if rows.shape[1] != width:
        raise ValueError(f"{rows.shape[1]} columns instead of {width}")
    return rows


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")
