"""Backends, which compute batches of predictions from the unchanged functions of a Model. A backend is a module with

    LANES                                                       number of columns advanced together
    advance(model, p, start, w, offsets, step, points) -> out   RK4 of all columns

    p: `model.parameters(vehicle)`. start: (states, n), n a multiple of LANES. w: (fields, m), from `model.inputs`.
    offsets: (2 * steps + 1,); column i has w[:, offsets[k] + i] at time k * step / 2. points: step numbers, increasing.
    out: (len(points), 6, n), states at these steps. NaN in a column makes only that column NaN.

numpy_batch needs only numpy; numba_lanes needs numba (imported when used) and is five to twenty times faster.
casadi_backend does not advance batches: it builds symbolic functions.
"""

import importlib.util
import logging
from functools import cache
from types import ModuleType

from ..errors import ConfigurationError

NAMES = ("lanes", "numpy")


def get_backend(name: str | None = None) -> ModuleType:
    """Backend by name; None: fastest. Raises ConfigurationError for an unknown name, and for lanes without numba."""
    if name is None:
        name = "lanes" if has_numba() else "numpy"
        if name == "numpy":
            _warn_numpy()
    if name == "numpy":
        from . import numpy_batch
        return numpy_batch
    if name == "lanes":
        if not has_numba():
            raise ConfigurationError("backend lanes: numba is not installed; install it or use backend numpy")
        from . import numba_lanes
        return numba_lanes
    raise ConfigurationError(f"unknown backend {name!r}; known: {', '.join(NAMES)}")


@cache
def has_numba() -> bool:
    """Whether numba is installed; does not import it."""
    return importlib.util.find_spec("numba") is not None


@cache
def _warn_numpy() -> None:
    logging.getLogger(__name__).warning("numba is not installed: batches run in numpy, five to twenty times slower")
