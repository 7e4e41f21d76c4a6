"""Aligns the clocks of an INS recording and a CAN log using the signals that both contain."""

from dataclasses import replace

import numpy as np
from st_core.checks.plausibility import find_implausible_samples
from st_core.clock_alignment import align, align_by_time_frame, manual_alignment, mask_standstill
from st_core.clock_types import Alignment, SharedSignal, Verdict, refused_alignment

from .can_signals import CanSignals, Signal
from .ins_log import InsLog

# Delays [s]: (expected value, standard deviation).
INS_ON_CAN_DELAY = (0.002, 0.002)  # from the measurement of an INS value to its frame in the log; default
WHEEL_SPEED_DELAY = (0.015, 0.015)  # wheel pulses are counted over a period before the speed is sent
# Standard deviation of the ratio of longitudinal slip to acceleration [s^2/m]; slip shifts a wheel speed in time by
# this ratio times the speed. The ratio is 0.003 for a braked rear axle, 0.007 if it is driven, 0 if it rolls freely.
SLIP_PER_ACCELERATION_DEVIATION = 0.002
STEERING_DELAY = (-0.06, 0.06)  # negative, because steering leads the yaw rate by the response time of the car

NO_INS_FRAMES = "the DBC describes no INS frames of this log (RT_..., as in the rt.dbc that `st car new` writes)"
OTHER_CLOCK = ("the INS time in the CAN log does not overlap the times of the INS recording: is it from a different "
               "drive, in a different time zone, or in GPS time?")

MIN_VARIATION = {"speed": 0.3, "rate": 0.01, "angle": 0.05, "curvature": 0.001}
"""Minimum standard deviation [m/s, rad/s, rad, 1/m] of a signal that is used for alignment."""
MIN_CURVATURE_SPEED = 3.0  # m/s; at lower speeds, the curvature (yaw rate divided by speed) is noise
MIN_MOVING_SPEED = 1.0  # m/s; above it, the car counts as moving in the search for implausible values
TIME_FRAME_RESOLUTION = {"RT_MilliTime": 0.001, "RT_DateTime": 0.01}  # s, of the time in each message
MAX_METHOD_DIFFERENCE = 0.01  # s, between the offsets from the INS time on CAN and from the shared signals
MAX_CLOCK_ERROR = 60.0  # s, assumed for the clock of the logger if the signals allow several offsets
MIN_RELATIVE_PEAK = 0.97  # minimum ratio of the correlation near the logger's clock to the highest correlation
CHECK_SEARCH = 2.0  # s, search range on both sides of the offset from the INS time on CAN
# Signal of the log -> channel with the plausibility limits that apply to it
PLAUSIBILITY_CHANNELS = {"ins_velocity_x": "velocity_x", "ins_yaw_rate": "yaw_rate", "ins_yaw": "yaw",
                         "vehicle_speed": "velocity_x", "wheel_speed_rear_left": "velocity_x",
                         "wheel_speed_rear_right": "velocity_x", "steering_wheel_angle": "steering_wheel_angle"}


def align_clocks(ins: InsLog, can: CanSignals, offset: float | None = None, search: tuple[float, float] | None = None,
                 latency: tuple[float, float] = INS_ON_CAN_DELAY,
                 steering_sign: int = 1) -> tuple[Alignment, list[SharedSignal]]:
    """Aligns the clocks by the first available of: a given offset; the INS time on CAN, checked with shared signals;
    shared signals; substitute signals (then doubtful at best). Without any of these, refuses the alignment.

    offset: INS minus CAN clock [s]. search: bounds of an offset estimated without the INS time [s]. latency: delay of
    INS values on CAN and its standard deviation [s]. steering_sign: +1 if the decoded angle is positive to the left.
    Returns (alignment, signals that it uses or that can check it).
    """
    ins, can, notes = mask_implausible(ins, can)
    pairs, warning = pair_shared_signals(ins, can, latency), ""
    if not pairs:
        pairs, warning = pair_substitute_signals(ins, can, steering_sign)
    time_frames = [signal for signal in can.find_all("ins_unix_time") if np.isfinite(signal.values).sum() > 1]
    # The recording may be in a different time zone, or in GPS time.
    is_other_clock = ins.is_utc and len(time_frames) > 0 and not any(
        np.nanmin(frame.values) * 1e9 < ins.time_ns[-1] and np.nanmax(frame.values) * 1e9 > ins.time_ns[0]
        for frame in time_frames)
    if offset is not None:
        at_ns = int(pairs[0].other_time_ns[0]) if pairs else 0
        alignment = manual_alignment(round(offset * 1e9), at_ns, pairs)
    elif ins.is_utc and time_frames and not is_other_clock:
        finest_frame = min(time_frames, key=lambda s: TIME_FRAME_RESOLUTION.get(s.message, 1.0))
        alignment = _align_by_ins_time(finest_frame, pairs if not warning else [], latency)
    elif not pairs:
        reason = "the CAN log and the INS recording have no signal in common; give the offset (--offset)"
        return refused_alignment(reason), pairs
    else:
        alignment = align(pairs, search=search)
        if alignment.is_ambiguous and search is None and ins.is_utc:
            near_zero = align(pairs, search=(-MAX_CLOCK_ERROR, MAX_CLOCK_ERROR))
            if near_zero.verdict is not Verdict.REFUSED and near_zero.peak and alignment.peak and (
                    near_zero.peak.correlation >= MIN_RELATIVE_PEAK * alignment.peak.correlation):
                alignment = near_zero.with_doubts("several offsets fit equally well because laps or manoeuvres repeat; "
                                                  f"the one within {MAX_CLOCK_ERROR:.0f} s of the logger's own clock "
                                                  "is used")
        alignment = alignment.with_doubts(*filter(None, (warning, _describe_opposite_sign(pairs, alignment, search))))
        if is_other_clock:
            alignment = alignment.with_doubts(OTHER_CLOCK) if alignment.verdict is Verdict.GOOD else refused_alignment(
                OTHER_CLOCK, *alignment.reasons)
    return replace(alignment, reasons=(*notes, *alignment.reasons)), pairs


