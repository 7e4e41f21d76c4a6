"""Exceptions of st_core; all errors that it raises deliberately."""


class StCoreError(ValueError):
    """Base of all errors raised by st_core."""


class ConfigurationError(StCoreError):
    """A vehicle file or setting that makes a start impossible. Its text is one line for the user."""
