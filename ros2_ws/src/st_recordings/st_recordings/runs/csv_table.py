"""Reads tables into channels in SI units; finds delimiter, decimal mark, encoding and missing values of text files."""

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from canedge_bridge.units import UNITS, find_unit, normalise
from st_core.sideslip import derive_yaw_rate

from . import columns as column_names
from .binary_table import BINARY_EXTENSIONS, is_signal_table, read_binary_table, read_names, read_signals
from .columns import COLUMNS, ColumnSource, Layout, find_columns, find_stamp_columns
from .errors import CP1252_FALLBACK, RunError, check_readable, convert_errors, find_codec, format_count
from .table_times import convert_to_seconds, pad_fractions, parse_stamp, read_stamps, select_usable_times

MAX_TIME_ROWS = 500  # rows in which distinct times are counted, to find the time column with the highest resolution
HEMISPHERES = {"latitude": {"N", "S"}, "longitude": {"E", "W"}}
MAX_UNIT_ROWS = 5  # largest number of rows without numbers (units, sources, types) below the header
MAX_HEADER_LINES = 300  # lines at the start of the file searched for the header; loggers write metadata before it
MISSING_MARKS = {"", "-", "--", "nan", "na", "n/a", "#n/a", "#na", "null", "none", "inf", "-inf", "+inf", "nil"}
_GROUPED_NUMBER = {mark: re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:{re.escape(mark)}\d{{3}})+") for mark in ",."}
_GROUPED_CELL = re.compile(r"(?:^|[;\t])\s*[+-]?[1-9]\d{0,2}(?:,\d{3})+\s*(?=[;\t\r\n]|$)", re.MULTILINE)
_GROUPED_POINTS = re.compile(r"\.(?<=\d.)\d{3}\.\d{3}(?!\d)")  # 1.234.567; fast because it starts with a literal
_NUMBER = re.compile(r'[\s"]*[+-]?[\d.,]*\d[\d.,]*(?:[eE][+-]?\d+)?[\s"]*')
_NUMBER_WITH_UNIT = re.compile(r"([+-]?\d[\d.,]*(?:[eE][+-]?\d+)?)\s*([^\d\s.,+-].*)")  # 0.02 sec, 12 km/h
_FORTRAN_EXPONENT = re.compile(r"(?<=[\d.])[dD](?=[+-]\d\d)")  # 1.5D-03
_LONG_NAMES = ("_field", "telemetry_name", "topic", "pid", "name", "signal", "signal_name", "variable", "channel")
_LONG_VALUES = ("_value", "telemetry_value", "value")
_SEPARATOR = re.compile(r"sep=.\s*$", re.MULTILINE)  # as spreadsheets state the delimiter
_LINE_END_IN_CELL = re.compile(r'"[^",;|\t]{0,80}\n[^",;|\t]{1,80}"(?=[,;|\t\n])')
_QUOTED_ROW = re.compile(r'^"((?:[^"\n]|"")*)"$', re.MULTILINE)  # a row that was exported as one cell
_RACECAPTURE_NAME = re.compile(r'"([^"|\n]*)"\|"([^"|\n]*)"(?:\|[-\d.]+)+')  # "AccelX"|"G"|-3.0|3.0|25
_THOUSANDS_SPACES = re.compile(r"[\u00a0\u202f\u2009\u2019'](?<=\d.)(?=\d{3}(?!\d))")


@dataclass(frozen=True)
class Table:
    """The rows of a table that have a time, in the order of the file; without a time column, all rows but no times."""

    file: Path
    names: tuple[str, ...]  # of all columns
    sources: Mapping[str, ColumnSource]  # by channel
    columns: Mapping[str, np.ndarray]  # SI values by channel, (n,) each; NaN where a number is missing
    time_ns: np.ndarray  # (n,)
    rows_without_time: int
    is_usable: np.ndarray  # (n,) whether the time is usable (ins_log.select_usable_rows)
    warnings: tuple[str, ...]  # each names the file
    texts: Mapping[str, str] = field(default_factory=dict)  # channel without numbers -> its first cell, shortened

    @property
    def is_utc(self) -> bool:
        """Whether the times are UTC: the first is later than 10^18 ns after 1970, in September 2001."""
        return len(self.time_ns) > 0 and int(self.time_ns[0]) > 10**18


