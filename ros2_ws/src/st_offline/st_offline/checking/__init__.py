"""Recordings checked: the gate every verb passes them through, and what `st check` does, says and writes."""
