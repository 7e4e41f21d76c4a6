"""Exceptions of st_core."""

from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


class StCoreError(ValueError):
    """Data or settings that st_core cannot use."""


class ConfigurationError(StCoreError):
    """A file or setting that cannot be used. The text is one line for the user."""


def add_prefix(prefix: str, make: Callable[[], T], incomplete: str = "") -> T:
    """Result of `make`; a prefix, such as the name of the file, is added to the text of a ConfigurationError.
    incomplete: if given, text of the ConfigurationError in place of other errors, such as one for a missing key."""
    try:
        return make()
    except ConfigurationError as error:
        raise ConfigurationError(f"{prefix}{error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, IndexError):
        if not incomplete:
            raise
        raise ConfigurationError(f"{prefix}{incomplete}") from None