def read_text(file: Path, size: int = -1) -> str:
    """Reads text in UTF-8, UTF-16, GBK or Windows-1252. Line ends become \\n, or a space within a quoted cell. A row
    exported as one quoted cell is split into its cells.

    size: number of bytes to read; -1: all (RunError for a binary file).
    """
    text = _decode(file, size).replace("\r\n", "\n").replace("\r", "\n").replace("\u2212", "-")
    text = re.sub(r"(?<!\0)\0+(?=\n|$)", "", text) if "\0" in text else text  # some loggers end each line with a NUL
    if text.startswith('"'):
        header, line_end, rows = text.partition("\n")
        text = _RACECAPTURE_NAME.sub(r"\1 [\2]", header) + line_end + rows
    text = _LINE_END_IN_CELL.sub(lambda cell: cell[0].replace("\n", " "), text)
    return _QUOTED_ROW.sub(lambda row: row[1].replace('""', '"') if set(row[1]) & set(",;\t") else row[0], text)


def _decode(file: Path, size: int) -> str:
    with file.open("rb") as stream:
        content = stream.read(size)
    head, codec = content[:4096], find_codec(content[:4096])
    with suppress(UnicodeDecodeError):
        return content.decode(codec)
    if size < 0 and codec == "utf-8-sig" and (b"\0" in head or sum(byte > 0x7F for byte in head) > 0.3 * len(head)):
        raise RunError(file, "this is not a text file", "correct its extension, or export it as .csv")
    return content.decode(codec, CP1252_FALLBACK)


def read_header(file: Path) -> list[str]:
    """Reads the names of the columns; empty for a file that is empty or cannot be read."""
    try:
        if is_signal_table(file) or file.suffix.lower() in BINARY_EXTENSIONS:
            return read_names(file)
        lines = read_text(file, 1 << 16).splitlines()
        return _split_header(lines[_find_header_line(lines)])[0] if lines else []
    except (OSError, RunError):
        return []


def read_table(file: Path, layout: Layout) -> Table:
    """Reads a table of text, MDF signals, MATLAB, HDF5 or Arrow. Raises RunError for an unreadable or invalid table."""
    check_readable(file)
    warnings: list[str] = []
    if is_signal_table(file):
        names, body = read_signals(file, layout, warnings)
        return replace(parse_table(file, names, body, ",", layout, warnings), names=tuple(read_names(file)))
    if file.suffix.lower() in BINARY_EXTENSIONS:
        names, body, notes = read_binary_table(file)
        _reject_long_format(file, names, layout)
        return parse_table(file, names, body, ",", layout, [*notes])
    if not (text := read_text(file)).strip():
        raise RunError(file, "it contains nothing but blanks or zero bytes", "copy it again")
    if text.startswith("$G"):
        raise RunError(file, "it contains NMEA sentences instead of a table", "export time, latitude, longitude, speed "
                       "and course as .csv")
    n_above = _find_header_line(text.split("\n", MAX_HEADER_LINES + 1)[:MAX_HEADER_LINES], layout)
    *preamble, header, body = (text + "\n").split("\n", n_above + 1)
    if n_above > 1 or (n_above and not _SEPARATOR.match(preamble[0])):
        warnings.append(f"{file}: the header is in line {n_above + 1}; the lines above it were skipped")
    names, delimiter = _split_header(header)
    _reject_long_format(file, names, layout, text.split("\n", MAX_UNIT_ROWS)[:-1])
    rows = body.rstrip("\n").rsplit("\n", 3)[-3:]  # the last row may be truncated
    if names[-1:] in ([""], ["Comment"]) and all(len(split_row(row, delimiter)) < len(names) for row in rows):
        names.pop()  # empty after a final delimiter, or Comment in LabVIEW, and without cells
    if not text.endswith("\n") and _is_last_cell_truncated(body, delimiter):
        body = body[:body.rstrip("\n").rfind("\n") + 1]
        warnings.append(f"{file}: the last row ends within a number and was left out")
    return parse_table(file, names, body, delimiter, layout, warnings, preamble=preamble)


def _reject_long_format(file: Path, names: Sequence[str], layout: Layout, lines: Iterable[str] = ()) -> None:
    """Raises RunError if these names, or the cells of a line, show that the table has one row for each value."""
    if not column_names.MOTION_CHANNELS.isdisjoint(find_columns(file, names, layout)):
        return
    for cells in (names, *(re.split('[,;\t"]', line) for line in lines)):
        pair = [next((cell for cell in cells if cell.lower() in known), "") for known in (_LONG_NAMES, _LONG_VALUES)]
        if all(pair):
            raise RunError(file, f"it has one row for each value (columns {' and '.join(pair)})", "export one column "
                           f"for each {pair[0]}, with the function pivot of InfluxDB or pandas")


