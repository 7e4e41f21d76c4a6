"""How evaluator and recorder open their bag and report on it."""

from collections.abc import Mapping
from types import SimpleNamespace

from st_ros import diagnostics
from st_ros.diagnostics import Check
from st_ros.parameters import ConfigurationError

from ..mcap import BagWriter


def open_bag(values: SimpleNamespace, records: Mapping[str, Mapping[str, str]]) -> BagWriter:
    """The bag of the parameter `output_directory`.

    Raises ConfigurationError naming the directory where it is not empty or cannot be written.
    """
    try:
        return BagWriter(values.output_directory, records)
    except OSError as error:
        name = f"{error.filename or values.output_directory}: " if error.strerror else ""
        raise ConfigurationError(f"{values.where}output_directory: {name}{error.strerror or error}") from None


def recording_check(bag: BagWriter) -> Check:
    values = {"messages": bag.message_count, "lost": bag.lost, "directory": bag.directory}
    if bag.error:
        return Check("recording", diagnostics.ERROR, bag.error, values)
    return Check("recording", diagnostics.OK, f"{bag.message_count} messages", values)
