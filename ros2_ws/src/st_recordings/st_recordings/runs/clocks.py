"""One time for the INS recording and the CAN log: which signals both hold, and what follows for the clocks."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from st_core.checks.plausibility import implausible_samples
from st_core.clock_alignment import align, align_by_time_frame, by_hand, standstill_masked
from st_core.clock_types import Alignment, SharedSignal, Verdict, refused

from .can_signals import CanSignals, Signal
from .ins_log import Motion

# What lies between the instant an INS value is true and its CAN frame reaching the logger (calculation, then the queue)
# and its standard deviation, where it was not measured [s].
INS_ON_CAN = (0.002, 0.002)
# Wheel speeds are counted over a period before they are sent; yaw follows the steering wheel by a car's response time.
WHEEL_SPEED = (0.015, 0.015)
STEERING_LEAD = (-0.06, 0.06)

NO_INS_FRAMES = "the log has no INS frames that the DBC describes (RT_..., rt.dbc of `st car new`)"

# Least standard deviation with information [m/s, rad/s, rad, 1/m].
SMALLEST = {"speed": 0.3, "rate": 0.01, "angle": 0.05, "curvature": 0.001}
CURVATURE_FROM = 3.0  # m/s; slower, yaw rate over speed is noise
TIME_FRAME_RESOLUTION = {"RT_MilliTime": 0.001, "RT_DateTime": 0.01}  # s
METHODS_DIFFER = 0.01  # s
NEAR = 60.0  # s; what a logger's clock is trusted with where the signals leave a choice
CHECKED_WITHIN = 2.0  # s
ALIKE = 0.97  # of the best correlation
MOVING = 1.0  # m/s
# Signals of the log by the channel that limits what they can hold.
CHANNELS = {"ins_velocity_x": "velocity_x", "ins_yaw_rate": "yaw_rate", "ins_yaw": "yaw",
            "vehicle_speed": "velocity_x", "wheel_speed_rear_left": "velocity_x",
            "wheel_speed_rear_right": "velocity_x", "steering_wheel_angle": "steering_wheel_angle"}


def shared_signals(ins: Motion, can: CanSignals, latency: tuple[float, float] = INS_ON_CAN) -> list[SharedSignal]:
    """What both recordings hold of the INS's own signals: forward velocity, yaw rate, yaw.

    latency: of INS values on CAN, and its standard deviation [s].
    """
    speed = can.first_of("ins_velocity_x") or can.first_of("vehicle_speed")
    return [_pair(f"{label} ({signal.message})", kind, ins.time_ns, _masked(ins, values), signal, speed, latency)
            for label, kind, name, values in (("forward velocity", "speed", "ins_velocity_x", ins.velocity_x),
                                              ("yaw rate", "rate", "ins_yaw_rate", ins.yaw_rate),
                                              ("yaw", "angle", "ins_yaw", ins.yaw)) if values is not None
            for signal in can.all_of(name)]


def substitute_signals(ins: Motion, can: CanSignals, steering_sign: int = 1) -> tuple[list[SharedSignal], str]:
    """For a log without INS frames: wheel speed, else steering against curvature; and its warning.

    steering_sign: +1 where the decoded sensor is left positive.
    """
    speed = can.first_of("vehicle_speed") or can.first_of("wheel_speed_rear_left")
    right = can.first_of("wheel_speed_rear_right")
    if speed is not None and speed.name != "vehicle_speed" and right and np.array_equal(speed.time_ns, right.time_ns):
        speed = replace(speed, values=(speed.values + right.values) / 2.0)  # one wheel alone shows the yaw rate too
    if speed is not None:
        values = _masked(ins, np.abs(ins.velocity_x))
        return ([_pair(f"speed ({speed.message})", "speed", ins.time_ns, values, speed, speed, WHEEL_SPEED)],
                f"{NO_INS_FRAMES}: aligned by the wheel speed, of unknown delay")
    steering = can.first_of("steering_wheel_angle")
    if steering is None:
        return [], ""
    fast = np.abs(ins.velocity_x) > CURVATURE_FROM
    curvature = np.where(fast, ins.yaw_rate / np.where(fast, ins.velocity_x, 1.0), np.nan)
    pair = SharedSignal("curvature against steering", ins.time_ns, curvature, steering.time_ns,
                        steering_sign * steering.values, *STEERING_LEAD, SMALLEST["curvature"])
    return [pair], (f"{NO_INS_FRAMES} and no wheel speed: aligned by steering against yaw rate, which lags by the "
                    "response time of the car")


def without_implausible(ins: Motion, can: CanSignals) -> tuple[Motion, CanSignals, list[str]]:
    """(both recordings, NaN where no working sensor gives such a value, what is NaN in words).

    One sentinel or spike is larger than all motion together, and moves or hides the offset.
    """
    texts: list[str] = []

    def plausible(channel: str, label: str, time_ns: np.ndarray, values: np.ndarray, moving: np.ndarray) -> np.ndarray:
        if len(values) < 2:
            return values
        whole = np.unwrap(np.nan_to_num(values)) if channel == "yaw" else values
        bad, found = implausible_samples(channel, (time_ns - time_ns[0]) * 1e-9, whole, moving)
        if bad.any():
            largest = float(values[bad][np.argmax(np.abs(values[bad]))])
            texts.append(f"{bad.sum()} of {len(bad)} samples of {label} are implausible (up to {largest:.4g} "
                         f"{found[0].unit}) and were left out of the alignment")
        return np.where(bad, np.nan, values)

    def cleaned(signals: Iterable[Signal], speed: Signal | None) -> dict[tuple[str, str], Signal]:
        return {(one.name, one.message): replace(one, values=plausible(
            CHANNELS[one.name], f"{one.name} ({one.message})", one.time_ns, one.values,
            _moves(one.time_ns, speed.time_ns, speed.values) if speed else np.ones(len(one.values), bool)))
            for one in signals}

    raw = can.first_of("ins_velocity_x") or can.first_of("vehicle_speed")
    kept = CanSignals({**can.signals, **cleaned(
        (one for one in can.signals.values() if one.name in CHANNELS), raw)}, can.faults)
    moving = _moves(ins.time_ns, ins.time_ns, ins.velocity_x)
    columns: dict[str, Any] = {name: plausible(name, f"{name} of the INS", ins.time_ns, values, moving)
               for name in ("velocity_x", "yaw_rate", "yaw") if (values := getattr(ins, name)) is not None}
    return replace(ins, **columns), kept, texts


def _moves(time_ns: np.ndarray, speed_time_ns: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Whether the car moves within two seconds of each instant."""
    return np.isfinite(standstill_masked(time_ns, np.ones(len(time_ns)), speed_time_ns, speed, MOVING))


