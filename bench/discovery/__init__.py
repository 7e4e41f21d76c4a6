"""Blind benchmark of discovery: hidden effects in the virtual car, what is said of them, and the score."""

from .command import main

__all__ = ["main"]
