"""How evaluator and recorder open their bag and report on it."""

from collections.abc import Mapping

from st_ros import diagnostics
from st_ros.diagnostics import Check
from st_ros.parameters import ConfigurationError

from ..mcap import BagWriter


def open_bag(directory: str, records: Mapping[str, Mapping[str, str]]) -> BagWriter:
    """Raises ConfigurationError naming the directory where it is not empty or cannot be written."""
    try:
        return BagWriter(directory, records)
    except OSError as error:
        name = f"{error.filename or directory}: " if error.strerror else ""
        raise ConfigurationError(f"output_directory: {name}{error.strerror or error}") from None


def recording_check(bag: BagWriter) -> Check:
    values = {"messages": bag.message_count, "lost": bag.lost, "directory": bag.directory}
    if bag.error:
        return Check("recording", diagnostics.ERROR, bag.error, values)
    return Check("recording", diagnostics.OK, f"{bag.message_count} messages", values)