def _is_last_cell_truncated(body: str, delimiter: str) -> bool:
    """Whether the last cell of a table has fewer decimals than the other cells of its column, which all have the same
    number. A file with such a cell and without a final line end is truncated."""
    lines = body.rstrip("\n").split("\n")
    cells = (line[line.rfind(delimiter) + 1:] for line in lines)
    points = ((cell, max(cell.rfind("."), cell.rfind(","))) for cell in cells)
    *decimals, last = (len(cell) - point if point >= 0 else 0 for cell, point in points)
    return (len(decimals) > MAX_UNIT_ROWS and lines[-1].count(delimiter) == lines[-2].count(delimiter)
            and min(decimals) == max(decimals) > last)


def join_tables(tables: Sequence[Table]) -> Table:
    """Joins the parts of a recording in the order of their start times, with the channels that all parts have.

    Parts without a usable row are left out. Raises RunError if parts overlap in time, because their clocks then differ.
    """
    parts = sorted((part for part in tables if part.is_usable.any()), key=lambda part: part.time_ns[part.is_usable][0])
    if len(parts) < 2:
        return parts[0] if parts else tables[0]
    for previous, part in pairwise(parts):
        if part.time_ns[part.is_usable][0] <= previous.time_ns[previous.is_usable][-1]:
            raise RunError(part.file, f"it begins before the end of {previous.file.name}, but the parts of a recording "
                           "must not overlap in time", "list it as a separate run")
    first = parts[0]
    columns = {channel: np.concatenate([part.columns[channel] for part in parts]) for channel in first.columns
               if all(channel in part.columns for part in parts)}
    dropped = sorted({*first.columns} - {*columns})
    warnings = [warning for part in parts for warning in part.warnings]
    warnings += [f"{first.file}: {', '.join(dropped)}: not used, missing from some parts"] if dropped else []
    sources = {channel: source for channel, source in first.sources.items() if channel in columns or channel == "t"}
    return Table(first.file, first.names, sources, columns,
                 np.concatenate([part.time_ns for part in parts]), sum(part.rows_without_time for part in parts),
                 np.concatenate([part.is_usable for part in parts]), tuple(warnings))


def parse_table(file: Path, names: list[str], body: str, delimiter: str, layout: Layout, warnings: list[str],
                sources: dict[str, ColumnSource] | None = None, preamble: Sequence[str] = ()) -> Table:
    """Parses rows of text into a table. Raises RunError.

    sources: column of each channel; None: found from `names`, first rows and `preamble`, the lines above the header.
    """
    if delimiter == " ":
        body = "\n".join(" ".join(line.split()) for line in body.split("\n"))
    if "D+" in body or "D-" in body or "d+" in body or "d-" in body:  # the substitution is slow
        body = _FORTRAN_EXPONENT.sub("E", body)
    if delimiter != "," and "." not in body and "," in body and not _GROUPED_CELL.search(body):
        body = body.replace(",", ".")
    if sources is None:
        sources = _find_sources(file, names, body, delimiter, layout, warnings)
        sources, body = _read_unit_rows(file, sources, preamble, body, delimiter, layout)
    lines = [line for line in body.splitlines() if line.strip(f' \t"{delimiter}')]
    # Rows that begin with # are comments, unless their first cell is #N/A, or all rows do (ASCII log of NovAtel).
    lines = [line for line in lines if not (text := line.lstrip()).startswith("#")
             or text.split(delimiter, 1)[0].strip().lower() in MISSING_MARKS] or lines
    lines, first_cells = _select_complete_rows(file, lines, delimiter, len(names), warnings), dict[str, str]()
    try:
        rows = np.loadtxt(lines, delimiter=delimiter, ndmin=2, comments=None) if lines else np.empty((0, len(names)))
    except ValueError:
        rows, sources, first_cells = _read_cells(file, lines, delimiter, names, sources, layout, warnings)
    time = sources.get("t")
    joined = rows if time is None else _join_groups(rows, names, time.column)
    warnings += [f"{file}: column {source.name} occurs {names.count(source.name)} times; " + (
        "each is the time of the columns after it" if source is time and joined is not rows else "the first is used")
                 for source in sources.values() if source.name and names.count(source.name) > 1]
    with np.errstate(over="ignore"):
        columns = {channel: np.where(np.isfinite(values := joined[:, source.column] * source.factor), values, np.nan)
                   for channel, source in sources.items() if channel != "t"}
    texts = {channel: cell[:40] for channel, cell in first_cells.items() if cell.lower() not in MISSING_MARKS
             and channel in columns and not np.isfinite(columns[channel]).any()}
    if time is None:
        return Table(file, tuple(names), sources, columns, np.empty(0, np.int64), 0, np.empty(0, bool), tuple(warnings))
    seconds, stamp = joined[:, time.column], find_stamp_columns(names)
    if stamp is not None and stamp[0] == time.column:
        seconds = column_names.add_fraction(seconds, stamp[2] * joined[:, stamp[1]])
    if len(joined) == len(lines) and (np.diff(seconds) < 0.0).any():
        seconds = pad_fractions(file, seconds, [split_row(line, delimiter)[time.column] for line in lines], warnings)
    seconds, time = convert_to_seconds(file, seconds, time, warnings)
    has_time, time_ns, is_usable = select_usable_times(file, seconds, time, first_cells.get("t"), warnings)
    columns = {channel: values[has_time] for channel, values in columns.items()}
    return Table(file, tuple(names), {**sources, "t": time}, columns, time_ns, int((~has_time).sum()), is_usable,
                 tuple(warnings), texts)


