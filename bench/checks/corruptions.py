"""Faults: each corrupts a recording, and names the finding that `st check` must report.

An edit returns the corrupted recording and a number, from which `operation` gives the expected value of the finding:
"times": a factor; "plus": an offset; "is": the value itself; "named": the finding has no value.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from st_core.log import DriveLog

from .._drives import move_ins, rotate_ins
from . import faults as f
from . import visible as v
from .recording import (
    Recording,
    delay_channels,
    delay_series,
    with_good_quality,
    with_ins_speed,
    with_stamps,
    with_wheel_speed,
)

DEG, GON, G, FOOT, MPH, KMH = 57.29577951, 63.66197724, 9.80665, 3.280839895, 2.236936292, 3.6
"""Degrees and gon per rad, m/s^2 per g, feet per m, mph and km/h per m/s."""
Edit = Callable[[Recording, float], tuple[Recording, float]]


@dataclass(frozen=True)
class Size:
    """Size of a fault. fixed: it cannot be scaled (a unit). part: only the middle half of the drive is used."""

    label: str
    value: float
    fixed: bool = False
    part: bool = False


@dataclass(frozen=True)
class Fault:
    """A fault with its edit, two sizes, and the findings that are correct."""

    name: str
    findings: tuple[str, ...]  # their names
    operation: str  # see above
    edit: Edit
    sizes: tuple[Size, Size]
    is_visible: v.Condition  # whether a fault of this size is visible in a drive
    channel: str | None = None  # a channel that the finding must name
    # Permitted relative error of the value, for fractions, counts, steps and large factors.
    tolerance: float = 0.0
    also_permitted: tuple[str, ...] = ()  # further findings that may be reported
    prepare: Callable[[Recording], Recording] | None = None  # applied to the drive before the edit
    # In a real drive the fault gets the sign of the deviation that the drive already has, because with the other sign
    # they might cancel.
    follows_sign: bool = False


def scale(*channels: str) -> Edit:
    return lambda r, k: (r.with_log(**{c: x * k for c in channels if (x := getattr(r.log, c)) is not None}), k)


def shift(*channels: str) -> Edit:
    return lambda r, d: (r.with_log(**{c: x + d for c in channels if (x := getattr(r.log, c)) is not None}), d)


def delay(*channels: str) -> Edit:
    return lambda r, s: (delay_channels(r, s, *channels), s)


def edit_log(change: Callable[[DriveLog, float], DriveLog]) -> Edit:
    return lambda r, size: (replace(r, log=change(r.log, size)), size)


def negate(change: Edit) -> Edit:
    """The edit with the opposite sign: the INS point moves back, and the true value is negative."""
    return lambda r, size: change(r, -size)


def road_wheel_only(change: Edit) -> Edit:
    """The edit of a recording that contains only the road wheel angle."""
    return lambda r, size: change(r.with_log(steering_wheel_angle=None), size)


def steering_wheel_as_road_wheel(r: Recording, unit: float) -> tuple[Recording, float]:
    return scale("road_wheel_angle")(r.with_log(steering_wheel_angle=None), r.vehicle.steering_ratio * unit)


def scale_series(name: str) -> Edit:
    """Scales an auxiliary signal."""
    def edit(r: Recording, k: float) -> tuple[Recording, float]:
        series = getattr(r.auxiliary, name)
        return r.with_auxiliary(**{name: replace(series, values=series.values * k)}), k
    return edit


def delay_wheel_speed(r: Recording, seconds: float) -> tuple[Recording, float]:
    return r.with_auxiliary(wheel_speed=delay_series(r.auxiliary.wheel_speed, seconds)), seconds


def two_sizes(first: float, second: float, unit: str = "") -> tuple[Size, Size]:
    return tuple(Size(f"{value:g}{unit and ' ' + unit}", value) for value in (first, second))


def unit_sizes(first: tuple[str, float], second: tuple[str, float]) -> tuple[Size, Size]:
    return tuple(Size(label, value, fixed=True) for label, value in (first, second))


def whole_and_half(value: float) -> tuple[Size, Size]:
    return Size("whole drive", value, fixed=True), Size("half the drive", value, fixed=True, part=True)


POSITION, VELOCITY, WHEEL = ("x", "y"), ("velocity_x", "velocity_y"), ("road_wheel_angle", "steering_wheel_angle")
FINE = 0.05  # tolerance of fractions, counts and durations
COARSE = 0.25  # tolerance of values affected by errors of steering ratio, offset and stiffness in the vehicle file

TIME = (
    Fault("stamps in other units", ("time_unit",), "is", f.change_time_unit, unit_sizes(("ms", 1e3), ("us", 1e6)),
          v.moves, tolerance=FINE),
    Fault("gaps", ("time_gaps",), "is", f.remove_spans(0.25, 0.5, 0.75), two_sizes(1.0, 2.0, "s, three"), v.moves,
          tolerance=FINE),
    Fault("long gap", ("time_gaps",), "is", f.remove_spans(0.45), two_sizes(5.0, 10.0, "s, one"), v.moves,
          tolerance=FINE),
    Fault("stamps twice", ("time_duplicates",), "is", f.repeat_stamps, two_sizes(0.05, 0.2, "of the rows"), v.moves,
          tolerance=FINE, prepare=with_stamps),
    Fault("stamps out of order", ("time_order",), "is", f.swap_stamps, two_sizes(0.05, 0.2, "of the rows"), v.moves,
          tolerance=FINE, prepare=with_stamps),
    Fault("stamps jitter", ("time_jitter",), "is", f.add_jitter, two_sizes(0.006, 0.015, "s"), v.moves, tolerance=0.15),
    Fault("rows missing", ("values_missing",), "is", f.drop_rows, two_sizes(0.05, 0.2, "of the rows"), v.moves,
          tolerance=FINE),
)
POSITIONS = (
    Fault("x scaled", ("x_scale",), "times", scale("x"), two_sizes(0.964, 1.05), v.moves_in_x_and_y),
    Fault("y scaled", ("y_scale",), "times", scale("y"), two_sizes(0.964, 1.05), v.moves_in_x_and_y),
    Fault("positions in other units", ("position_scale",), "times", scale(*POSITION),
          unit_sizes(("feet", FOOT), ("mm", 1e3)), v.moves),
    Fault("axes exchanged", ("position_axes",), "named", f.exchange_axes, unit_sizes(("y, x", 1.0), ("-y, -x", -1.0)),
          v.moves_in_x_and_y),
    Fault("axis mirrored", ("position_axes",), "named", f.mirror_axis, unit_sizes(("x", 0.0), ("y", 1.0)),
          v.moves_in_x_and_y),
    Fault("positions late", ("position_lag",), "plus", delay(*POSITION), two_sizes(0.05, 0.2, "s"),
          v.turns_and_accelerates),
    Fault("positions stale", ("position_stale",), "is", f.make_positions_stale, two_sizes(0.1, 0.3, "of the rows"),
          v.moves, tolerance=FINE, also_permitted=("samples_repeated",)),
    Fault("positions jump every second", ("position_jumps",), "is", f.jump_every_second, two_sizes(0.3, 1.0, "m"),
          v.moves, tolerance=FINE),
    Fault("positions jump once", ("position_jumps",), "is", f.jump_once, two_sizes(0.5, 6.0, "m"), v.moves),
    Fault("reference point of positions", ("position_reference",), "plus", edit_log(f.move_positions_ahead),
          two_sizes(0.7, 1.5, "m"), v.curves_at_several_speeds),
    Fault("positions rounded", ("resolution_coarse",), "is", f.round_channels(*POSITION), two_sizes(0.25, 1.0, "m"),
          v.moves, channel="x", tolerance=FINE, also_permitted=("samples_repeated",)),
)
YAW = (
    Fault("yaw in other units", ("yaw_scale",), "times", scale("yaw"), unit_sizes(("deg", DEG), ("gon", GON)), v.turns),
    Fault("yaw in degrees, wrapped", ("yaw_scale",), "times", f.to_wrapped_degrees, whole_and_half(DEG), v.turns),
    Fault("compass heading", ("yaw_convention",), "named", f.to_compass, whole_and_half(1.0), v.turns),
    Fault("yaw offset", ("yaw_offset",), "plus", shift("yaw"), two_sizes(0.02, 0.06, "rad"), v.has_varying_curvature,
          follows_sign=True),
    Fault("yaw late", ("yaw_lag",), "plus", delay("yaw"), two_sizes(0.1, 0.3, "s"), v.turns),
    Fault("yaw rounded", ("resolution_coarse",), "is", f.round_channels("yaw"),
          (Size("1 deg", 1 / DEG), Size("2 deg", 2 / DEG)), v.turns, channel="yaw", tolerance=FINE,
          also_permitted=("samples_repeated",)),
    Fault("yaw rate in other units", ("yaw_rate_scale",), "times", scale("yaw_rate"),
          unit_sizes(("deg/s", DEG), ("mrad/s", 1e3)), v.turns),
    Fault("yaw rate sign", ("yaw_rate_scale",), "times", scale("yaw_rate"), whole_and_half(-1.0), v.turns),
    Fault("yaw rate scaled", ("yaw_rate_scale",), "times", scale("yaw_rate"), two_sizes(1.05, 1.15), v.turns),
    Fault("yaw rate bias", ("yaw_rate_bias",), "plus", shift("yaw_rate"), two_sizes(0.01, 0.03, "rad/s"), v.moves,
          follows_sign=True),
    Fault("yaw rate late", ("yaw_rate_lag",), "plus", delay("yaw_rate"), two_sizes(0.1, 0.3, "s"), v.turns),
    Fault("yaw rate held", ("samples_repeated",), "is", f.hold_values("yaw_rate"), two_sizes(5.0, 2.0, "Hz"), v.turns,
          channel="yaw_rate", tolerance=FINE, also_permitted=("yaw_rate_lag", "resolution_coarse")),
    Fault("yaw rate frozen", ("channel_frozen",), "is", f.freeze("yaw_rate"), two_sizes(10.0, 30.0, "s"),
          v.long_enough("yaw_rate"), channel="yaw_rate", tolerance=FINE, also_permitted=("samples_repeated",)),
)
VELOCITIES = (
    Fault("velocity_x in other units", ("velocity_x_scale",), "times", scale("velocity_x"),
          unit_sizes(("km/h", KMH), ("mph", MPH)), v.curves_with_sideslip),
    Fault("velocities in other units", ("velocity_scale",), "times", scale(*VELOCITY),
          unit_sizes(("km/h", KMH), ("mph", MPH)), v.curves_with_sideslip),
    # An error of a few per cent does not show whether v_y is wrong as well.
    Fault("velocity_x scaled", ("velocity_x_scale", "velocity_scale"), "times", scale("velocity_x"),
          two_sizes(1.03, 1.10), v.moves),
    Fault("velocity_y sign", ("velocity_y_scale",), "times", scale("velocity_y"), whole_and_half(-1.0),
          v.curves_with_sideslip),
    Fault("velocities late", ("velocity_lag",), "plus", delay(*VELOCITY), two_sizes(0.15, 0.4, "s"),
          v.turns_and_accelerates),
    Fault("velocity at standstill", ("standstill_motion",), "is", f.creep, two_sizes(0.1, 0.3, "m/s"), v.stops,
          tolerance=FINE),
)
ACCELERATIONS = (
    Fault("a_y in other units", ("acceleration_y_scale",), "times", scale("acceleration_y"),
          unit_sizes(("g", 1 / G), ("ft/s^2", FOOT)), v.corners),
    Fault("a_y sign", ("acceleration_y_scale",), "times", scale("acceleration_y"), whole_and_half(-1.0), v.corners),
    Fault("a_y bias", ("acceleration_y_bias",), "plus", shift("acceleration_y"), two_sizes(0.4, 1.0, "m/s^2"),
          v.has_a_y, follows_sign=True),
    Fault("a_y late", ("acceleration_y_lag",), "plus", delay("acceleration_y"), two_sizes(0.2, 0.4, "s"),
          v.corners_fast),
    Fault("a_x in other units", ("acceleration_x_scale",), "times", scale("acceleration_x"),
          unit_sizes(("g", 1 / G), ("ft/s^2", FOOT)), v.accelerates),
    Fault("a_x sign", ("acceleration_x_scale",), "times", scale("acceleration_x"), whole_and_half(-1.0), v.accelerates),
    Fault("a_x bias", ("acceleration_x_bias",), "plus", shift("acceleration_x"), two_sizes(0.3, 0.8, "m/s^2"),
          v.has_a_x, follows_sign=True),
    Fault("a_x late", ("acceleration_x_lag",), "plus", delay("acceleration_x"), two_sizes(0.15, 0.4, "s"),
          v.accelerates),
)
STEERING = (
    Fault("steering in other units", ("steering_scale",), "times", road_wheel_only(scale("road_wheel_angle")),
          unit_sizes(("deg", DEG), ("mrad", 1e3)), v.steers, tolerance=COARSE),
    Fault("hand wheel for road wheels", ("steering_scale",), "times", steering_wheel_as_road_wheel,
          unit_sizes(("rad", 1.0), ("deg", DEG)), v.steers, tolerance=COARSE),
    Fault("steering sign", ("steering_sign",), "is", scale(*WHEEL), whole_and_half(-1.0), v.steers, tolerance=COARSE),
    Fault("steering late", ("steering_lag",), "plus", delay(*WHEEL), two_sizes(0.3, 0.6, "s"), v.steers_in_curves),
    Fault("steering offset", ("steering_offset",), "plus", road_wheel_only(shift("road_wheel_angle")),
          two_sizes(0.03, 0.08, "rad"), v.steers_in_curves, follows_sign=True),
    Fault("steering frozen", ("channel_frozen",), "is", f.freeze(*WHEEL), two_sizes(10.0, 30.0, "s"),
          v.long_enough("road_wheel_angle"), channel="road_wheel_angle", tolerance=FINE,
          also_permitted=("samples_repeated",)),
)
INS = (
    Fault("measuring point moved back", ("measuring_point",), "plus", negate(edit_log(move_ins)),
          two_sizes(0.8, 1.5, "m"), v.curves_at_low_speed),
    Fault("INS askew", ("heading_misaligned",), "plus", edit_log(rotate_ins), two_sizes(0.02, 0.05, "rad"),
          v.curves_and_straights, follows_sign=True),
    Fault("without RTK", ("ins_mode",), "is", f.lose_rtk, two_sizes(0.2, 0.6, "of the time"), v.moves, tolerance=FINE,
          prepare=with_good_quality),
    Fault("poor accuracy", ("ins_accuracy",), "is", f.worsen_accuracy, two_sizes(0.5, 2.0, "m"), v.moves,
          tolerance=FINE, prepare=with_good_quality),
    Fault("wheel speed scaled", ("wheel_speed_scale",), "times", scale_series("wheel_speed"), two_sizes(1.05, 1.15),
          v.moves, prepare=with_wheel_speed),
    Fault("wheel speed late", ("wheel_speed_lag",), "plus", delay_wheel_speed, two_sizes(0.3, 0.6, "s"), v.accelerates,
          prepare=with_wheel_speed),
    Fault("other INS output scaled", ("ins_speed_scale",), "times", scale_series("ins_speed"), two_sizes(1.05, 1.15),
          v.moves, prepare=with_ins_speed),
)
FAULTS = {fault.name: fault for fault in (*TIME, *POSITIONS, *YAW, *VELOCITIES, *ACCELERATIONS, *STEERING, *INS)}
