"""Exceptions of st_core."""


class StCoreError(ValueError):
    """Base of all errors raised by st_core."""


class ConfigurationError(StCoreError):
    """A file or setting that cannot be used. The text is one line for the user."""
