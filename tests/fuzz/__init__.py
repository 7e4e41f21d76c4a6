"""Hostile bytes at every reader; a package, so that bench/fuzz.py can use it under its own name."""
