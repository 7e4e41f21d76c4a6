"""Time stamps of a recording: which rows are used where time does not rise."""

import numpy as np

from .errors import share

LOST_SHARE = 0.01
"""Of the rows: with more that are not newer than all before, the clock was set back, and one stretch is used."""
LAST_STEP = 10.0
"""Times the median step: a last row further away has a wrong stamp."""


def usable_rows(time_ns: np.ndarray, what: str) -> tuple[np.ndarray, list[str]]:
    """(rows whose time rises strictly, warnings with the share that is not used).

    time_ns: (n,) int64 in the order of the recording. what: of the rows, in the plural. Single rows that are not newer
    than all before are left out. Where that costs more than LOST_SHARE, the clock was set back while recording: the
    longest stretch in which it was not is used. A last row with a stamp far from the others is left out.
    """
    n = len(time_ns)
    rows = np.arange(n)
    newer = np.ones(n, dtype=bool)
    if n > 1:
        newer[1:] = time_ns[1:] > np.maximum.accumulate(time_ns)[:-1]
    lost = n - int(newer.sum())
    notes = []
    if lost > max(LOST_SHARE * n, 1):
        rows = _longest(time_ns)
        if n - len(rows) <= lost + LOST_SHARE * n:
            steps = np.diff(time_ns)
            back = steps[steps < 0] * 1e-9
            notes.append(f"the clock was set back {len(back)} times, first by {-back[0]:.3f} s: "
                         f"{share(n - len(rows), n, what)} are not used; split the recording to use them")
        else:
            rows = np.flatnonzero(newer)
    elif lost:
        rows = rows[newer]
    if not notes and lost:
        notes.append(f"{share(lost, n, what)} are not newer than all before; they were left out")
    steps = np.diff(time_ns[rows])
    if len(rows) > 10 and steps[-1] > LAST_STEP * np.median(steps):
        notes.append(f"the last of {n} {what} is {steps[-1] * 1e-9:.3f} s after the one before; it was left out")
        rows = rows[:-1]
    return rows, notes


def _longest(time_ns: np.ndarray) -> np.ndarray:
    """Rows of the longest stretch without a step back, of it those that rise."""
    edges = np.concatenate(([0], np.flatnonzero(np.diff(time_ns) < 0) + 1, [len(time_ns)]))
    longest = int(np.argmax(np.diff(edges)))
    rows = np.arange(edges[longest], edges[longest + 1])
    return rows[np.diff(time_ns[rows], prepend=time_ns[rows[0]] - 1) > 0]