def _join_groups(rows: np.ndarray, names: list[str], time_column: int) -> np.ndarray:
    """Joins groups of columns that each begin with their own time column, all of the same name: one row for each time,
    NaN where a group has no such time. Returns `rows` if all groups have equal times or if times do not increase."""
    starts = [number for number in range(time_column, len(names)) if names[number] == names[time_column]]
    groups = [rows[np.isfinite(rows[:, start])] for start in starts]
    group_times = [group[:, start] for group, start in zip(groups, starts, strict=True)]
    if any(not len(times) or (np.diff(times) <= 0).any() for times in group_times) or all(
            np.array_equal(times, group_times[0]) for times in group_times):
        return rows
    all_times = np.unique(np.concatenate(group_times))
    joined_rows = np.full((len(all_times), len(names)), np.nan)
    for group, times, (start, end) in zip(groups, group_times, pairwise([*starts, len(names)]), strict=True):
        joined_rows[np.searchsorted(all_times, times), start:end] = group[:, start:end]
    joined_rows[np.searchsorted(all_times, group_times[0]), :time_column] = groups[0][:, :time_column]
    joined_rows[:, time_column] = all_times
    return joined_rows


def _find_sources(file: Path, names: list[str], body: str, delimiter: str, layout: Layout,
                  warnings: list[str]) -> dict[str, ColumnSource]:
    """Finds the column of each channel; the time may be an unnamed first column. Raises RunError for a CAN log."""
    column_keys = {normalise(name) for name in names}
    sources = find_columns(file, names, layout)
    if (column_keys & {"id", "canid", "arbid", "arbitrationid"} and column_keys & {"dlc", "len", "length", "data", "b1"}
            and column_names.MOTION_CHANNELS.isdisjoint(sources)):
        raise RunError(file, "this is a table of CAN frames in an unknown format", "export it as .asc, .blf, .trc, "
                       ".mf4 or candump .log, or with the columns of python-can's CSVWriter")
    warnings += [f"{file}: {sentence}" for sentence in column_names.describe_unknown_units(names, sources).values()]
    warnings += [f"{file}: columns {' and '.join(candidates)} may each be {channel}; none of them is used"
                 for channel, candidates in column_names.find_ambiguous(names).items() if channel not in sources]
    rows = [line.split(delimiter) for line in body.split("\n", MAX_TIME_ROWS)[:MAX_TIME_ROWS]]

    def count_times(source: ColumnSource) -> int:
        return len({row[source.column] for row in rows if source.column < len(row)})

    stamp = find_stamp_columns(names)
    has_fraction = stamp is not None and not any(stamp[2] * _parse_number(row[stamp[1]]) >= 1.0 for row in (
        line.split(delimiter) for line in body.split("\n")) if stamp[1] < len(row))
    if "t" in sources and "t" not in {*layout.columns, *layout.units} and not has_fraction:
        finest = max(column_names.find_times(names), key=count_times, default=sources["t"])
        if 2 * count_times(sources["t"]) < count_times(finest):  # whole seconds, and fractions in another column
            sources["t"] = finest
    first = split_row(body.lstrip("\n").partition("\n")[0], delimiter)[0]
    if "t" not in sources and names[:1] == [""] and parse_stamp(first):
        sources["t"] = ColumnSource(0, "(without a name)", "time", "s", has_stated_unit=True)
    return sources


