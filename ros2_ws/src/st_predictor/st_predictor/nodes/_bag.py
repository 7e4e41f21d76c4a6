"""How evaluator and recorder open their bag and report on it."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

from st_recordings.mcap import BagWriter
from st_ros import diagnostics
from st_ros.diagnostics import Check
from st_ros.parameters import ConfigurationError


def open_bag(values: SimpleNamespace, records: Mapping[str, Mapping[str, str]]) -> BagWriter:
    """The bag of the parameter `output_directory`.

    If it holds something already and `number_when_taken` is set (the node was started again): NAME_2, NAME_3, ...
    Raises ConfigurationError naming the directory where it is not empty or cannot be written.
    """
    names = (f"{values.output_directory}_{number}" for number in itertools.count(2))
    name = values.output_directory
    try:
        while True:
            try:
                return BagWriter(name, records, synced=True)
            except FileExistsError:
                if not values.number_when_taken or Path(name).is_file():
                    raise
                name = next(names)
    except OSError as error:
        name = f"{error.filename or values.output_directory}: " if error.strerror else ""
        raise ConfigurationError(f"{values.where}output_directory: {name}{error.strerror or error}") from None


# Of what the disk does not have yet; half a second is usual, as much again waits in the writer [s].
BEHIND = 1.0


def recording_check(bag: BagWriter, stopped: str = "", lately: bool = False) -> Check:
    """stopped: why an earlier bag of the same run ended. lately: it did so a moment ago, which is worth a word."""
    values = {"messages": bag.message_count, "lost": bag.lost, "directory": bag.directory}
    if bag.syncer:
        values["slowest sync [s]"] = round(bag.syncer.longest, 3)
    if stopped:
        values["before"] = stopped
    if bag.error:
        return Check("recording", diagnostics.ERROR, bag.error, values)
    if lately:
        return Check("recording", diagnostics.WARN, f"{stopped}; goes on in {bag.directory}", values)
    level, said = disk_check(bag)
    if said:
        return Check("recording", level, said, values)
    return Check("recording", diagnostics.OK, f"{bag.message_count} messages", values)


def disk_check(bag: BagWriter) -> tuple[int, str]:
    """(level, what is said) of a disk that refuses data or does not follow; an empty text where it does."""
    syncer = bag.syncer
    if syncer and syncer.error:
        # It goes on: most of it may well arrive, and a new bag would lie on the same disk.
        return diagnostics.ERROR, (f"the disk refused data: {syncer.error} ({bag.path}); what was recorded may be "
                                   "missing: take another disk")
    if syncer and (behind := syncer.behind) > BEHIND:
        return diagnostics.WARN, (f"the disk is slow: a loss of power would cost the last {behind:.1f} s "
                                  f"({bag.path.parent})")
    return diagnostics.OK, ""


def is_whole(bag: BagWriter) -> bool:
    """Whether nothing stopped the recording, and the disk refused nothing."""
    return not (bag.error or (bag.syncer and bag.syncer.error))
