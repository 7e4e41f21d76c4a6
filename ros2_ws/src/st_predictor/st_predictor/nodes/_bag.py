"""Opens the output bag of evaluator or recorder, and reports on it in /diagnostics."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

from st_recordings.mcap import BagWriter
from st_ros import diagnostics
from st_ros.diagnostics import Check
from st_ros.parameters import ConfigurationError

MAX_SYNC_DELAY = 1.0  # s, age of data not yet on the disk above which the node warns; half a second is normal


def open_bag(values: SimpleNamespace, records: Mapping[str, Mapping[str, str]]) -> BagWriter:
    """Writer of a new bag in the folder `output_directory`. If this contains files, as after a restart of the node, and
    `number_if_exists` is set, _2, _3 and so on is appended to its name. Raises ConfigurationError if it contains files
    and `number_if_exists` is not set, if it is a file, or if it cannot be written."""
    names = (f"{values.output_directory}_{number}" for number in itertools.count(2))
    name = values.output_directory
    try:
        while True:
            try:
                return BagWriter(name, records, synced=True)
            except FileExistsError:
                if not values.number_if_exists or Path(name).is_file():
                    raise
                name = next(names)
    except OSError as error:
        file = f"{error.filename or values.output_directory}: " if error.strerror else ""
        raise ConfigurationError(f"{values.message_prefix}output_directory: {file}{error.strerror or error}") from None


def make_recording_check(bag: BagWriter, stop_reason: str = "", has_resumed: bool = False, suffix: str = "") -> Check:
    """Diagnostic check of the recording: message counts, losses and disk errors. stop_reason: why an earlier bag of the
    run ended. has_resumed: whether to warn about a new bag. suffix: text added to a write error."""
    values = {"messages": bag.message_count, "lost": bag.lost_count, "directory": bag.directory}
    if bag.syncer:
        values["slowest sync [s]"] = round(bag.syncer.longest_call, 3)
    if stop_reason:
        values["previous bag"] = stop_reason
    if bag.error:
        return Check("recording", diagnostics.ERROR, f"{bag.error}{suffix}", values)
    if has_resumed:
        return Check("recording", diagnostics.WARN, f"{stop_reason}; recording resumed in {bag.directory}", values)
    level, text = diagnostics.OK, f"{bag.message_count} messages"
    if bag.syncer and bag.syncer.error:
        # The recording continues: most data may still reach the disk, and a new bag would be on the same disk.
        level, text = diagnostics.ERROR, (f"writing to the disk failed: {bag.syncer.error} ({bag.path}); recorded data "
                                          "may be missing: use another disk")
    elif bag.syncer and (delay := bag.syncer.delay) > MAX_SYNC_DELAY:
        level, text = diagnostics.WARN, (f"the disk is slow: a power failure would lose the last {delay:.1f} s "
                                         f"({bag.path.parent})")
    return Check("recording", level, text, values)


def is_complete(bag: BagWriter) -> bool:
    """Whether the bag was recorded without interruption or write error."""
    return not (bag.error or (bag.syncer and bag.syncer.error))
