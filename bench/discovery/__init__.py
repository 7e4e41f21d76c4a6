"""Blind benchmark of `st discover`: scores for effects hidden in two plants, and for edits of real drives."""

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line in `command`, or with --relations that in `relation_command`."""
    # Imported here, because tests use plants and cases without the discovery.
    given = sys.argv[1:] if arguments is None else list(arguments)
    if options := {"--relations", "--laws"} & set(given):  # --laws: as in older documents
        from .relation_command import main as relations
        return relations([word for word in given if word not in options])
    from .command import main as command
    return command(given)
