"""YAML files of the virtual car."""

from pathlib import Path
from typing import Any

from st_core import plain_yaml
from st_core.errors import ConfigurationError

from .errors import SimulationError


def read_document(path: Path) -> Any:
    """The content of a YAML file of plain values. Raises SimulationError naming the file."""
    try:
        return plain_yaml.load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SimulationError(f"{path}: cannot be read: {error.strerror}") from None
    except (ConfigurationError, UnicodeDecodeError) as error:
        raise SimulationError(f"{path}: is not YAML as wanted here: {error}") from None
