"""Recordings checked: the gate every verb passes them through, and the work and the output of `st check`."""
