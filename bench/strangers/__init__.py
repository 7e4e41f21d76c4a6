"""Cars and recordings that share no equation with the project, through `st check` and `st discover`."""

from .command import main

__all__ = ["main"]