def align_clocks(ins: Motion, can: CanSignals, offset: float | None = None, search: tuple[float, float] | None = None,
                 latency: tuple[float, float] = INS_ON_CAN,
                 steering_sign: int = 1) -> tuple[Alignment, list[SharedSignal]]:
    """The alignment of a run (reference: INS), and the signals it rests on or can be looked at with.

    By hand, if `offset` [s] (INS minus CAN clock) is given; else by the INS's own time frame on CAN, checked against
    the shared signals; else by these; else by a substitute, never better than doubtful.
    search: bounds of the offset [s]. latency: of INS values on CAN, and its standard deviation [s].
    steering_sign: +1 where the decoded sensor is left positive.
    """
    ins, can, left_out = without_implausible(ins, can)
    pairs, warning = shared_signals(ins, can, latency), ""
    if not pairs:
        pairs, warning = substitute_signals(ins, can, steering_sign)
    frames = [one for one in can.all_of("ins_unix_time") if np.isfinite(one.values).sum() > 1]
    if offset is not None:
        at_ns = int(pairs[0].other_time_ns[0]) if pairs else 0
        result = by_hand(round(offset * 1e9), at_ns, pairs)
    elif ins.absolute and frames:  # the finer of them
        finest = min(frames, key=lambda s: TIME_FRAME_RESOLUTION.get(s.message, 1.0))
        result = _checked_time_frame(finest, pairs if not warning else [], latency)
    elif not pairs:
        return refused("the CAN log and the INS recording have no signal in common; give the offset by hand"), pairs
    else:
        result = align(pairs, search=search)
        if result.ambiguous and search is None and ins.absolute:
            result = _nearest(pairs, result)
        result = result.doubted(*filter(None, (warning, _other_sign(pairs, result, search))))
    return replace(result, reasons=(*left_out, *result.reasons)), pairs


