"""Provenance of an identified value of a vehicle file: uncertainty, method, data, date."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .errors import ConfigurationError
from .yaml_text import format_number, quote

TEXTS = ("method", "data", "date")
KEYS = ("uncertainty", *TEXTS)


@dataclass(frozen=True)
class Provenance:
    """Provenance of an identified value."""

    uncertainty: float | None = None  # standard deviation in SI, None if unknown
    method: str = ""  # free text
    data: str = ""  # free text
    date: str = ""  # YYYY-MM-DD

    def format_entries(self) -> str:
        """The entries as text for a vehicle file, each preceded by a comma."""
        parts = [] if self.uncertainty is None else [f"uncertainty: {format_number(self.uncertainty)}"]
        parts += [f"{key}: {quote(getattr(self, key))}" for key in TEXTS if getattr(self, key)]
        return "".join(f", {part}" for part in parts)


def read_provenance(key: str, entry: Mapping[str, Any], factor: float) -> Provenance | None:
    """The provenance of an entry of a vehicle file; None if it has none. factor: converts the unit of the entry to SI.

    Raises ConfigurationError, naming the key, for an invalid uncertainty or a text that is not a string.
    """
    if not any(name in entry for name in KEYS):
        return None
    uncertainty = entry.get("uncertainty")
    if uncertainty is not None:
        if isinstance(uncertainty, bool) or not isinstance(uncertainty, int | float):
            raise ConfigurationError(f"{key}.uncertainty: {uncertainty!r} is not a number (write 1.0e+3, not 1e3)")
        if not (math.isfinite(uncertainty) and uncertainty >= 0.0):
            raise ConfigurationError(f"{key}.uncertainty: {uncertainty:g} is not a standard deviation (finite, >= 0)")
        uncertainty = float(uncertainty) * factor
    texts = {}
    for name in TEXTS:
        # YAML parses an unquoted day as a date object; its text is the same.
        texts[name] = str(entry[name]) if name == "date" and name in entry else entry.get(name, "")
        if not isinstance(texts[name], str):
            raise ConfigurationError(f"{key}.{name}: {texts[name]!r} is not a string")
    return Provenance(uncertainty, **texts)
