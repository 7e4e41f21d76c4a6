"""Checks of recordings: the gate before every verb, and the command `st check`."""
