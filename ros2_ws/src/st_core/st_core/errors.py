"""Exceptions of st_core; all errors that it raises deliberately."""


class StCoreError(ValueError):
    """Base of all errors raised by st_core."""


class ConfigurationError(StCoreError):
    """An unusable file or setting. The text is one line for the user."""
