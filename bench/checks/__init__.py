"""Corruption matrix of `st check`: known faults put into real and virtual drives, and the findings."""

from .command import main

__all__ = ["main"]
