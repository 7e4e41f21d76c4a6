"""Exceptions of st_core."""


class StCoreError(ValueError):
    """Data or settings that st_core cannot use."""


class ConfigurationError(StCoreError):
    """A file or setting that cannot be used. The text is one line for the user."""
