"""Finds the column and the unit of each channel of a table from the names in its header."""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from canedge_bridge.units import UNITS, find_unit, normalise

from .errors import RunError


@dataclass(frozen=True)
class Channel:
    """A channel of a drive and the possible names of its column."""

    kind: str  # kind of quantity, a key of UNITS
    meaning: str  # description for users
    names: str  # in order of preference, separated by blanks; compared by letters and digits only, ignoring case


MOTION_CHANNELS = frozenset({"velocity_x", "yaw_rate", "yaw"})  # a table with one of them is not a CAN log
COLUMNS: Mapping[str, Channel] = {
    "t": Channel("time", "time", (
        "t time t_rt timestamp timestamps stamp time_boot sim_time log_time relative_time elapsed elapsed_time "
        "session_time seconds unix_time utc_time gps_time time_utc time_gps gps_tow tow gps_seconds time_of_week itow "
        "datetime epoch epoch_time time_from_start log_mono_time ins_time time_since_start_of_day time_of_day "
        "gps_ins_time utc zeit uhrzeit zeitstempel datum_zeit x_value 时间")),
    **{axis: Channel("length", f"position of the INS point, {direction} or along the map's {axis}", (
        f"{axis} pos_{axis} position_{axis} {axis}_pos {axis}_position p{axis} {direction} {direction}ing "
        f"{direction[0]}_pos pos_{direction[0]} {axis}_{direction} {axis}_enu {axis}_map local_{axis} utm_{axis} "
        f"utm_{direction[0]} utm_{direction}ing pos_local_{axis} car_t{axis} {axis}o {axis}_absolute location_{axis} "
        f"pose_{axis} pose_position_{axis} pose_pose_position_{axis} {axis}坐标"))
        for axis, direction in (("x", "east"), ("y", "north"))},
    "latitude": Channel("latitude or longitude", "positive to the north; read if x and y are missing", (
        "latitude lat latitude_deg pos_lat ins_lat_abs breitengrad 纬度")),
    "longitude": Channel("latitude or longitude", "positive to the east; the first fix is the map origin", (
        "longitude long lon lng pos_lon ins_long_abs laengengrad 经度")),
    "yaw": Channel("angle", "from east (the map's x), counter-clockwise", (
        "yaw yaw_angle yaw_iso yaw_enu heading_enu psi psi_iso theta phi pose_theta gierwinkel 横摆角")),
    "compass_heading": Channel("angle", "true heading, clockwise from north; read if yaw is missing: yaw = 90° - "
                               "heading", (
        "compass_heading heading heading_angle angle_heading heading_ned heading_north heading_true true_heading "
        "compass azimuth yaw_ned true_head")),
    "course": Channel("angle", "direction of motion over ground, clockwise from north; replaces missing yaw or "
                      "velocity_y", (
        "course course_over_ground course_angle gps_heading gnss_heading cog heading_cog track track_angle "
        "heading_of_motion bearing angle_track kurs_ueber_grund gcrs kurs")),
    **{f"orientation_{axis}": Channel("ratio", "quaternion from body to map axes, read if yaw is missing", (
        f"pose_pose_orientation_{axis} pose_orientation_{axis} orientation_{axis} q{axis} quat_{axis}"))
       for axis in "xyzw"},
    "velocity_x": Channel("speed", "forward, body axes, at the INS point", (
        "iso_vs_longitudinal_velocity velocity_x vx vel_x velocity_forward vel_forward v_forward forward_velocity "
        "forward_vel vel_fwd v_fwd velocity_longitudinal longitudinal_velocity v_longitudinal v_long vel_long v_lon "
        "vel_lon long_vel long_velocity speed_forward forward_speed longitudinal_speed twist_linear_x "
        "twist_twist_linear_x linear_velocity_x x_velocity linear_vel_x linear_vels_x v_ego v_laengs "
        "laengsgeschwindigkeit speed velocity vel v ground_speed speed_over_ground gps_speed speed_gps geschwindigkeit "
        "spd v_gps ins_vel_hor_x 纵向速度")),
    "velocity_y": Channel("speed", "to the left, body axes, at the INS point; if missing, derived or 0", (
        "iso_vs_lateral_velocity velocity_y vy vel_y velocity_lateral vel_lateral v_lateral lateral_velocity "
        "横向速度 lateral_vel v_lat vel_lat lat_vel lat_velocity velocity_left vel_left lateral_speed twist_linear_y "
        "twist_twist_linear_y linear_velocity_y y_velocity linear_vel_y linear_vels_y v_quer quergeschwindigkeit "
        "ins_vel_hor_y")),
    **{f"velocity_{axis}": Channel("speed", meaning, (
        f"velocity_{axis} vel_{axis} v_{axis} {axis}_velocity {axis}_vel {axis}_speed velocity_{axis[0]} "
        f"vel_{axis[0]} vel_ned_{axis[0]} v{axis[0]}")) for axis, meaning in (
            ("east", "read with velocity_north and yaw if velocity_y is missing"),
            ("north", "read with velocity_east and yaw if velocity_y is missing"))},
    "yaw_rate": Channel("angular rate", "positive in left turns; if missing, the derivative of yaw", (
        "iso_vs_yaw_velocity yaw_rate yaw_rate_iso yaw_velocity yaw_vel yaw_speed yaw_dot psi_dot psi_p d_psi r avz wz "
        "omega_z omega angular_velocity_z angular_rate_z z_angular_rate angle_rate_z ang_vel_z ang_vels_z "
        "angular_vel_z angular_z rate_z gyro_z gyr_z twist_angular_z twist_twist_angular_z heading_rate gierrate "
        "giergeschwindigkeit 横摆角速度")),
    "acceleration_x": Channel("acceleration", "forward, body axes", (
        "iso_vs_longitudinal_acceleration acceleration_x acceleration_forward acc_forward accel_forward "
        "acceleration_longitudinal longitudinal_acceleration longitudinal_accel longitudinal_acc acc_longitudinal "
        "a_longitudinal a_long acc_long accel_long long_acc long_accel lon_acc lon_accel a_laengs laengsbeschleunigung "
        "linear_acceleration_x ax acc_x accel_x x_acc x_accel 纵向加速度")),
    "acceleration_y": Channel("acceleration", "to the left, body axes", (
        "iso_vs_lateral_acceleration acceleration_y acceleration_left acceleration_lateral lateral_acceleration "
        "lateral_accel lateral_acc acc_lateral accel_lateral a_lateral a_lat acc_lat accel_lat lat_acc lat_accel "
        "a_quer querbeschleunigung linear_acceleration_y ay acc_y accel_y y_acc y_accel 横向加速度")),
    "road_wheel_angle": Channel("angle", "mean of the front wheels, positive to the left", (
        "road_wheel_angle delta delta_f delta_front df rwa front_wheel_angle front_steering_angle front_steer_angle "
        "steering_angle_front steer_angle_front road_steering_angle steering_angle_road wheel_angle tire_angle "
        "tyre_angle steering_tire_angle ackermann_angle radlenkwinkel 前轮转角")),
    "steering_wheel_angle": Channel("angle", "steering wheel, positive to the left, offset not removed", (
        "steering_wheel_angle steering_wheel steering_wheel_position steering_wheel_pos steer_wheel_angle "
        "steering_wheel_angle_iso hand_wheel_angle hand_wheel handwheel_position swa delta_h delta_hand delta_sw "
        "dm_steer_ang steer_whl_ang steer_sw lenkradwinkel 方向盘转角")),
    **{f"wheel_speed_{end}_{side}": Channel("speed", "rolling speed of a wheel; for checks", (
        f"wheel_speed_{end}_{side} wheel_speed_{end[0]}{side[0]} ws_{end[0]}{side[0]} v_{end[0]}{side[0]} "
        f"{end}_{side}_wheel_speed")) for end in ("front", "rear") for side in ("left", "right")},
    "vehicle_speed": Channel("speed", "speed signal of the car; for checks", (
        "vehicle_speed car_speed can_speed speed_can obd_speed speed_obd abs_speed odometer_speed wheel_speed "
        "wheel_speeds")),
}
"""All known columns; test_csv_columns.py compares docs/csv_columns.md with this table."""

