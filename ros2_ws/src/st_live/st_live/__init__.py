"""The running suite: processes, supervision, replay, verification, relay and views."""
