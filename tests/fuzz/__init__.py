"""Malformed input for every reader; a package, so that bench/fuzz.py can import it under its own name."""