AMBIGUOUS_STEERING = {*map(normalise, (
    "steering_angle", "steering", "steer", "steer_angle", "steered_angle", "steering_position", "steering_pos",
    "delta_wheel"))}
"""Names that mean the steering wheel in some files and the road wheels in others."""

MAX_NAME_LENGTH = 200  # characters; of a longer name, only the end is used
PATH_RANK = 1000  # added for a name after a path (/odom/twist/twist/linear/x of PlotJuggler) or a source (ego_vx)
DOUBTFUL_RANK = 500  # of theta and phi, which may be pitch and roll; read as yaw if no other column is a heading
_OTHER_QUANTITY = re.compile(
    r"(?i)(^|[^a-z])(ref|target|desired|set|cmd|command|request|control|goal|limit|plan|pred|std|(?<!with.)cov|var|err|"
    r"max|min|engine|motor|wind|trailer|lead|object|obstacle|radar|fan|traffic|other)")
"""Words which show that a name with a path or a source is not a measured quantity of this car."""
_SOURCE = (r"(?:gps|gnss|ins|imu|ego|car|veh|vehicle|odom|odometry|can|chassis|pose|state|est|estimated|meas|measured|"
           r"act|actual|raw|filt|filtered|sensor|iso_vs|iso|cg|cog)")  # where a value comes from, not what it is