def _other_sign(pairs: list[SharedSignal], result: Alignment, search: tuple[float, float] | None) -> str:
    """That the steering counts the other way, where that alone explains a refusal."""
    if result.verdict is not Verdict.REFUSED or pairs[0].smallest != SMALLEST["curvature"]:
        return ""
    turned = align([replace(pairs[0], other=-pairs[0].other)], search=search)
    return "" if turned.verdict is Verdict.REFUSED else (
        f"with the other steering_sign of the car they fit with a correlation of {turned.signals[0].correlation:.2f}")


def _nearest(pairs: list[SharedSignal], result: Alignment) -> Alignment:
    """Where several offsets fit alike: the one near the logger's own clock, if that is one of them."""
    near = align(pairs, search=(-NEAR, NEAR))
    if near.verdict is Verdict.REFUSED or not near.peak or not result.peak or near.peak[1] < ALIKE * result.peak[1]:
        return result
    return near.doubted("several offsets fit alike (repeated laps or manoeuvres); taken is the one that agrees with "
                        f"the logger's own clock to {NEAR:.0f} s")


def _checked_time_frame(frames: Signal, pairs: list[SharedSignal], latency: tuple[float, float]) -> Alignment:
    known = np.isfinite(frames.values)
    result = align_by_time_frame(frames.time_ns[known], np.round(frames.values[known] * 1e6).astype(np.int64) * 1000,
                                 TIME_FRAME_RESOLUTION.get(frames.message, 0.01), *latency)
    if not pairs:
        return result
    # Near the time frame's own answer: on a proving ground the same lap fits many times.
    offset = result.offset_at_ns(result.at_ns) * 1e-9
    # The first message of velocity, yaw rate and yaw; a second one of the same confirms nothing.
    firsts = list({pair.name.partition(" (")[0]: pair for pair in reversed(pairs)}.values())[::-1]
    check = align(firsts, search=(offset - CHECKED_WITHIN, offset + CHECKED_WITHIN))
    if check.verdict is Verdict.REFUSED:
        return result.doubted(f"the shared signals do not confirm it: {check.reasons[-1]}")
    difference = (check.offset_at_ns(check.at_ns) - result.offset_at_ns(check.at_ns)) * 1e-9
    result = replace(result, signals=check.signals, peak=check.peak, second_peak=check.second_peak)
    if abs(difference) > METHODS_DIFFER:
        return result.doubted(f"the shared signals put the offset {difference * 1e3:+.0f} ms away")
    return result


def _pair(name: str, kind: str, time_ns: np.ndarray, values: np.ndarray, signal: Signal, speed: Signal | None,
          latency: tuple[float, float]) -> SharedSignal:
    other = signal.values
    if speed is not None:
        other = standstill_masked(signal.time_ns, other, speed.time_ns, speed.values)
    return SharedSignal(name, time_ns, values, signal.time_ns, other, *latency, SMALLEST[kind], angle=kind == "angle")


def _masked(ins: Motion, values: np.ndarray) -> np.ndarray:
    return standstill_masked(ins.time_ns, values, ins.time_ns, ins.velocity_x)
