"""The running suite: session, supervision, wires, player, relay and viewer, the live view."""