_DERIVATIVE = re.compile(r"(?i)(veloc|accel|(^|[^a-z])rates|angular_?rate|force|torque|moment)[^/.]*[/.]+$")
"""End of a path which shows that a name such as yaw is not an angle or a position: velocities.yaw is a rate."""
_PATH = re.compile(rf"(?i)^{_SOURCE}[ _-]+|[/.]+|::")
_CAMEL_CASE = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")
_SUFFIX = re.compile(rf"(?i)[ _-]+(?:{_SOURCE}|obd|canbus|calc)$")

_FRACTION = re.compile(r"(.*?)(n|nano|u|micro|m|milli)(s|secs?|seconds?|(?<=nano))")  # name of fractions of a second
_FRACTION_FACTORS = {"n": 1e-9, "nano": 1e-9, "u": 1e-6, "micro": 1e-6, "m": 1e-3, "milli": 1e-3}

_DIRECTION = "direction"  # the course if the unit of an angle is stated, as in phyphox; else perhaps 1 or -1
_STEERING = "steering"  # angle of the steering wheel or of the road wheels; the name is ambiguous
_KINDS_BY_CHANNEL = {**{channel: definition.kind for channel, definition in COLUMNS.items()}, _STEERING: "angle"}
_CHANNELS_BY_NAME = {**dict.fromkeys(AMBIGUOUS_STEERING, (_STEERING, 0)),
                     **{normalise(name): (channel, rank) for channel, definition in COLUMNS.items()
                        for rank, name in enumerate(definition.names.split())},
                     **dict.fromkeys(("theta", "phi"), ("yaw", DOUBTFUL_RANK)), _DIRECTION: ("course", DOUBTFUL_RANK)}


@dataclass(frozen=True)
class Layout:
    """Columns and units stated in a run.yaml or by an option."""

    columns: Mapping[str, str] = field(default_factory=dict)  # channel -> column name
    units: Mapping[str, str] = field(default_factory=dict)  # channel -> unit
    source: Path | str | None = field(default=None, repr=False)  # the run.yaml or option, for error messages


