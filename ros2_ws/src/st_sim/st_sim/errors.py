"""What the user can put right: a bad argument, a missing file, a value out of bounds."""


class SimulationError(ValueError):
    """One line naming the file or option, the key and the limit."""
