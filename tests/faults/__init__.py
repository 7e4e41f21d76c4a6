"""Faults in a running suite; a package, so that bench/faults.py and bench/soak.py can use it under its own name."""
