"""Checks of recordings: the command `st check`, and the check before other commands use a recording."""
