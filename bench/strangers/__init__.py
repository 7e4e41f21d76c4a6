"""Tests `st discover` with cars whose equations differ from those of the project, and scores its statements."""

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line in `command`."""
    from .command import main as command
    return command(arguments)
