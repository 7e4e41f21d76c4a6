"""Counters, checksums and plausibility of all frames of a message at once: the rules of the live decoder in columns."""

from collections.abc import Mapping

import numpy as np
from canedge_bridge.checks import RULES, Field, Mode, checksum_of
from canedge_bridge.decode import TOLERATED, WINDOW
from canedge_bridge.signals import CheckSpec, MessageSpec, SignalSpec


def check_frames(spec: MessageSpec, payload: np.ndarray, time_ns: np.ndarray,
                 values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, str]:
    """(frames to keep, frames that are valid, what was wrong in words).

    payload: (n, 8). time_ns: as logged. values: our signals of the message, SI, one value per frame.
    """
    n = len(payload)
    keep, valid = np.ones(n, dtype=bool), np.ones(n, dtype=bool)
    faults = []
    wrong_sum = np.zeros(n, dtype=bool)
    if spec.checksum is not None and spec.checksum.mode is not Mode.OFF:
        wrong_sum = ~checksum_matches(spec.checksum, payload[:, : spec.dbc.length], spec.dbc.frame_id)
        (keep if spec.checksum.mode is Mode.DROP else valid)[wrong_sum] = False
        if wrong_sum.any():
            faults.append(f"checksum wrong in {wrong_sum.sum()}")
    if spec.counter is not None and spec.counter.mode is not Mode.OFF:
        wrong = counter_faults(spec.counter.field, payload, time_ns, wrong_sum, spec.timeout)
        (keep if spec.counter.mode is Mode.DROP else valid)[wrong] = False
        if wrong.any():
            faults.append(f"counter wrong in {wrong.sum()}")
    possible = keep.copy()
    for signal in spec.signals:
        if np.isfinite(signal.maximum) or np.isfinite(signal.max_rate):
            possible[keep] &= plausible(signal, spec, time_ns[keep], values[signal.name][keep])
    if (keep & ~possible).any():
        faults.append(f"a value that cannot be in {(keep & ~possible).sum()}")
    return possible, valid & possible, f"{', '.join(faults)} of {n} frames" if faults else ""


def plausible(signal: SignalSpec, spec: MessageSpec, time_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Per frame: in range, within reach, and not isolated among implausible ones (canedge_bridge.decode.Plausibility).

    Unlike the live decoder this knows the frames that follow: the first ones after a bad stretch are used too.
    """
    physical = values / signal.factor
    in_range = (physical >= signal.minimum) & (physical <= signal.maximum)

    def within_reach(frame: np.ndarray | int, reference: np.ndarray | int) -> tuple[np.ndarray, np.ndarray]:
        """(whether the two frames are comparable, and then within the limit of the rate)."""
        elapsed_ns = time_ns[frame] - time_ns[reference]
        comparable = (elapsed_ns > 0) & (elapsed_ns <= int(spec.timeout * 1e9))
        reach = signal.max_rate * np.maximum(elapsed_ns * 1e-9, spec.period)
        return comparable, comparable & (np.abs(physical[frame] - physical[reference]) <= reach)

    frames = np.arange(len(values))
    comparable, reached = within_reach(frames, np.maximum(frames - 1, 0))
    comparable[1:] &= in_range[:-1]
    reached[1:] &= in_range[:-1]
    possible = in_range & reached
    earlier = np.maximum.accumulate(np.where(possible, frames, -1))
    accepted = -1
    for frame in np.flatnonzero(in_range & ~reached).tolist():  # jumps, and frames without a usable one before them
        last = max(accepted, int(earlier[frame]))
        known, close = within_reach(frame, last) if last >= 0 else (False, False)
        if close or not (known or comparable[frame]):
            possible[frame], accepted = True, frame
    bad = np.concatenate(([0], np.cumsum(~possible)))
    recent = bad[1:] - bad[np.maximum(frames + 1 - WINDOW, 0)]
    _, run, lengths = np.unique(bad[1:][possible], return_inverse=True, return_counts=True)
    isolated = np.zeros(len(values), dtype=bool)
    isolated[possible] = lengths[run] < TOLERATED
    return possible & ~((recent > TOLERATED) & isolated)


def checksum_matches(check: CheckSpec, payload: np.ndarray, arbitration_id: int) -> np.ndarray:
    """Per frame. The two rules of the cars known so far in columns, any other one frame by frame."""
    found = (payload[:, check.field.byte] >> check.field.shift) & check.field.mask
    if check.rule is RULES["xor_nibble"]:
        value = np.bitwise_xor.reduce(payload, axis=1)
        return (value >> 4) == (value & 0xF)
    if check.rule is RULES["sum8_id"]:
        total = payload.sum(axis=1, dtype=np.uint32) - found + (arbitration_id >> 8) + (arbitration_id & 0xFF)
        return (total & 0xFF) == found
    assert check.rule is not None  # of a counter only
    expected = [checksum_of(check.rule, check.field, row.tobytes(), arbitration_id) for row in payload]
    return np.array(expected) == found


def counter_faults(field: Field, payload: np.ndarray, time_ns: np.ndarray, unreadable: np.ndarray,
                   restart_after: float) -> np.ndarray:
    """Where the counter did not rise by one, as CounterCheck finds it; frames in `unreadable` count on unread."""
    value = ((payload[:, field.byte] >> field.shift) & field.mask).astype(np.int64)
    index = np.arange(len(value))
    # The last frame that was read, and how many passed unread since.
    before = np.concatenate(([-1], np.maximum.accumulate(np.where(unreadable, -1, index))[:-1]))
    expected = value[before] + (index - before)
    wrong = (before >= 0) & ~unreadable & (((value - expected) & field.mask) != 0)
    gap = np.diff(time_ns, prepend=time_ns[:1]) > restart_after * 1e9
    return wrong & ~gap
