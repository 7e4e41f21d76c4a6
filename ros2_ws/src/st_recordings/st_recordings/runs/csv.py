"""Converts tables of channels (columns.py) to drives, or to INS logs for runs with the steering in a CAN log."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
from oxts_bridge.geometry import LocalFrame
from scipy.interpolate import interp1d
from st_core.checks import AuxiliaryData
from st_core.checks.sampling import MIN_FREEZE_TIME
from st_core.log import INS_SIGNALS, OPTIONAL_INS_SIGNALS
from st_core.types import map_to_body, wrap_angle
from st_core.vehicle import VehicleParameters

from .axes import COURSE, HEADING, MIN_COURSE_SPEED, read_angles, read_geographic, rotate_to_body_axes
from .columns import Layout, describe_unknown_units, find_ambiguous, find_ambiguous_steering, find_columns, find_missing
from .csv_table import Table, all_finite, differentiate_angle, read_header
from .errors import RunError, format_count
from .ins_log import SPEEDS, InsLog, compute_car_speed, yaw_from_quaternion
from .run_types import LoadedRun, SteeringField, make_drive_log

MOTION_SIGNALS = ("velocity_x", "yaw_rate")
ROAD_WHEEL, STEERING_WHEEL = "road_wheel_angle", "steering_wheel_angle"
COLUMN_ADVICE = ("name the columns as in docs/csv_columns.md, or write a {stem}.run.yaml with the lines `{key}: {name}`"
                 "{can} and `columns: {{{channel}: NAME, ...}}` (for many drives: `each: '*{extension}'`)")
STEERING_ADVICE = ("name its column with --steering-field NAME --steering-is wheel (or road), and --steering-sign -1 "
                   "if right is positive; or also give the CAN log that contains the steering angle")
INTEGRATION_ADVICE = "; if no position was recorded, add columns x, y and yaw, integrated from velocities and yaw rate"
COMPUTED_FROM = {"time": "t", "x": "longitude", "y": "latitude", "yaw": HEADING}
"""Channel -> channel from which it is computed if the table has no column for it."""
ALTERNATIVES = {ROAD_WHEEL: STEERING_WHEEL, "x": "longitude", "y": "latitude", "yaw": f"{HEADING} or {COURSE}"}
"""Channel -> channels from which it can also be computed."""
QUATERNION_CHANNELS = [f"orientation_{axis}" for axis in "xyzw"]
POSSIBLY_UNFILLED = ("x", "y", "yaw", "orientation_z", "yaw_rate", STEERING_WHEEL)  # often 0 if not measured
MAX_HELD_FRACTION = 0.3
"""Positions have a lower rate than the rows if they repeat in more than this fraction of the rows with motion."""
MIN_INTERVAL_RATIO = 1.5
"""A channel has a lower rate than another if the ratio of their median sample intervals exceeds this value."""
MIN_SIMILAR_RATE = 0.9  # two channels have similar rates if one has more than this fraction of the samples of the other
MIN_GAP_RATIO = 2.5  # rows are missing between two rows if their time difference exceeds this multiple of the median
MAX_GAP_FRACTION = 0.1
"""If a larger fraction of the new positions follows such a gap, the time stamps jitter and no row is missing."""
MAX_ROUNDING_RATIO = 1.01
"""A change of position equals one unit of the last decimal if their ratio, larger to smaller, is at most this."""
MIN_REGULAR_FRACTION = 0.9
"""Minimum fraction of regular intervals in a channel of lower rate, and of one-digit changes in rounded positions."""


def add_steering_column(layout: Layout, steering: SteeringField | None) -> Layout:
    """Adds the steering column named by an option to the layout; an option that names a topic changes nothing."""
    if steering is None or steering.topic:
        return layout
    channel = _get_channel(steering)
    units = {channel: steering.unit} if steering.unit else {}
    return replace(layout, columns={**layout.columns, channel: steering.field}, units={**layout.units, **units},
                   source=layout.source or "--steering-field")


def _get_channel(steering: SteeringField) -> str:
    return ROAD_WHEEL if steering.quantity == "road" else STEERING_WHEEL


def build_drive(table: Table, vehicle: VehicleParameters | None = None, yaw_scale: float = 1.0,
                steering: SteeringField | None = None, frame_id: str = "") -> LoadedRun:
    """Builds a drive from a table. Raises RunError.

    A row without a number in an INS channel is excluded from the INS samples but not from the steering samples, and
    vice versa; a missing acceleration becomes NaN. vehicle: required for a table with only the steering wheel angle.
    yaw_scale: correction factor of yaw, applied before unwrapping. steering: column named by an option, and its sign.
    frame_id: frame of the velocities, if they are from a ROS message.
    """
    named_channels = [_get_channel(steering)] if steering is not None and not steering.topic else []
    table = _leave_out_blank_columns(table, (*INS_SIGNALS, ROAD_WHEEL), named_channels)
    _require_columns(table, (*INS_SIGNALS, ROAD_WHEEL))
    table = read_angles(table, use_positions=yaw_scale == 1.0)
    warnings = list(table.warnings)
    columns, origin = _derive_channels(table, warnings, frame_id)
    steering_channels = _choose_steering(table, columns, vehicle, steering, warnings)
    missing = _count_missing(table, columns, steering_channels, warnings)
    has_ins = table.is_usable & all_finite(columns, INS_SIGNALS)
    has_steering = table.is_usable & all_finite(columns, steering_channels)
    if min(has_ins.sum(), has_steering.sum()) < 2:
        _reject_unusable(table, int(has_ins.sum()), missing)
    values = {name: columns[name][has_ins] for name in INS_SIGNALS}
    values["yaw"] = np.unwrap(yaw_scale * values["yaw"])
    values |= {name: columns[name][has_ins] for name in OPTIONAL_INS_SIGNALS
               if name in columns and 2 * missing.get(name, 0) <= len(table.time_ns) + table.rows_without_time}
    values |= {name: columns[name][has_steering] for name in {ROAD_WHEEL, *steering_channels}}
    log = make_drive_log(table.file, table.file.stem, ins_time_ns=table.time_ns[has_ins],
                         steering_time_ns=table.time_ns[has_steering], **values)
    speeds = {name: (table.time_ns[table.is_usable], columns[name][table.is_usable])
              for name in SPEEDS if name in columns}
    first, last = np.flatnonzero(table.is_usable)[[0, -1]]
    auxiliary = AuxiliaryData({"INS": table.time_ns[first : last + 1]}, missing, compute_car_speed(speeds),
                              geographic=origin is not None)
    sources = {channel: f"{source.name} [{source.unit}{'' if source.has_stated_unit else ', assumed'}]"
               for channel, source in table.sources.items()}
    provenance = {"columns": sources, **({"origin": list(origin)} if origin else {})}
    return LoadedRun(log, provenance, warnings=tuple(warnings), auxiliary=auxiliary)


def build_ins_log(table: Table, required: Sequence[str], yaw_scale: float = 1.0) -> InsLog:
    """Builds the INS log of a table, for a run with the steering in a CAN log. Raises RunError.

    required: channels that must have a number in every sample, in addition to yaw if the table has it. Other channels
    may contain NaN. yaw_scale: as for `build_drive`.
    """
    table = _leave_out_blank_columns(table, required)
    _require_columns(table, required, ", `can: [CAN LOGS]`")
    table = read_angles(table, use_positions=yaw_scale == 1.0)
    warnings = list(table.warnings)
    columns, origin = _derive_channels(table, warnings)
    channels = [name for name in INS_SIGNALS if name in columns
                and (name in required or (name == "yaw" and np.isfinite(columns[name]).any()))]
    rows = table.is_usable & all_finite(columns, channels)
    if rows.sum() < 2:
        _reject_unfilled(table)
        raise RunError(table.file, "it contains fewer than two usable rows", "remove it from the command")
    counted_columns = {name: columns[name] for name in (*channels, *OPTIONAL_INS_SIGNALS) if name in columns}
    _count_missing(table, counted_columns, (), warnings)
    values = {name: columns[name][rows] for name in (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS)
              if name in columns and np.isfinite(columns[name][rows]).any()}
    if "yaw" in values:
        values["yaw"] = np.unwrap(yaw_scale * values["yaw"])
    time_ns = table.time_ns[rows]
    return InsLog(table.file, time_ns, values, time_ns, origin, None, tuple(warnings), table.is_utc)


def find_missing_in_header(file: Path, required: Sequence[str] = ("t", *INS_SIGNALS, ROAD_WHEEL),
                           with_derived_motion: bool = True) -> list[str]:
    """The required channels that have no column in the header and cannot be derived."""
    names = read_header(file)
    return find_missing(find_columns(file, names, Layout()), names, required, with_derived_motion)


def _leave_out_blank_columns(table: Table, required: Sequence[str], exempt: Sequence[str] = ()) -> Table:
    """The table without those blank or unfilled (all zero) columns that the required channels do not need. exempt:
    channels that are never left out."""
    sources, warnings = dict(table.sources), list(table.warnings)
    for channel, values in table.columns.items():
        is_blank = not np.isfinite(values).any()
        is_unfilled = not is_blank and channel in POSSIBLY_UNFILLED and not np.nan_to_num(values).any()
        derived = [channel] if is_unfilled and channel in INS_SIGNALS else []
        if channel not in {*OPTIONAL_INS_SIGNALS, *table.texts, *exempt} and (is_blank or is_unfilled) and (
                not find_missing(sources.keys() - {channel}, table.names, (*required, *derived))):
            name = sources.pop(channel).name
            warnings += [] if is_blank else [f"{table.file}: column {name} is 0 in all rows; it was read as blank"]
    return replace(table, sources=sources, warnings=tuple(warnings), columns={
        name: values for name, values in table.columns.items() if name in sources})


def _require_columns(table: Table, required: Sequence[str], can: str = "") -> None:
    """Raises RunError for missing or ambiguous columns. can: line of a run.yaml for CAN logs, as part of the advice."""
    missing = find_missing(table.sources, table.names, ("t", *required))
    if "yaw" in missing:  # do not list channels that can be computed from yaw
        still_missing = find_missing({*table.sources, "yaw"}, table.names, missing)
        missing = [name for name in missing if name == "yaw" or name in still_missing]
    if missing and 2 * sum(bool(re.fullmatch(r"[\d.:eE+ -]+", name)) for name in table.names) > len(table.names):
        raise RunError(table.file, "its first line contains numbers instead of the names of columns",
                       "add a header line with names from docs/csv_columns.md")
    unknown_units = describe_unknown_units(table.names, table.sources)
    candidates = [*missing, *(COMPUTED_FROM[name] for name in missing if name in COMPUTED_FROM),
                  *([STEERING_WHEEL] if ROAD_WHEEL in missing else []),
                  *(QUATERNION_CHANNELS if "yaw" in missing else [])]
    if text := next((unknown_units[name] for name in candidates if name in unknown_units), ""):
        raise RunError(table.file, text, "export it in a different unit; or name the column in a run.yaml under "
                       "`columns:`, and convert it with `correct:`")
    ambiguous = find_ambiguous(table.names)
    if channel := next((name for name in candidates if name in ambiguous), ""):
        raise RunError(table.file, f"columns {' and '.join(ambiguous[channel])[:200]} may each be {channel}",
                       f"name the right one in a run.yaml, as columns: {{{channel}: NAME}}")
    if missing:
        texts = [f"{name} (or {ALTERNATIVES[name]})" if name in ALTERNATIVES else name for name in missing]
        advice = STEERING_ADVICE if missing == [ROAD_WHEEL] else COLUMN_ADVICE.format(
            stem=table.file.stem, name=table.file.name, can=can, channel=missing[0],
            extension=(extension := table.file.suffix), key="vbo" if extension.lower() == ".vbo" else "csv")
        if {"x", "y"} <= {*missing} and table.sources.keys() >= {"velocity_x", "yaw_rate"}:
            advice += INTEGRATION_ADVICE
        raise RunError(table.file, f"no column was recognised as {', '.join(texts)}; its columns are "
                       f"{', '.join(table.names)[:200]}", advice)
    column = (find_ambiguous_steering(table.names) or "")[:60]
    if ROAD_WHEEL in required and ROAD_WHEEL not in table.sources and STEERING_WHEEL not in table.sources:
        raise RunError(table.file, f"column {column} may be the angle of the steering wheel or of the road wheels",
                       f"declare it: --steering-field '{column}' --steering-is wheel (or road); or in a run.yaml, as "
                       f"columns: {{{STEERING_WHEEL}: {column}}} or {{{ROAD_WHEEL}: {column}}}")


def _reject_unusable(table: Table, n_ins: int, missing: Mapping[str, int]) -> NoReturn:
    """Raises RunError with the reason. n_ins: number of rows with all INS channels. missing: from `_count_missing`."""
    _reject_unfilled(table)
    reason, advice = "", "remove it from the command"
    if n_ins < 2 and all(np.isfinite(column[table.is_usable]).sum() > 1 for column in table.columns.values()):
        reason, advice = ": its channels have no times in common", "export them on one clock"
    elif missing:
        channel = max(missing, key=lambda name: missing[name])
        total = len(table.time_ns) + table.rows_without_time
        reason = f": {channel} has no number in {format_count(missing[channel], total, 'rows')}"
        if column := next((name for name in (channel, COMPUTED_FROM.get(channel, "")) if name in table.texts), ""):
            reason = f": column {table.sources[column].name} has no numbers, but text such as {table.texts[column]!r}"
            advice = "export it as plain numbers"
    elif len(table.is_usable) > 1:
        rows = format_count(int(table.is_usable.sum()), len(table.is_usable), "rows")
        reason, advice = f": only {rows} have a time later than all previous rows", "export times with milliseconds"
    raise RunError(table.file, f"it contains fewer than two usable rows{reason}", advice)


def _reject_unfilled(table: Table) -> None:
    """Raises RunError if the only position (latitude and longitude) or orientation (quaternion) is zero or blank."""
    for names, others, problem, advice in (
            (("latitude", "longitude"), {"x", "y"}, "latitude and longitude are 0 or empty in all rows, so the "
             "receiver had no fix", "export x and y, or a part with a fix"),
            (QUATERNION_CHANNELS, {"yaw"}, "the orientation quaternion is 0 or empty in all rows",
             f"also export yaw, {ALTERNATIVES['yaw']}")):
        values = [table.columns[name] for name in names if name in table.columns.keys() - table.texts]
        if len(values) == len(names) and not others <= table.columns.keys() and not np.nan_to_num(values).any():
            raise RunError(table.file, problem, advice)


def _derive_channels(table: Table, warnings: list[str], frame_id: str = ""
                     ) -> tuple[dict[str, np.ndarray], tuple[float, float, float] | None]:
    """(columns with derived channels, origin of the map: latitude, longitude [rad] and altitude [m]; None if the table
    has x and y, or no fix).

    Derives missing channels: yaw from compass heading, quaternion or course; velocities from those over ground,
    or as in `_complete_motion`; yaw rate from yaw; x, y from latitude, longitude. Interpolates channels of lower rate.
    """
    columns, origin = dict(table.columns), None
    _interpolate_lower_rates(table, columns, warnings)
    if "yaw" not in columns and HEADING in columns:
        columns["yaw"] = np.pi / 2 - columns[HEADING]
    elif "yaw" not in columns and columns.keys() >= {*QUATERNION_CHANNELS}:
        columns["yaw"] = yaw_from_quaternion(*map(columns.__getitem__, QUATERNION_CHANNELS))
    elif "yaw" not in columns and COURSE in columns:
        columns[COURSE] = _replace_course_when_slow(table, columns, warnings)
        columns["yaw"] = np.pi / 2 - columns[COURSE]
    if "velocity_y" not in columns and columns.keys() >= {"yaw", "velocity_east", "velocity_north"}:
        east, north = columns["velocity_east"], columns["velocity_north"]
        columns["velocity_x"], columns["velocity_y"] = map_to_body(east, north, columns["yaw"])
    elif columns.keys() >= {"velocity_x", "velocity_y", "yaw"}:
        warning = rotate_to_body_axes(columns, frame_id)
        warnings += [f"{table.file}: {warning}"] if warning else []
    _complete_motion(table, columns, warnings)
    if not {"x", "y"} <= columns.keys() and columns.keys() >= {"latitude", "longitude"}:
        latitude, longitude = columns["latitude"], columns["longitude"]
        for name, limit in (("latitude", 90), ("longitude", 360)):
            if np.isfinite(columns[name]).any() and (median := np.degrees(np.nanmedian(np.abs(columns[name])))) > limit:
                raise RunError(table.file, f"{name} (column {table.sources[name].name}) is about {median:.6g} deg, "
                               "which is impossible", "export decimal degrees, not degrees and minutes such as "
                               f"5206.123; or declare the unit in a run.yaml, as units: {{{name}: "
                               f"{'min' if median < 60 * limit else '1e-7 deg'}}}; or swap the two")
        has_fix = (latitude != 0.0) | (longitude != 0.0)  # loggers write zeros before the first fix
        if not has_fix.all():
            count_text = format_count(int((~has_fix).sum()), len(has_fix), "rows")
            warnings.append(f"{table.file}: {count_text} have latitude and longitude 0, which means no fix")
        latitude, longitude = (np.where(has_fix, values, np.nan) for values in (latitude, longitude))
        latitude, longitude = read_geographic(table, columns, latitude, longitude, warnings)
        fixes = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude) & table.is_usable)
        origin = (float(latitude[fixes[0]]), float(longitude[fixes[0]]), 0.0) if len(fixes) else None
        columns["x"], columns["y"], _ = LocalFrame(*(origin or (0.0, 0.0, 0.0))).to_enu(latitude, longitude, 0.0)
    _interpolate_lower_rates(table, columns, warnings)
    _interpolate_held_positions(table, columns, warnings)
    return columns, origin


def _interpolate_lower_rates(table: Table, columns: dict[str, np.ndarray], warnings: list[str]) -> None:
    """Interpolates INS channels with a lower rate or separate stamps at the rows of a reference channel: the one with
    the highest rate or, of several with a similar rate, the one with the most channels filled in its rows.

    Loggers leave the cells between the samples of a channel blank. Missing numbers in the reference channel and gaps in
    the other channels are not filled.
    """
    fixes = [np.isfinite(columns[name]) for name in ("latitude", "longitude") if name in columns]
    are_separate = len(fixes) == 2 and 2 * (fixes[0] & fixes[1]).sum() < fixes[0].sum()  # in different messages
    names = [name for name in (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS, HEADING, COURSE, "velocity_east", "velocity_north",
                               *(("latitude", "longitude") if are_separate else ())) if name in columns]
    sample_rows = {name: np.flatnonzero(table.is_usable & np.isfinite(columns[name])) for name in names}
    counts = np.sum([np.isfinite(columns[name]) for name in names], axis=0)  # channels with a number in each row
    max_count = max(map(len, sample_rows.values()), default=0)
    rows = max((samples for samples in sample_rows.values() if len(samples) > MIN_SIMILAR_RATE * max_count),
               key=lambda samples: counts[samples].sum(), default=np.empty(0, int))
    time = (table.time_ns - table.time_ns[:1]) * 1e-9
    if len(rows) < 3:
        return
    descriptions = []
    for name, samples in sample_rows.items():
        if len(samples) < 3:
            continue
        steps = np.diff(time[samples])
        median_step = np.median(steps)
        is_regular = np.mean(steps <= MIN_INTERVAL_RATIO * median_step) > MIN_REGULAR_FRACTION
        is_slower = median_step > MIN_INTERVAL_RATIO * np.median(np.diff(time[rows]))
        if not is_regular or not (is_slower or np.isin(samples, rows).mean() < 0.5):
            continue
        values = columns[name][samples]
        if name in ("yaw", HEADING, COURSE):
            values = np.unwrap(values)
        interpolated = np.interp(time[rows], time[samples], values, np.nan, np.nan)
        next_samples = np.clip(np.searchsorted(time[samples], time[rows]), 1, len(samples) - 1)
        interpolated[(steps[next_samples - 1] > MIN_GAP_RATIO * median_step) & ~np.isin(rows, samples)] = np.nan
        columns[name] = np.full_like(columns[name], np.nan)
        columns[name][rows] = interpolated
        descriptions.append(f"{name} {format_count(len(samples), int(table.is_usable.sum()), 'rows')}")
    if descriptions:
        warnings.append(f"{table.file}: channels with a lower rate or separate stamps: {', '.join(descriptions)}; "
                        "their values in the other rows were interpolated")


def _replace_course_when_slow(table: Table, columns: Mapping[str, np.ndarray], warnings: list[str]) -> np.ndarray:
    """Course over ground [rad], interpolated at low speed; constant if always slow, unchanged without a speed."""
    course, unknown = columns[COURSE], np.full(len(columns[COURSE]), np.nan)
    over_ground = columns.get("velocity_east", unknown) + 1j * columns.get("velocity_north", unknown)
    speed = np.abs(columns.get("velocity_x", over_ground))
    is_slow = table.is_usable & np.isfinite(course) & (speed < MIN_COURSE_SPEED)
    if not is_slow.any():
        return course
    is_fast = table.is_usable & np.isfinite(course) & (speed >= MIN_COURSE_SPEED)
    known_rows = np.flatnonzero(is_fast) if is_fast.any() else np.flatnonzero(is_slow)[:1]
    warnings.append(f"{table.file}: {format_count(int(is_slow.sum()), int(table.is_usable.sum()), 'rows')} are slower "
                    f"than {MIN_COURSE_SPEED:g} m/s; the course is noise there and is not used")
    time_ns = table.time_ns - table.time_ns[0]
    return np.where(is_slow, np.interp(time_ns, time_ns[known_rows], np.unwrap(course[known_rows])), course)


def _complete_motion(table: Table, columns: dict[str, np.ndarray], warnings: list[str]) -> None:
    """Adds missing velocity_y (0, or from speed and course, which also correct velocity_x) and yaw rate (from yaw)."""
    if not columns.keys() >= {"velocity_x", "yaw"}:
        return
    known_sources = (*table.sources.values(), *find_columns(table.file, table.names, Layout()).values())
    unused = ", ".join(name for name in table.names if name not in {source.name for source in known_sources})
    advice = f"; columns not used: {unused[:200]}; if it is one of them, name it in a run.yaml" if unused else ""
    if "velocity_y" not in columns:
        course = np.pi / 2 - columns[COURSE] if COURSE in columns else columns["yaw"]
        sideslip = wrap_angle(course - columns["yaw"])
        speed = columns["velocity_x"]
        columns["velocity_x"], columns["velocity_y"] = speed * np.cos(sideslip), speed * np.sin(sideslip)
        if not np.nan_to_num(sideslip).any():
            warnings.append(f"{table.file}: velocity_y has no column with numbers; it is set to 0 (unknown sideslip)"
                            + advice)
    if "yaw_rate" not in columns:
        columns["yaw_rate"] = differentiate_angle(table, columns["yaw"])
        warnings.append(f"{table.file}: yaw_rate has no column with numbers; the derivative of yaw is used{advice}")


def _interpolate_held_positions(table: Table, columns: dict[str, np.ndarray], warnings: list[str]) -> None:
    """Interpolates, and at the end extrapolates, positions that have a lower rate than the rows and are repeated.

    Positions repeated during an outage remain: `st check` reports them as frozen.
    """
    if not columns.keys() >= {"x", "y", "velocity_x"}:
        return
    rows = np.flatnonzero(table.is_usable & all_finite(columns, ("x", "y", "velocity_x")))
    if len(rows) < 3:
        return
    x, y = columns["x"][rows], columns["y"][rows]
    step = np.hypot(np.diff(x), np.diff(y))
    is_new = step > 0
    if not is_new.any():
        return
    seconds = (table.time_ns[rows] - table.time_ns[rows[0]]) * 1e-9
    resolution = max(float(step[is_new].min()), 1e-9)
    median_interval = np.median(np.diff(seconds[1:][is_new], prepend=seconds[0]))
    is_moving = np.abs(columns["velocity_x"][rows][1:]) * median_interval > (np.median(step[is_new]) + resolution) / 20
    names = ("x", "y") if "x" in table.columns else ("latitude", "longitude")
    is_rounded = all(_is_rounded(columns[name][rows] / table.sources[name].factor) for name in names)
    if is_rounded or (is_moving & ~is_new).sum() <= MAX_HELD_FRACTION * max(is_moving.sum(), 1):
        return
    is_measured = np.concatenate(([True], is_new))
    # The first new position after missing rows may have been measured during the gap, so its time is unknown.
    steps = np.diff(seconds, prepend=seconds[0])
    median_step = np.median(steps[1:])
    has_gap = steps > MIN_GAP_RATIO * median_step
    if (is_measured & has_gap).sum() <= MAX_GAP_FRACTION * is_measured.sum() and (is_measured & ~has_gap).sum() > 2:
        is_measured &= ~has_gap
    # A row is in an outage if the next new position is late; missing rows do not count as an outage.
    elapsed = np.cumsum(np.where(has_gap, median_step, steps))
    intervals = np.diff(elapsed[is_measured], append=elapsed[-1])
    is_long = intervals > max(MIN_FREEZE_TIME, MIN_GAP_RATIO * float(np.median(intervals)))
    is_outage = is_long[np.cumsum(is_measured) - 1]
    for name in ("x", "y"):
        recorded = columns[name][rows]
        values = interp1d(seconds[is_measured], recorded[is_measured], fill_value="extrapolate")(seconds)
        columns[name] = columns[name].copy()
        columns[name][rows] = np.where(is_outage, recorded, values)
    n_frozen, rate = int(is_outage.sum()), 1.0 / float(np.median(np.diff(seconds[is_measured])))
    outages = f"; {format_count(n_frozen, len(rows), 'rows')} repeat a position for a long time" if n_frozen else ""
    warnings.append(f"{table.file}: positions change in {format_count(int(is_measured.sum()), len(rows), 'rows')}, "
                    f"about {rate:.3g} Hz; the positions of the other rows were interpolated{outages}")


def _is_rounded(values: np.ndarray) -> bool:
    """Whether a position [unit of the file] mostly changes by one unit of its last decimal, because it is rounded."""
    size = np.abs(np.diff(values))
    size = size[size > 0]
    if not len(size):
        return True
    digit = 10.0 ** np.round(np.log10(size.min()))
    is_digit = np.maximum(size / digit, digit / size) <= MAX_ROUNDING_RATIO
    digits = (values - np.quantile(values, 0.5, method="nearest")) / digit  # the origin need not be a multiple
    is_multiple = np.abs(digits - np.round(digits)) < MAX_ROUNDING_RATIO - 1.0
    return bool(digit <= 1.0 and min(is_digit.mean(), is_multiple.mean()) > MIN_REGULAR_FRACTION)


def _choose_steering(table: Table, columns: dict[str, np.ndarray], vehicle: VehicleParameters | None,
                     steering: SteeringField | None, warnings: list[str]) -> tuple[str, ...]:
    """Chooses the steering channels to read, applies the sign of an option, and computes the road wheel angle if there
    is only the steering wheel angle. Raises RunError if this requires a vehicle, but none is given."""
    if steering is not None and not steering.topic:
        channel, unused = (ROAD_WHEEL, STEERING_WHEEL) if steering.quantity == "road" else (STEERING_WHEEL, ROAD_WHEEL)
        columns[channel] = steering.sign * columns[channel]
        columns.pop(unused, None)
    if ROAD_WHEEL not in columns:
        if vehicle is None:
            raise RunError(table.file, "it has only the steering wheel angle (column "
                           f"{table.sources[STEERING_WHEEL].name}); the road wheel angle can be computed from it only "
                           "with the steering ratio and offset of the car", "specify the vehicle file of the car")
        columns[ROAD_WHEEL] = vehicle.road_wheel_angle(columns[STEERING_WHEEL])
        return (STEERING_WHEEL,)
    if STEERING_WHEEL not in columns:
        return (ROAD_WHEEL,)
    if _count_missing_samples(table.time_ns, columns[STEERING_WHEEL]) > 0.5 * len(columns[STEERING_WHEEL]):
        warnings.append(f"{table.file}: {STEERING_WHEEL} (column {table.sources[STEERING_WHEEL].name}) has no number "
                        "in more than half of the rows; the road wheel angle is used instead")
        return (ROAD_WHEEL,)
    return ROAD_WHEEL, STEERING_WHEEL


def _count_missing(table: Table, columns: Mapping[str, np.ndarray], steering: tuple[str, ...],
                   warnings: list[str]) -> dict[str, int]:
    """Channel -> number of usable rows without a number ("time": rows without a time); adds a warning about each."""
    channels = [name for name in (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS, *steering) if name in columns]
    counts = {"time": table.rows_without_time,
              **{name: _count_missing_samples(table.time_ns[table.is_usable], columns[name][table.is_usable])
                 for name in channels}}
    missing = {name: count for name, count in counts.items() if count}
    total = len(table.time_ns) + table.rows_without_time
    for name, count in missing.items():
        source = table.sources.get(name) or table.sources.get(COMPUTED_FROM.get(name, ""))
        is_mostly_missing = count > total / 2
        if name == "time":
            consequence = "these rows were left out"
        elif name in OPTIONAL_INS_SIGNALS:
            consequence = "it is not used" if is_mostly_missing else "it is unknown there"
        else:
            consequence = f"these {'steering' if name in steering else 'INS'} samples were left out"
        column = f" (column {source.name})" if source else ""
        warnings.append(f"{table.file}: {name}{column}: {format_count(count, total, 'rows')} have no number"
                        f"{', more than half' if is_mostly_missing else ''}; {consequence}")
    if ROAD_WHEEL not in steering and STEERING_WHEEL in missing:
        missing[ROAD_WHEEL] = missing.pop(STEERING_WHEEL)
    return missing


def _count_missing_samples(time_ns: np.ndarray, column: np.ndarray) -> int:
    """Number of rows (time_ns) without a number, except the blanks of a channel with a lower rate or other stamps."""
    known_rows = np.flatnonzero(np.isfinite(column))
    row_steps = np.diff(known_rows)
    row_step = int(np.median(row_steps)) if len(known_rows) >= 3 else 1
    if row_step > 1 and np.mean(row_steps % row_step == 0) > MIN_REGULAR_FRACTION:
        return int((np.maximum(np.round(row_steps / row_step), 1) - 1).sum())
    if row_step > 1 or 3 <= len(known_rows) < MIN_SIMILAR_RATE * len(column):
        steps = np.diff(time_ns[known_rows])
        step = float(np.median(steps))
        if step > 0 and np.mean(steps <= MIN_INTERVAL_RATIO * step) > MIN_REGULAR_FRACTION:
            ends = [] if row_step > 1 else [time_ns[known_rows[0]] - time_ns[0], time_ns[-1] - time_ns[known_rows[-1]]]
            # Rounded before they are added: a late stamp also shortens the next step.
            return max(int((np.round(steps / step) - 1).sum()), 0) + int(np.sum(ends) / step)
    return len(column) - len(known_rows)
