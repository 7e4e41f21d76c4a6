"""Blind benchmark of discovery: hidden effects in two plants and real drives, the answers, the score."""

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; see `command`, and `relation_command` for what follows --laws."""
    # Imported here: plants and cases are of use without the engine that is judged.
    given = sys.argv[1:] if arguments is None else list(arguments)
    if "--laws" in given:
        from .relation_command import main as laws
        return laws([word for word in given if word != "--laws"])
    from .command import main as command
    return command(given)
