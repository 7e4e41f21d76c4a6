"""Numbers as JSON has them: no NaN, no infinity, no arrays."""

import json
import math
from collections.abc import Mapping
from typing import Any


def finite(value: Any) -> Any:
    """The same with plain Python numbers; what is not finite is null."""
    if isinstance(value, Mapping):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    number = float(value)
    return number if math.isfinite(number) else None


def as_text(content: Mapping[str, Any]) -> str:
    """The text of a file, to be read by people too."""
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
