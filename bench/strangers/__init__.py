"""Cars that share no code and no tyre model with the project, through `st check` and `st discover`."""

from .command import main

__all__ = ["main"]
