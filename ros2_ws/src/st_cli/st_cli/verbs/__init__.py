"""The commands of `st`; they import their libraries only when called, so that `st --help` is fast."""