def _find_header_line(lines: list[str], layout: Layout | None = None) -> int:
    """Index of the first line that names the most channels, or has the most words if no line names two channels."""
    counts, words = [], []
    for line in lines[:MAX_HEADER_LINES]:
        names, _ = _split_header(line)
        layout_names = set(layout.columns.values()).intersection(names) if layout else ()
        words.append(sum(bool(name) and not _NUMBER.fullmatch(name) for name in names))
        may_be_header = len(names) > 1 and (words[-1] or layout_names)
        counts.append(len(find_columns(Path(), names, Layout())) + len(layout_names) if may_be_header else 0)
    counts = counts if max(counts, default=0) > 1 else words
    return counts.index(max(counts)) if counts else 0


def _split_header(header: str) -> tuple[list[str], str]:
    """(names of the columns, delimiter)."""
    # Names with units, as in "speed, m/s;yaw, deg", have one comma more than delimiters. At a tie, the first mark wins.
    text = re.sub('"[^"]*"', "", header)
    marks = ";\t," if set(text) & {";", "\t"} or re.search(r"\|[^|,]+\|\s*,", text) else "|,"  # "yaw |deg|;vx |m/s|"
    delimiter = max(marks, key=lambda mark: text.count(mark) - (mark == "," and ", " in text))
    if delimiter not in header and len(header.split()) > 2:
        names = split_words(header)
        return names[names[0] in ("#", "%", "//"):], " "  # "# t x y" of numpy.savetxt
    return split_row(header, delimiter), delimiter


def split_words(text: str) -> list[str]:
    """Words of a text, or quoted parts without their quotes."""
    return [word.strip('"') for word in re.findall(r'"[^"\n]*"|\S+', text)]


def _read_unit_rows(file: Path, sources: dict[str, ColumnSource], preamble: Sequence[str], body: str, delimiter: str,
                    layout: Layout) -> tuple[dict[str, ColumnSource], str]:
    """(sources with units from a row above or below the names, the body starting at its first row of data).

    The units are in the first row in which all cells are units of their channels; other rows without numbers contain
    types or sources. Raises RunError if there are such rows below the names but no row of units.
    """
    def read_unit_texts(line: str) -> dict[str, str]:
        cells = split_row(line, delimiter)
        texts = {channel: text for channel, source in sources.items() if source.column < len(cells)
                 and cells[source.column] != source.name  # the names may be repeated below the header
                 and (text := cells[source.column].strip("[]() ")).lower() not in MISSING_MARKS}
        is_data = any(np.isfinite(_parse_number(cell.replace(",", "."))) for cell in cells) or any(
            parse_stamp(text) or _split_unit(channel, text) for channel, text in texts.items())
        return {} if is_data else texts

    def find_invalid(texts: Mapping[str, str]) -> list[str]:
        return [channel for channel, text in texts.items()
                if channel not in layout.units and find_unit(COLUMNS[channel].kind, text) is None]

    lines = body.split("\n", MAX_UNIT_ROWS)
    rows = [read_unit_texts(line) for line in lines[:-1]]
    first = next((k for k, texts in enumerate(rows) if lines[k].strip() and not texts), len(rows))
    # A row of channel numbers may be between the names and the units.
    first = max(first, *(k + 1 for k, texts in enumerate(rows) if len(texts) > 1 and not find_invalid(texts)), 0)
    texts_below = [texts for texts in rows[:first] if texts]
    texts_above = [{c: text for c, text in read_unit_texts(line).items() if c != "t"} for line in preamble]
    candidates = [*texts_below, *(texts for texts in texts_above if len(texts) > 1)]
    units = next((texts for texts in candidates if not find_invalid(texts)), None)
    if units is None and texts_below:
        units = texts_below[0]
        channel = find_invalid(units)[0]
        kind = COLUMNS[channel].kind
        raise RunError(
            file, f"unit row: {units[channel][:40]!r} of column {sources[channel].name} is not a unit of {kind}",
            "export decimal degrees" if kind == "latitude or longitude" else
            f"use one of {', '.join(UNITS[kind])}, or set the unit in a run.yaml, as units: {{{channel}: ...}}")
    return _apply_stated_units(sources, units or {}, layout), "\n".join(lines[first:])