@dataclass(frozen=True)
class ColumnSource:
    """The column of a channel and its unit."""

    column: int
    name: str
    kind: str  # a key of UNITS
    unit: str
    has_stated_unit: bool  # whether the file or the layout states the unit

    @property
    def factor(self) -> float:
        return UNITS[self.kind][self.unit][0]


class _ColumnName(NamedTuple):
    channel: str  # a key of COLUMNS, or _STEERING
    rank: int  # position among the names of the channel, plus PATH_RANK after a path
    unit: str | None  # as stated in the name
    path: str  # text before the name of the channel


def find_columns(file: Path, names: Sequence[str], layout: Layout) -> dict[str, ColumnSource]:
    """Finds the channels in a header. Raises RunError if a column or a channel that the layout names is missing."""
    by_name = {channel: sources[0] for channel, sources in _find_best_columns(names).items() if len(sources) == 1}
    sources = dict(by_name)
    for channel, column_name in layout.columns.items():
        if column_name not in names and column_name in by_name:  # names a channel: {x: y, y: x} swaps the axes
            column: int | None = by_name[column_name].column
        else:  # an exact match, or else one that ignores case, then also punctuation, then also the unit
            column = next((number for form in (str, str.lower, normalise, _without_unit)
                           for number, name in enumerate(names) if form(name) == form(column_name)), None)
        if column is None:
            raise RunError(layout.source or file, f"columns: {channel}: {file.name} has no column {column_name[:60]!r}",
                           f"its columns are {', '.join(names)[:300]}")
        kind = COLUMNS[channel].kind
        unit = find_stated_unit(names[column], kind) or find_stated_unit(column_name, kind)
        sources[channel] = _make_source(column, names[column], channel, unit)
    time, stamp = sources.get("t"), find_stamp_columns(names)
    is_time_stated = "t" in layout.columns or "t" in layout.units
    # A stamp in two columns is preferred to a time that is only its fraction, or is in minutes or hours.
    if stamp and (time is None or (not is_time_stated and (time.column == stamp[1] or time.factor > 1.0))):
        sources["t"] = _make_source(stamp[0], names[stamp[0]], "t", "s")
    if "compass_heading" in layout.columns and "yaw" not in layout.columns:
        sources.pop("yaw", None)
    return apply_units(file, sources, layout)


def _find_best_columns(names: Sequence[str]) -> dict[str, list[ColumnSource]]:
    """Channel -> its column with the best name; several if equally good names differ in their paths or are doubtful."""
    paths = {parsed.path for name in names if (parsed := _identify_channel(name))} - {""}
    columns: dict[str, list[ColumnSource]] = {}
    best: dict[str, _ColumnName] = {}  # of the last column in `columns`
    for number, name in enumerate(names):
        parsed = _identify_channel(name, paths)
        if parsed is None or parsed.channel == _STEERING:
            continue
        channel, rank, unit, path = parsed
        previous = best.get(channel)
        is_same = previous is not None and rank == previous.rank and bool(path) and path == previous.path
        if previous is None or rank < previous.rank or (is_same and unit and not previous.unit):
            columns[channel] = []  # yaw and yaw_deg after one path are one quantity
        elif is_same or rank != previous.rank or rank < DOUBTFUL_RANK or name == columns[channel][-1].name:
            continue
        columns[channel].append(_make_source(number, name, channel, unit))
        best[channel] = parsed
    headings = columns.keys() & {"compass_heading", "course", "orientation_w"}
    if headings and "yaw" in best and best["yaw"].rank % PATH_RANK == DOUBTFUL_RANK:
        del columns["yaw"]
    forward = columns.get("velocity_x", [])
    if [_without_unit(source.name) for source in forward] == ["v"] and "u" in (
            bare_names := [*map(_without_unit, names[:forward[0].column])]):
        number = bare_names.index("u")  # u and v may be the forward and the lateral velocity
        forward.insert(0, _make_source(number, names[number], "velocity_x", None))
    return columns


