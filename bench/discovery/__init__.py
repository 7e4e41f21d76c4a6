"""Blind benchmark of discovery: hidden effects in two plants and real drives, what is said of them, the score."""

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; see `command`."""
    # Imported here: plants and cases are of use without the engine that is judged.
    from .command import main as command
    return command(arguments)
