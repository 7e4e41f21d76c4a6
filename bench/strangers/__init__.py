"""Cars that share no equation with the project, through `st discover`: what is stated against what is in the car."""

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; see `command`."""
    from .command import main as command
    return command(arguments)
