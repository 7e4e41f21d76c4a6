"""Layout of prediction starts in a batch: the instants to sample, and the position of each start among them.

5 s horizons of starts 0.1 s apart overlap fifty-fold. If the starts are multiples of half an integration step apart,
they share instants: one grid for the log, in which point index * q + phase is stored at [phase, index], with q half
steps between starts. Neighbouring starts are thus adjacent in memory at every instant, and nothing is copied. Other
starts have separate instants in the same layout.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

SHARED_BLOCK = 8192  # columns per block; on a shared grid with 4 half steps between starts, 33 000 instants
SEPARATE_BLOCK = 2**17  # instants per block with separate instants


@dataclass(frozen=True, eq=False)
class GridBlock:
    """Columns of a batch that are computed together."""

    number: int
    rows: slice  # starts in the block
    start_columns: np.ndarray  # (starts,), column of each start
    starts_ns: np.ndarray  # (count,), start of each column
    times_ns: np.ndarray  # instants to sample, (m,) if shared, else (instants, columns)
    offsets: np.ndarray  # instant k of column i is element `offsets[k] + i` of a row of the table
    columns: int  # count, rounded up to a multiple of the lanes
    spacing: int = 0  # half steps between shared columns; 0 for separate instants

    @property
    def count(self) -> int:
        return len(self.starts_ns)

    @property
    def shared(self) -> bool:
        """Whether the starts share instants."""
        return self.spacing > 0

    def arrange(self, values: np.ndarray) -> np.ndarray:
        """Values at times_ns, (m,), in the order to which `offsets` refers."""
        return (values.reshape(-1, self.spacing).T if self.shared else values).ravel()

    def tabulate(self, fields: tuple) -> np.ndarray:
        """Table (fields, m) of quantities, each of them an arranged array or a number."""
        result = np.empty((len(fields), self.times_ns.size))
        for row, field in zip(result, fields, strict=True):
            row[:] = field
        return result


def plan_blocks(starts_ns: np.ndarray, instants_ns: np.ndarray, lanes: int, share: bool = True) -> Iterator[GridBlock]:
    """Blocks that cover all starts. starts_ns: increasing [ns]. instants_ns: times after each start, from 0 on [ns].

    lanes: columns that the kernel computes at once. share: False if the values at an instant depend on the start.
    """
    pieces = _find_pieces(starts_ns, instants_ns) if share else []
    if pieces and sum(piece.width for piece in pieces) <= 2 * len(starts_ns) + lanes:
        yield from _plan_shared(pieces, instants_ns, lanes)
        return
    count = len(instants_ns)
    size = _round_up(max(min(SEPARATE_BLOCK // count, SHARED_BLOCK), 1), lanes)
    for number, first in enumerate(range(0, len(starts_ns), size)):
        starts = starts_ns[first:first + size]
        width = _round_up(len(starts), lanes)
        padded = np.pad(starts, (0, width - len(starts)), mode="edge")
        yield GridBlock(number, slice(first, first + len(starts)), np.arange(len(starts)), starts,
                        instants_ns[:, None] + padded, np.arange(count) * width, width)


class _Piece(NamedTuple):
    """Consecutive starts with overlapping horizons, which fit into a block."""

    rows: slice
    spacing: int  # half steps between columns
    column: np.ndarray  # of each start, within the piece
    origin_ns: int  # time of its first column
    width: int  # columns, including those into which the last horizon extends


def _find_pieces(starts_ns: np.ndarray, instants_ns: np.ndarray) -> list[_Piece]:
    """Pieces that cover all starts; empty without a common grid."""
    if len(instants_ns) < 2 or not len(starts_ns):
        return []
    half, count = int(instants_ns[1]), len(instants_ns)
    if not np.array_equal(instants_ns, half * np.arange(count)):
        return []
    between = np.diff(starts_ns)
    pieces = []
    for run in np.split(np.arange(len(starts_ns)), np.flatnonzero(between >= half * count) + 1):
        steps = between[run[0]:run[-1]]
        if np.any(steps % half):
            return []
        spacing = int(np.gcd.reduce(steps // half)) if len(steps) else count
        column = (starts_ns[run] - starts_ns[run[0]]) // (half * spacing)
        for first in (SHARED_BLOCK * np.unique(column // SHARED_BLOCK)).tolist():
            begin, end = np.searchsorted(column, (first, first + SHARED_BLOCK)).tolist()
            within = column[begin:end] - first
            pieces.append(_Piece(slice(int(run[0]) + begin, int(run[0]) + end), spacing, within,
                                 int(starts_ns[run[0]]) + first * half * spacing,
                                 int(within[-1]) + 1 + (count - 1) // spacing))
    return pieces


def _plan_shared(pieces: Sequence[_Piece], instants_ns: np.ndarray, lanes: int) -> Iterator[GridBlock]:
    """Blocks of consecutive pieces; between pieces, the columns into which the last horizon extends are unused."""
    group: list[_Piece] = []
    number = 0
    for piece in pieces:
        if group and (group[0].spacing != piece.spacing or sum(p.width for p in (*group, piece)) > SHARED_BLOCK):
            yield _join_pieces(number, group, instants_ns, lanes)
            group, number = [], number + 1
        group.append(piece)
    yield _join_pieces(number, group, instants_ns, lanes)


def _join_pieces(number: int, pieces: list[_Piece], instants_ns: np.ndarray, lanes: int) -> GridBlock:
    half, spacing = int(instants_ns[1]), pieces[0].spacing
    width = [piece.width for piece in pieces]
    first = np.concatenate(([0], np.cumsum(width)))
    count = int(first[-1]) - (len(instants_ns) - 1) // spacing
    columns = _round_up(count, lanes)
    width[-1] += columns - count
    times = [piece.origin_ns + half * np.arange(w * spacing) for piece, w in zip(pieces, width, strict=True)]
    starts = np.concatenate([t[::spacing] for t in times])[:count]
    start_columns = np.concatenate([piece.column + f for piece, f in zip(pieces, first, strict=False)])
    k = np.arange(len(instants_ns))
    return GridBlock(number, slice(pieces[0].rows.start, pieces[-1].rows.stop), start_columns, starts,
                     np.concatenate(times), (k % spacing) * sum(width) + k // spacing, columns, spacing)


def _round_up(count: int, lanes: int) -> int:
    return -(-count // lanes) * lanes
