"""Reads Racelogic VBOX files (.vbo), which contain position, speed and course from GNSS, and CAN signals.

Source: Racelogic, VBO file format. Latitude and longitude (positive west) are in minutes of arc; time is HHMMSS.ss UTC.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from canedge_bridge.units import find_unit, normalise

from .columns import ColumnSource, Layout, apply_units, find_columns, find_missing
from .csv_table import Table, differentiate_angle, parse_table, read_text, split_words
from .errors import RunError, check_readable
from .table_times import HHMMSS, parse_stamp

YAW_RATE_REVERSED = "the yaw rate is positive in right turns; its sign was changed"
_SECTION = re.compile(r"^\[([^\]]*)\][ \t]*\n", re.MULTILINE)
_CREATION_DATE = re.compile(r"created on (\d{1,2})/(\d{1,2})/(\d{4})", re.IGNORECASE)
# Name of a standard channel in [column names] -> channel, and channel -> its unit, unless [channel units] gives one
_STANDARD_CHANNELS = {"lat": "latitude", "latitude": "latitude", "long": "longitude", "longitude": "longitude",
                      "velocity": "velocity_x", "heading": "course", "time": "t"}
_STANDARD_UNITS = {"latitude": "min", "longitude": "min", "velocity_x": "km/h", "course": "deg",
                   "compass_heading": "deg", "t": HHMMSS}
# Units in which Racelogic's loggers write other channels, unless [channel units] gives one
_DEFAULT_UNITS = {"angular rate": "deg/s", "acceleration": "g", "angle": "deg", "speed": "km/h", "length": "m"}
HEADER_SIZE = 65536  # bytes that are read to find the column names
TRUE_HEADING_NAMES = ("trueheading", "truehead", "headingtrue", "heading2", "dualantennaheading")
MIN_HEADING_AGREEMENT = 0.5
"""A yaw rate channel is not used if its cosine similarity with the derivative of the heading is lower in magnitude."""
MIN_TURN_RATE = 0.01
"""[rad/s]. The yaw rate is replaced only if the median magnitude of the derivative of the heading is higher, and its
sign is changed only if the largest magnitude is higher. Heading noise of 0.1 deg at 5 Hz has about this derivative."""


def read_vbo(file: Path, layout: Layout) -> Table:
    """Reads a file; its channel "heading" is the course over ground. Raises RunError."""
    check_readable(file)
    text = read_text(file)
    sections = _split_sections(text)
    if not {"column names", "data"} <= sections.keys():
        raise RunError(file, "this is not a VBO file: section [column names] or [data] is missing",
                       "correct its extension")
    names, delimiter = _split_names(sections["column names"])
    if len({*re.findall(r"(?mi)^\[column names\]\s*\n(.*)", text)}) > 1:
        raise RunError(file, "it consists of several files with different [column names]", "split it into these files")
    sources = _find_sources(file, names, sections, layout)
    warnings: list[str] = []
    if "t" not in sources:
        raise RunError(file, f"[column names] has no time, only {', '.join(names)[:200]}", "export the time as well")
    table = parse_table(file, names, sections["data"], delimiter, layout, warnings, sources)
    date = _CREATION_DATE.search(text[:2000]) if table.sources["t"].unit == HHMMSS else None
    midnight, _ = (parse_stamp("{}.{}.{} 0:00:00".format(*date.groups())) if date else None) or (0.0, 0.0)
    return _correct_yaw_rate(_correct_coordinates(replace(table, time_ns=table.time_ns + round(midnight * 1e9))))


def lacks_steering(file: Path) -> bool:
    """Whether [column names] has names but no road wheel or steering wheel angle; False for an unreadable file."""
    try:
        names, _ = _split_names(_split_sections(read_text(file, HEADER_SIZE)).get("column names", ""))
        sources = find_columns(file, names, Layout())
    except (RunError, OSError):  # read_vbo reports the error
        return False
    return bool(names and find_missing(sources, names, ["road_wheel_angle"]))


def _split_names(text: str) -> tuple[list[str], str]:
    """(names of the columns, delimiter: a blank or, in files of some programs, a comma)."""
    names = split_words(text)
    return (names[0].split(","), ",") if len(names) == 1 and "," in names[0] else (names, " ")


def _split_sections(text: str) -> dict[str, str]:
    """Section -> text. Repeated data sections (joined files) are concatenated; other repetitions are ignored."""
    parts = _SECTION.split(text)
    sections: dict[str, str] = {}
    for name, content in zip(parts[1::2], parts[2::2], strict=True):
        key = name.strip().lower()
        sections[key] = sections.get(key, "") + content if key == "data" else sections.get(key, content)
    return sections


def _find_sources(file: Path, names: list[str], sections: dict[str, str], layout: Layout) -> dict[str, ColumnSource]:
    """Finds the standard channels, and further channels by the column names that are known for CSV files."""
    # [channel units] lists the last columns only; the unit of velocity may be in [header].
    lines = [line.strip() for line in sections.get("channel units", sections.get("units", "")).rstrip().splitlines()]
    units = dict(zip(names[-len(lines) :], lines, strict=False)) if lines and len(lines) <= len(names) else {}
    for line in sections.get("header", "").lower().splitlines():
        if line.strip().startswith("velocity "):
            units["velocity"] = line.split(None, 1)[1].strip()
    named = dict(layout.columns)
    for name in names:
        channel = "compass_heading" if normalise(name) in TRUE_HEADING_NAMES else _STANDARD_CHANNELS.get(name.lower())
        named |= {channel: name} if channel and channel not in layout.columns else {}
    sources = {}
    for channel, source in find_columns(file, names, Layout(named, {}, layout.source)).items():
        if normalise(source.name) == "heading" and channel not in named:
            continue  # not the yaw angle or the true heading, but the course
        is_standard = channel in named.keys() - layout.columns
        default = _STANDARD_UNITS[channel] if is_standard else _DEFAULT_UNITS.get(source.kind, source.unit)
        unit_in_name = source.unit if source.has_stated_unit else ""
        stated_unit = (find_unit(source.kind, units.get(source.name, "")) or unit_in_name) if default != HHMMSS else ""
        sources[channel] = replace(source, unit=stated_unit or default,
                                   has_stated_unit=bool(stated_unit or is_standard))
    if "yaw" in sources and "course" in sources and "yaw" not in layout.columns:
        sources.pop("yaw")
    return apply_units(file, sources, layout)


def _correct_coordinates(table: Table) -> Table:
    """Makes longitude positive to the east. Angles are in degrees if, in minutes of arc, they would be at sea
    (Gulf of Guinea). Speed and course show whether longitude is already positive to the east."""
    columns, warnings = dict(table.columns), list(table.warnings)
    if not columns.keys() >= {"latitude", "longitude"}:
        return table
    latitude, longitude = (float(np.nanmax(np.abs(columns[name]), initial=0.0)) for name in ("latitude", "longitude"))
    if (table.sources["latitude"].unit == "min" and 0.0 < latitude <= np.deg2rad(90.0 / 60.0)
            and longitude <= np.deg2rad(180.0 / 60.0)):
        columns |= {name: 60.0 * columns[name] for name in ("latitude", "longitude")}
        warnings.append(f"{table.file}: latitude and longitude are read in degrees; in minutes of arc, the unit of VBO "
                        "files, the drive would be in the Gulf of Guinea")
    columns["longitude"] = -columns["longitude"]
    if columns.keys() >= {"velocity_x", "course"}:
        eastward = differentiate_angle(table, columns["longitude"])
        expected = columns["velocity_x"] * np.sin(columns["course"])
        rows = np.isfinite(eastward) & np.isfinite(expected)
        if _compute_similarity(eastward[rows], expected[rows]) < -MIN_HEADING_AGREEMENT:
            columns["longitude"] = -columns["longitude"]
            warnings.append(f"{table.file}: according to speed and course, longitude is positive to the east, not to "
                            "the west as in VBO files; its sign is not changed")
    return replace(table, columns=columns, warnings=tuple(warnings))


def _correct_yaw_rate(table: Table) -> Table:
    """Makes the yaw rate positive in left turns. The derivative of the heading gives its sign, and replaces a yaw rate
    that contradicts it."""
    columns, warnings = dict(table.columns), list(table.warnings)
    heading = next((columns[name] for name in ("compass_heading", "course") if name in columns), None)
    if heading is not None and columns.keys() >= {"velocity_x", "yaw_rate"}:
        heading_rate = differentiate_angle(table, -heading)
        rows = np.isfinite(columns["yaw_rate"]) & np.isfinite(heading_rate) & (np.abs(columns["velocity_x"]) > 3.0)
        yaw_rate, derivative = columns["yaw_rate"][rows], heading_rate[rows]
        # The derivative is noise if the car drives straight; one turn shows the sign. If most of the drive is straight,
        # means are subtracted, so that a bias of the yaw rate has no influence; in a steady turn, 0 would remain.
        median, largest = np.quantile(np.abs(derivative), [0.5, 1.0]) if rows.sum() > 10 else (0.0, 0.0)
        if 0.0 < median < MIN_TURN_RATE:
            yaw_rate, derivative = yaw_rate - yaw_rate.mean(), derivative - derivative.mean()
        similarity = _compute_similarity(yaw_rate, derivative)
        if largest >= MIN_TURN_RATE and similarity < -MIN_HEADING_AGREEMENT:
            columns["yaw_rate"] = -columns["yaw_rate"]
            warnings.append(f"{table.file}: {YAW_RATE_REVERSED}")
        elif median >= MIN_TURN_RATE and similarity < MIN_HEADING_AGREEMENT:
            warnings.append(f"{table.file}: the yaw rate channel does not agree with the heading (cosine similarity "
                            f"{similarity:.2f}); the derivative of the heading is used")
            columns["yaw_rate"] = heading_rate
    return replace(table, columns=columns, warnings=tuple(warnings))


def _compute_similarity(x: np.ndarray, y: np.ndarray) -> float:
    """Cosine similarity of two series (n,); 0 if one of them is 0."""
    return float(x @ y / max(np.linalg.norm(x) * np.linalg.norm(y), 1e-12))