def pair_shared_signals(ins: InsLog, can: CanSignals,
                        latency: tuple[float, float] = INS_ON_CAN_DELAY) -> list[SharedSignal]:
    """Pairs the INS signals that both recordings contain: forward velocity, yaw rate, yaw.

    latency: delay of INS values on CAN and its standard deviation [s].
    """
    speed = can.find_first("ins_velocity_x") or can.find_first("vehicle_speed")
    pairs = []
    for label, quantity, channel in (("forward velocity", "speed", "velocity_x"), ("yaw rate", "rate", "yaw_rate"),
                                     ("yaw", "angle", "yaw")):
        if channel in ins.values:  # an INS may have no yaw
            values = mask_standstill(ins.time_ns, ins.values[channel], ins.time_ns, ins.values["velocity_x"])
            pairs += [_make_pair(f"{label} ({signal.message})", quantity, ins.time_ns, values, signal, speed, latency)
                      for signal in can.find_all(f"ins_{channel}")]
    return pairs


def pair_substitute_signals(ins: InsLog, can: CanSignals, steering_sign: int = 1) -> tuple[list[SharedSignal], str]:
    """Pairs INS speed with vehicle, mean rear or left rear wheel speed, or else curvature with steering wheel angle,
    for a log without INS frames. Returns ([pair], warning), or ([], "") if the log has neither speed nor steering.

    steering_sign: +1 if the decoded angle is positive to the left.
    """
    velocity_x, yaw_rate = ins.values["velocity_x"], ins.values["yaw_rate"]
    speed = can.find_first("vehicle_speed") or can.find_first("wheel_speed_rear_left")
    right = can.find_first("wheel_speed_rear_right")
    if speed is not None and speed.name != "vehicle_speed" and right and np.array_equal(speed.time_ns, right.time_ns):
        # The speed of a single wheel also depends on the yaw rate.
        speed = replace(speed, values=(speed.values + right.values) / 2.0)
    if speed is not None:
        values = mask_standstill(ins.time_ns, np.abs(velocity_x), ins.time_ns, velocity_x)
        delay, deviation = WHEEL_SPEED_DELAY
        slip = SLIP_PER_ACCELERATION_DEVIATION * float(np.nanmean(values)) if np.isfinite(values).any() else 0.0
        latency = delay, float(np.hypot(deviation, slip))
        return ([_make_pair(f"speed ({speed.message})", "speed", ins.time_ns, values, speed, speed, latency)],
                f"{NO_INS_FRAMES}: aligned by the vehicle or wheel speed with an assumed delay of "
                f"{1e3 * latency[0]:.0f} ms, standard deviation {1e3 * latency[1]:.0f} ms (delay and slip are "
                "unknown)")
    steering = can.find_first("steering_wheel_angle")
    if steering is None:
        return [], ""
    is_fast = np.abs(velocity_x) > MIN_CURVATURE_SPEED
    curvature = np.where(is_fast, yaw_rate / np.where(is_fast, velocity_x, 1.0), np.nan)
    pair = SharedSignal("curvature against steering", ins.time_ns, curvature, steering.time_ns,
                        steering_sign * steering.values, *STEERING_DELAY, MIN_VARIATION["curvature"])
    return [pair], (f"{NO_INS_FRAMES}, and no wheel speed: aligned by steering and curvature, which lags by the "
                    "unknown response time of the car")


