"""Backends, which compute batches of predictions from the unchanged functions of a Model. A backend is a module with

    LANES                                                       number of columns advanced together
    advance(model, p, start, w, offsets, step, points) -> out   RK4 of all columns

    p: `model.parameters(vehicle)`. start: (states, n), n a multiple of LANES. w: (fields, m), from `model.inputs`.
    offsets: (2 * steps + 1,); column i has w[:, offsets[k] + i] at time k * step / 2. points: step numbers, increasing.
    out: (len(points), 6, n), states at these steps. NaN in a column makes only that column NaN.

numba_lanes compiles the model. For a model that numba cannot compile, numpy_batch replaces it, five to twenty times
slower.
casadi_backend does not advance batches: it builds symbolic functions.
"""

from types import ModuleType

from ..errors import ConfigurationError

NAMES = ("lanes", "numpy")


def get_backend(name: str = "lanes") -> ModuleType:
    """Backend by name, imported at its first use. Raises ConfigurationError for an unknown name."""
    if name == "numpy":
        from . import numpy_batch
        return numpy_batch
    if name == "lanes":
        from . import numba_lanes
        return numba_lanes
    raise ConfigurationError(f"unknown backend {name!r}; known: {', '.join(NAMES)}")