def find_times(names: Sequence[str]) -> list[ColumnSource]:
    """Finds all columns with times."""
    return [_make_source(number, name, "t", parsed.unit) for number, name in enumerate(names)
            if (parsed := _identify_channel(name)) and parsed.channel == "t"]


def find_ambiguous(names: Sequence[str]) -> dict[str, list[str]]:
    """Channel -> names of its columns, for the channels that have several columns with equally good names."""
    return {channel: [source.name for source in sources] for channel, sources in _find_best_columns(names).items()
            if len(sources) > 1}


def find_stamp_columns(names: Sequence[str]) -> tuple[int, int, float] | None:
    """(column of the seconds, column of their fraction, unit of the fraction [s]) of a stamp in two columns, such as
    header.stamp.sec and nanosec (ROS), tv_sec and tv_usec, time_s and time_ms, Time and Millisecond or Time_ms."""
    normalised = [normalise(name) for name in names]
    for number, name in enumerate(normalised):
        if not (match := _FRACTION.fullmatch(name)):
            continue
        stem, unit, ending = match.groups()
        is_time = _CHANNELS_BY_NAME.get(stem, ("", 0))[0] == "t"  # a_s and a_ms may be an acceleration
        endings = ("sec", "secs", "second", "seconds") if ending != "s" else ("s",) if is_time else ()
        for seconds in endings:
            if stem + seconds in normalised:
                return normalised.index(stem + seconds), number, _FRACTION_FACTORS[unit]
        if "/" in names[number]:  # m/s is a speed
            continue
        for time in (*_find_best_columns(names).get("t", []), *(find_times(names) if stem else ())):
            if time.factor == 1.0 and stem in ("", _without_unit(time.name)):
                return time.column, number, _FRACTION_FACTORS[unit]
    return None


