"""Message classes by name."""

import importlib


def message_class(type_name: str) -> type | None:
    """The class of "pkg/msg/Type"; None where it is not installed."""
    package, _, name = type_name.replace("/msg/", "/").partition("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        return None
