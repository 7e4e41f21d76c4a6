"""Corruption matrix of `st check`: known faults put into real and virtual drives, and what is said of them."""

from .command import main

__all__ = ["main"]