def _apply_stated_units(sources: dict[str, ColumnSource], texts: Mapping[str, str],
                        layout: Layout) -> dict[str, ColumnSource]:
    """Sets the units in `texts` (by channel), except for channels with a unit in the layout."""
    return {**sources, **{channel: replace(sources[channel], unit=unit, has_stated_unit=True)
                          for channel, text in texts.items()
                          if channel not in layout.units and (unit := find_unit(COLUMNS[channel].kind, text))}}


def _split_unit(channel: str, cell: str) -> str:
    """The unit after the number in a cell of a channel; empty if there is none."""
    match = _NUMBER_WITH_UNIT.fullmatch(cell)
    return match[2] if match and find_unit(COLUMNS[channel].kind, match[2]) else ""


def split_row(line: str, delimiter: str) -> list[str]:
    """Cells of a row without quotes and blanks around them."""
    if '"' not in line and "'" not in line:
        return [cell.strip() for cell in line.split(delimiter)]
    try:
        row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    except csv.Error:  # a cell is too long
        row = line.split(delimiter)
    return [cell.strip(" \t\r\n\"'") for cell in row]


def _read_cells(file: Path, lines: list[str], delimiter: str, names: list[str], sources: dict[str, ColumnSource],
                layout: Layout, warnings: list[str]) -> tuple[np.ndarray, dict[str, ColumnSource], dict[str, str]]:
    """(numbers (n, width), sources, channel -> first cell) of rows with blanks or text; NaN where a number is missing.

    A unit after the numbers becomes the unit of the source, unless the layout states one. Latitudes and longitudes are
    negative where the column after (or before) each has S or W; dates and times become seconds. Raises RunError.
    """
    text = re.sub(rf'{re.escape(delimiter)} +"', f'{delimiter}"', "\n".join(lines))  # numpy needs quotes at the start
    lines = _THOUSANDS_SPACES.sub("", text).split("\n")
    first_row, stamp = split_row(lines[0], delimiter), find_stamp_columns(names)
    first_cells = {channel: first_row[source.column] for channel, source in sources.items()}
    units = {channel: text for channel, cell in first_cells.items() if (text := _split_unit(channel, cell))}
    decimal_mark, thousands_separator = _find_decimal_mark(file, lines, delimiter, units.values())
    time = sources.get("t")
    channels = {number: "" for number, name in enumerate(names) if time is not None and name == time.name}
    channels |= {stamp[1]: ""} if stamp else {}
    channels |= {source.column: channel for channel, source in sources.items()}

    def make_converter(unit: str) -> Callable[[str], float]:
        if not unit and (decimal_mark, thousands_separator) == (".", ""):
            return _parse_number
        return lambda cell: _parse_number(cell.strip(" '").removesuffix(unit).replace(thousands_separator, "").replace(
            decimal_mark, "."))

    def read_texts(number: int) -> list[str]:
        return [split_row(line, delimiter)[number] for line in lines]

    numbers = np.full((len(lines), len(names)), np.nan)
    with convert_errors(file, "a row cannot be read", "correct or remove that row", ValueError):
        numbers[:, list(channels)] = np.loadtxt(
            lines, delimiter=delimiter, ndmin=2, comments=None, quotechar='"', encoding=None, usecols=list(channels),
            converters={number: make_converter(units.get(channel, "")) for number, channel in channels.items()})
    if time is not None and np.isnan(numbers[0, time.column]) and (
            seconds := read_stamps(file, read_texts(time.column), warnings)) is not None:
        numbers[:, time.column] = seconds
    cells = dict(enumerate(first_row))
    hemispheres = {sources[name].column: {*letters, ""} for name, letters in HEMISPHERES.items() if name in sources}
    for side in (1, -1):
        if all(cells.get(column + side, "?").upper() in letters for column, letters in hemispheres.items()):
            for column in hemispheres:
                rows = np.isin([letter.upper() for letter in read_texts(column + side)], ("S", "W"))
                numbers[rows, column] = -np.abs(numbers[rows, column])
    return numbers, _apply_stated_units(sources, units, layout), first_cells


