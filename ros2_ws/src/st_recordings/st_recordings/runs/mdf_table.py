"""Reads measured signals from MDF files (version 3 or 4), as ETAS INCA, Vector CANape and asammdf write them.

The signals become a table as of a CSV file, so that names, units and rates are handled in the same way.
"""

import mmap
import re
from collections import Counter
from contextlib import AbstractContextManager
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np

from ..paths import cached_by_version
from .columns import Layout, find_ambiguous_steering, find_columns
from .mf4 import MDF_OPTIONS, open_mdf

_RAW_FRAMES = re.compile(rb"\0CAN_(Data|Remote|Error)Frame")
"""Name of a channel of raw frames after a block head, which ends with 0; comments of decoded files may contain it."""
_NO_DELIMITERS = str.maketrans(',"\n', "   ")


@cached_by_version(maxsize=256)
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


@cached_by_version(maxsize=256)
def read_names(file: Path) -> list[str]:
    """"t [s]" and the names of the signals with their units, such as "YawRate [deg/s]". Raises RunError."""
    with _open_file(file) as mdf:
        return ["t [s]", *(name for name, _, _, _ in _list_signals(mdf))]


def read_signals(file: Path, layout: Layout, warnings: list[str]) -> tuple[list[str], str]:
    """(header, rows separated by commas) of the signals that are channels of a drive or named by the layout.

    Each time at which a signal was measured has a row, in which the other signals are nan; of several samples at one
    time, the first is used. Times are UTC, or count from the start of a measurement without a date. An array appears as
    text. Appends a warning about each name with several signals. Raises RunError for a file that asammdf cannot read.
    """
    import pandas as pd

    columns = []
    with _open_file(file) as mdf:
        signals = _list_signals(mdf)
        names = ["t [s]", *(name for name, _, _, _ in signals)]
        named = {source.column - 1 for source in find_columns(file, names, layout).values()}
        start = mdf.header.start_time  # without a time zone it is read as UTC, so that all machines agree
        start_us = round((start if start.tzinfo else start.replace(tzinfo=UTC)).timestamp() * 1e6)
        for number, (name, group, index, occurrences) in enumerate(signals):
            if not (number in named or find_columns(file, [name], Layout()) or find_ambiguous_steering([name])):
                continue
            signal = mdf.get(group=group, index=index)
            samples = signal.samples
            if samples.ndim > 1 or samples.dtype.names:
                samples = np.full(len(samples), "array")  # asammdf lists its elements, too: NAME[0], NAME[1], ...
            elif samples.dtype.kind == "b":
                samples = samples.astype(np.uint8)  # with gaps, pandas would write booleans as text
            elif samples.dtype.kind == "S":  # names of an enumeration
                samples = np.array([text.decode("utf-8", "replace").translate(_NO_DELIMITERS) for text in samples])
            is_valid = slice(None) if signal.invalidation_bits is None else ~signal.invalidation_bits
            time_us = start_us + np.round(signal.timestamps * 1e6).astype(np.int64)
            column = pd.Series(samples[is_valid], time_us[is_valid] / 1e6, name=name)
            columns.append(column[~column.index.duplicated()])
            if occurrences > 1:
                warnings.append(f"{file}: {occurrences} signals have the name of {name}; the one with the most samples "
                                "is used")
    if not columns:
        return ["t [s]"], ""
    table = pd.concat(columns, axis=1, sort=True)
    # Three times as fast as DataFrame.to_csv
    row = ",".join(["%.6f", *("%.12g" if pd.api.types.is_numeric_dtype(kind) else "%s" for kind in table.dtypes)])
    return ["t [s]", *table.columns], "\n".join([row % cells for cells in table.itertuples(name=None)])


def _list_signals(mdf: Any) -> list[tuple[str, int, int, int]]:
    """(name with unit, group, index, number of signals with this name) of all signals except times; of those with the
    same name, the one with the most samples."""
    longest: dict[str, tuple[str, int, int]] = {}
    lengths: dict[str, int] = {}
    occurrences: Counter[str] = Counter()
    for group, content in enumerate(mdf.groups):
        length = content.channel_group.cycles_nr
        for index, channel in enumerate(content.channels):
            name = channel.name.split("\\")[0]  # INCA appends the device: YawRate\CAN-Monitoring:1
            if index == mdf.masters_db.get(group):
                continue
            occurrences[name] += 1
            if length <= lengths.get(name, -1):
                continue
            unit = mdf.get_channel_unit(group=group, index=index)
            has_unit = not unit or name.endswith(f"[{unit}]")
            longest[name], lengths[name] = (name if has_unit else f"{name} [{unit}]", group, index), length
    return [(*signal, occurrences[name]) for name, signal in longest.items()]


def _open_file(file: Path) -> AbstractContextManager[Any]:
    from asammdf import MDF

    return open_mdf(file, lambda: MDF(file, **MDF_OPTIONS), "copy or export it again")
