"""Reads measured signals from MDF files (version 3 or 4), as ETAS INCA, Vector CANape and asammdf write them.

The signals become a table as of a CSV file, so that names, units and rates are handled in the same way.
"""

import mmap
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from .columns import Layout, find_ambiguous_steering, find_columns
from .errors import RunError, shorten
from .mf4 import MDF_OPTIONS, quiet_asammdf

_RAW_FRAMES = re.compile(rb"\0CAN_(Data|Remote|Error)Frame")
"""Name of a channel of raw frames, after the end of a block head; texts of decoded files may contain it elsewhere."""


def is_signal_table(file: Path) -> bool:
    """Whether a file is a finalised MDF file without raw CAN frames."""
    try:
        with file.open("rb") as stream:
            if stream.read(4) != b"MDF ":
                return False
            with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
                return _RAW_FRAMES.search(content) is None
    except OSError:
        return False


def read_names(file: Path) -> list[str]:
    """Names of the signals with their units, such as "YawRate [deg/s]"; empty for a file that cannot be read."""
    try:
        status = file.stat()
        return list(_read_names(file, status.st_mtime_ns, status.st_size))
    except (OSError, RunError):
        return []


@lru_cache(maxsize=256)
def _read_names(file: Path, mtime_ns: int, size: int) -> tuple[str, ...]:
    """As `read_names`, once for each version of a file. Raises RunError."""
    with _open_file(file) as mdf:
        return ("t [s]", *(name for name, _, _ in _list_signals(mdf)))


def read_signals(file: Path, layout: Layout) -> tuple[list[str], str]:
    """(header, rows separated by commas) of the signals that are channels of a drive or named by the layout.

    Each time at which a signal was measured has a row, in which the other signals are nan. Times are UTC, or count
    from the start of a measurement without a date. Raises RunError for a file that asammdf cannot read.
    """
    with _open_file(file) as mdf:
        signals = _list_signals(mdf)
        names = ["t [s]", *(name for name, _, _ in signals)]
        named = {source.column - 1 for source in find_columns(file, names, layout).values()}
        chosen = [(name, mdf.get(group=group, index=index)) for number, (name, group, index) in enumerate(signals)
                  if number in named or find_columns(file, [name], Layout()) or find_ambiguous_steering([name])]
        start = mdf.header.start_time  # without a time zone it is read as UTC, so that all machines agree
        start_us = round((start if start.tzinfo else start.replace(tzinfo=UTC)).timestamp() * 1e6)
    chosen = [(name, signal) for name, signal in chosen
              if signal.samples.ndim == 1 and signal.samples.dtype.kind in "biuf"]
    times = [start_us + np.round(signal.timestamps * 1e6).astype(np.int64) for _, signal in chosen]
    time_us = np.unique(np.concatenate(times)) if times else np.empty(0, np.int64)
    cells = np.full((len(time_us), len(chosen)), np.nan)
    for number, (stamps, (_, signal)) in enumerate(zip(times, chosen, strict=True)):
        is_valid = slice(None) if signal.invalidation_bits is None else ~signal.invalidation_bits
        cells[np.searchsorted(time_us, stamps[is_valid]), number] = signal.samples[is_valid]
    rows = [f"{time / 1e6:.6f}," + ",".join(f"{cell:.12g}" for cell in row)
            for time, row in zip(time_us.tolist(), cells.tolist(), strict=True)]
    return ["t [s]", *(name for name, _ in chosen)], "\n".join(rows)


def _list_signals(mdf: Any) -> list[tuple[str, int, int]]:
    """(name with unit, group, index) of all signals except times; of those with the same name, the one with the most
    samples."""
    found: dict[str, tuple[str, int, int]] = {}
    counts: dict[str, int] = {}
    for group, content in enumerate(mdf.groups):
        count = content.channel_group.cycles_nr
        for index, channel in enumerate(content.channels):
            name = channel.name.split("\\")[0]  # INCA appends the device: YawRate\CAN-Monitoring:1
            if index == mdf.masters_db.get(group) or count <= counts.get(name, -1):
                continue
            unit = mdf.get_channel_unit(group=group, index=index)
            has_unit = not unit or name.endswith(f"[{unit}]")
            found[name], counts[name] = (name if has_unit else f"{name} [{unit}]", group, index), count
    return list(found.values())


@contextmanager
def _open_file(file: Path) -> Iterator[Any]:
    from asammdf import MDF

    mdf = None
    try:
        with quiet_asammdf():
            mdf = MDF(file, **MDF_OPTIONS)
            yield mdf
    except RunError:
        raise
    except Exception as error:  # any, from asammdf
        raise RunError(file, f"asammdf cannot read the file ({shorten(error)})", "copy or export it again") from None
    finally:
        if mdf is not None:
            mdf.close()
