"""Corruption matrix of `st check`: the findings for known faults in real and virtual drives."""

from .command import main

__all__ = ["main"]