def mask_implausible(ins: InsLog, can: CanSignals) -> tuple[InsLog, CanSignals, list[str]]:
    """(both recordings with NaN for implausible values, a note on each affected signal).

    One sentinel value or spike can exceed the variation of the signal; it would shift or hide the correlation peak.
    """
    notes: list[str] = []

    def mask(channel: str, label: str, time_ns: np.ndarray, values: np.ndarray, is_moving: np.ndarray) -> np.ndarray:
        if len(values) < 2:
            return values
        unwrapped = np.unwrap(np.nan_to_num(values)) if channel == "yaw" else values
        is_bad, findings = find_implausible_samples(channel, (time_ns - time_ns[0]) * 1e-9, unwrapped, is_moving)
        if is_bad.any():
            largest = float(values[is_bad][np.argmax(np.abs(values[is_bad]))])
            notes.append(f"{is_bad.sum()} of {len(is_bad)} samples of {label} are implausible (up to {largest:.4g} "
                         f"{findings[0].unit}); the alignment does not use them")
        return np.where(is_bad, np.nan, values)

    speed = can.find_first("ins_velocity_x") or can.find_first("vehicle_speed")
    masked_signals = dict(can.signals)
    for key, signal in can.signals.items():
        if signal.name in PLAUSIBILITY_CHANNELS:
            is_moving = (_is_moving(signal.time_ns, speed.time_ns, speed.values) if speed
                         else np.ones(len(signal.values), bool))
            masked_signals[key] = replace(signal, values=mask(
                PLAUSIBILITY_CHANNELS[signal.name], f"{signal.name} ({signal.message})", signal.time_ns, signal.values,
                is_moving))
    can = CanSignals(masked_signals, can.faults)
    is_moving = _is_moving(ins.time_ns, ins.time_ns, ins.values["velocity_x"])
    values = {name: mask(name, f"{name} of the INS", ins.time_ns, ins.values[name], is_moving)
              for name in ("velocity_x", "yaw_rate", "yaw") if name in ins.values}
    return replace(ins, values={**ins.values, **values}), can, notes


def _is_moving(time_ns: np.ndarray, speed_time_ns: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Whether the car is faster than MIN_MOVING_SPEED at any time from 2 s before to 2 s after each instant."""
    return np.isfinite(mask_standstill(time_ns, np.ones(len(time_ns)), speed_time_ns, speed, MIN_MOVING_SPEED))


def _describe_opposite_sign(pairs: list[SharedSignal], alignment: Alignment, search: tuple[float, float] | None) -> str:
    """A note if a refused alignment would be accepted with the opposite steering sign; otherwise empty."""
    if alignment.verdict is not Verdict.REFUSED or pairs[0].min_deviation != MIN_VARIATION["curvature"]:
        return ""
    mirrored_alignment = align([replace(pairs[0], other=-pairs[0].other)], search=search)
    return "" if mirrored_alignment.verdict is Verdict.REFUSED else (
        f"with the opposite steering_sign, curvature and steering have a correlation of "
        f"{mirrored_alignment.signals[0].correlation:.2f}")


def _align_by_ins_time(ins_time: Signal, pairs: list[SharedSignal], latency: tuple[float, float]) -> Alignment:
    is_finite = np.isfinite(ins_time.values)
    ins_time_ns = np.round(ins_time.values[is_finite] * 1e6).astype(np.int64) * 1000
    alignment = align_by_time_frame(ins_time.time_ns[is_finite], ins_time_ns,
                                    TIME_FRAME_RESOLUTION.get(ins_time.message, 0.01), *latency)
    if not pairs:
        return alignment
    # Search only near the offset from the INS time, because repeated laps fit at several offsets.
    offset = alignment.offset_at_ns(alignment.at_ns) * 1e-9
    # One message each for velocity, yaw rate and yaw, because a second one adds no information.
    distinct_pairs = {pair.name.partition(" (")[0]: pair for pair in reversed(pairs)}
    check = align([*distinct_pairs.values()][::-1], search=(offset - CHECK_SEARCH, offset + CHECK_SEARCH))
    if check.verdict is Verdict.REFUSED:
        return alignment.with_doubts(f"the shared signals do not confirm the offset: {check.reasons[-1]}")
    difference = (check.offset_at_ns(check.at_ns) - alignment.offset_at_ns(check.at_ns)) * 1e-9
    alignment = replace(alignment, signals=check.signals, peak=check.peak, second_peak=check.second_peak)
    if abs(difference) > MAX_METHOD_DIFFERENCE:
        return alignment.with_doubts(f"the shared signals give an offset that differs by {difference * 1e3:+.0f} ms")
    return alignment


def _make_pair(name: str, quantity: str, time_ns: np.ndarray, values: np.ndarray, signal: Signal, speed: Signal | None,
               latency: tuple[float, float]) -> SharedSignal:
    other = signal.values if speed is None else mask_standstill(
        signal.time_ns, signal.values, speed.time_ns, speed.values)
    return SharedSignal(name, time_ns, values, signal.time_ns, other, *latency, MIN_VARIATION[quantity],
                        is_angle=quantity == "angle")
