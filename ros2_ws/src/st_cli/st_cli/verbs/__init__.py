"""The commands of `st`, which import their libraries only when they run, because `st --help` must be fast."""