def _select_complete_rows(file: Path, lines: list[str], delimiter: str, width: int, warnings: list[str]) -> list[str]:
    """The rows with a cell for each column, and perhaps a delimiter at the end. Raises RunError if at least half of the
    rows have a different number of cells."""
    lines = [line.replace('"', "") if line.count('"') % 2 else line for line in lines]
    widths = [len(split_row(line, delimiter)) if '"' in line else line.count(delimiter) + 1 for line in lines]
    rows = [line for line, count in zip(lines, widths, strict=True)
            if count == width or (count == width + 1 and line.rstrip(" ").endswith(delimiter))]
    n_incomplete = len(lines) - len(rows)
    if lines and not rows:
        raise RunError(file, f"its rows have {max(widths, key=widths.count)} cells, but its header has {width}",
                       "export it with one delimiter that is not the decimal mark, and one name for each column")
    problem = f"{format_count(n_incomplete, len(lines), 'rows')} do not have as many cells as the header"
    if 2 * n_incomplete >= len(lines) > 0:
        raise RunError(file, problem, "export it with a cell for every column in each row")
    if n_incomplete:
        is_truncated = n_incomplete == 1 and widths[-1] < width
        warnings.append(f"{file}: the last row is truncated and was left out" if is_truncated else
                        f"{file}: {problem}; they were left out")
    return rows


def _find_decimal_mark(file: Path, lines: list[str], delimiter: str, units: Iterable[str]) -> tuple[str, str]:
    """(decimal mark, thousands separator or "") of all cells together, without the units after their numbers. Raises
    RunError if a cell is ambiguous: 1,234 may be 1.234 or 1234."""
    body = "\n".join(lines)
    if ('"' not in body if delimiter == "," else "," not in body) and not _GROUPED_POINTS.search(body):
        return ".", ""
    cells = {cell.removesuffix(unit).strip() for line in lines for cell in split_row(line, delimiter)
             for unit in ("", *units)}
    commas = {cell for cell in cells if "," in cell}
    points = {cell for cell in cells if "." in cell}
    # If a cell contains both marks, as 1.234,5 does, the last one is the decimal mark.
    with_both = {cell for cell in commas & points if _NUMBER.fullmatch(cell)}
    marks = {"," if cell.rfind(",") > cell.rfind(".") else "." for cell in with_both}
    for mark, cells_with_mark, other in ((",", commas, "."), (".", points, ",")):
        unmixed_cells = {cell for cell in cells_with_mark if other not in cell}
        if any(cell.count(mark) == 1 and not _GROUPED_NUMBER[mark].fullmatch(cell) and
               np.isfinite(_parse_number(cell.replace(",", "."))) for cell in unmixed_cells):
            marks.add(mark)  # a single mark, as in 12,5, is the decimal mark
        elif any(cell.count(mark) > 1 for cell in unmixed_cells if _GROUPED_NUMBER[mark].fullmatch(cell)):
            marks.add(other)  # a repeated mark, as in 1,234,567, separates thousands
    ambiguous_cells = sorted(cell for cell in commas | points if (len(marks) > 1 and cell in with_both)
                             or any(form.fullmatch(cell) for form in _GROUPED_NUMBER.values()))
    if ambiguous_cells and (len(marks) > 1 or not marks):
        reason = "the file has decimal commas and decimal points" if marks else "no other cell shows which"
        raise RunError(file, f"{ambiguous_cells[0]} may be a number with a decimal mark or with a thousands separator: "
                       f"{reason}", "export it without thousands separators")
    if len(marks) != 1:  # no decimal mark, or both marks in different cells
        return ",", ""
    return (".", ",") if marks == {"."} else (",", ".")


def _parse_number(text: str) -> float:
    try:
        return float(text.strip(" '")) if "_" not in text else float("nan")  # float accepts 1_000
    except ValueError:
        return float("nan")


def all_finite(columns: Mapping[str, np.ndarray], names: Iterable[str]) -> np.ndarray:
    """Whether each row has a number in every named channel."""
    return np.isfinite(np.stack([columns[name] for name in names])).all(axis=0)


def differentiate_angle(table: Table, angle: np.ndarray) -> np.ndarray:
    """Derivative [rad/s] of an angle [rad] at the usable rows; NaN in others, or if fewer than 3 have an angle."""
    rate = np.full(len(angle), np.nan)
    rows = np.flatnonzero(table.is_usable & np.isfinite(angle))
    if len(rows) > 2:
        rate[rows] = derive_yaw_rate(table.time_ns[rows], np.unwrap(angle[rows]))
    return rate