def add_fraction(seconds: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Adds fractions to whole seconds [s]; returns `seconds` if they are not whole or a fraction is 1 s or more."""
    is_pair = not np.nan_to_num(seconds % 1.0).any() and np.nanmax(fraction, initial=0.0) < 1.0
    return seconds + np.nan_to_num(fraction) if is_pair else seconds


def apply_units(file: Path, sources: dict[str, ColumnSource], layout: Layout) -> dict[str, ColumnSource]:
    """Applies the units that the layout states. Raises RunError if a channel with a unit has no column."""
    for channel, unit in layout.units.items():
        if channel not in sources:
            raise RunError(layout.source or file, f"units: {channel}: {file.name} has no column for this channel",
                           f"it has columns for {', '.join(sources)}")
        sources[channel] = replace(sources[channel], unit=unit, has_stated_unit=True)
    return sources


def find_ambiguous_steering(names: Sequence[str]) -> str | None:
    """Finds the first column that may be the steering wheel or the road wheel angle; None if there is none."""
    return next((name for name in names if (parsed := _identify_channel(name)) and parsed.channel == _STEERING), None)


def find_missing(sources: Iterable[str], names: Iterable[str], required: Iterable[str],
                          with_derived_motion: bool = True) -> list[str]:
    """The required channels that cannot be read or derived. with_derived_motion: whether velocity_y and yaw_rate may be
    derived."""
    channels = set(sources)
    if channels & {"compass_heading", "course"} or channels.issuperset(f"orientation_{axis}" for axis in "xyzw"):
        channels.add("yaw")
    if channels >= {"yaw", "velocity_east", "velocity_north"}:
        channels |= {"velocity_x", "velocity_y"}
    if with_derived_motion and channels >= {"velocity_x", "yaw"}:
        channels |= {"velocity_y", "yaw_rate"}
    if channels >= {"latitude", "longitude"}:
        channels |= {"x", "y"}
    if "steering_wheel_angle" in channels or find_ambiguous_steering(list(names)):
        channels.add("road_wheel_angle")
    return [name for name in required if name not in channels]


def _make_source(number: int, name: str, channel: str, unit: str | None) -> ColumnSource:
    kind = COLUMNS[channel].kind
    return ColumnSource(number, name, kind, unit or next(iter(UNITS[kind])), unit is not None)


def _identify_channel(name: str, paths: Collection[str] = ()) -> _ColumnName | None:
    """Identifies the channel of a column; None for other columns. A single letter after a path denotes a channel only
    if the path is one of `paths`: state.x is a position if there is a state.yaw, acceleration.x is not."""
    # "%time" and "field.x" from `rostopic echo -p`, "vx\\CCP:1" from ETAS, "Speed (m/s) *gps" from RaceChrono
    name = re.sub(r"(?<=\w)\\.*$| \*\w+$", "", name.lstrip("%# ").removeprefix("field."))[-MAX_NAME_LENGTH:]
    name = _CAMEL_CASE.sub("_", name)
    for start in _find_starts(name):
        for base, unit in _split_name_and_unit(name[start:]):
            for form in (base, _SUFFIX.sub("", base)):
                channel, rank = _CHANNELS_BY_NAME.get(normalise(form), ("", 0))
                known_unit = find_unit(_KINDS_BY_CHANNEL[channel], unit) if channel else None
                if not channel or (unit and known_unit is None) or (normalise(form) == _DIRECTION and not known_unit):
                    continue
                if start == 0 and form == base:
                    return _ColumnName(channel, rank, known_unit or None, "")
                if channel != "t" and (len(normalise(form)) > 1 or name[:start] in paths) and not (
                        _OTHER_QUANTITY.search(name) or (_KINDS_BY_CHANNEL[channel] in (
                            "angle", "length", "latitude or longitude") and _DERIVATIVE.search(name[:start]))):
                    return _ColumnName(channel, rank + PATH_RANK, known_unit or None, name[:start])
    return None


def _find_starts(name: str) -> Iterator[int]:
    """Indices at which the name of a channel may start: the first, and each after a separator of a path."""
    yield 0
    path = re.split(r"[(\[{]", name)[0]
    if re.match(r"[^\W\d]|/", path):  # not a number such as 0.123
        yield from (mark.end() for mark in _PATH.finditer(path))


def describe_unknown_units(names: Sequence[str], sources: Mapping[str, ColumnSource]) -> dict[str, str]:
    """Channel -> message, for each channel with a column that is not used because its unit is unknown."""
    messages = {}
    for name in names:
        base, unit = _split_name_and_unit(name)[0]
        channel, _ = _CHANNELS_BY_NAME.get(normalise(base), ("", 0))
        if unit and channel and channel not in sources and find_unit(_KINDS_BY_CHANNEL[channel], unit) is None:
            kind = _KINDS_BY_CHANNEL[channel]
            messages[channel] = (f"column {name} is not used: {unit!r} is not a unit of {kind} (known units are "
                                 f"{', '.join(UNITS[kind])})")
    return messages


def _split_name_and_unit(name: str) -> list[tuple[str, str]]:
    """Possible splits of a column name into (name, unit); if no unit is in brackets, the first is (whole name, "")."""
    match = re.fullmatch(r"(.*?)[\s_]*[\[({]([^\])}]*)[\])}]\s*", re.sub(r"(?<=.)\|(.+)\|\s*$", r"[\1]", name))
    if match:
        base, unit = match.groups()
        return [(base, "" if unit.strip() in ("", "-") else unit)]
    words = _CAMEL_CASE.sub("_", name)
    marks = [m.start() for m in re.finditer(r"[\s_,/.:|-]+", words)]
    return [(name, ""), *((words[:at], words[at:]) for at in marks if at)]


def find_stated_unit(name: str, kind: str) -> str | None:
    """The unit of this kind of quantity at the end of a name, such as deg of angle_deg; None if there is none."""
    return next((unit for base, text in _split_name_and_unit(name) if base and text and (
        unit := find_unit(kind, text))), None)


def _without_unit(name: str) -> str:
    return normalise(_split_name_and_unit(name)[0][0])
