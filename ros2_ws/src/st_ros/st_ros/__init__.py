"""Code shared by all nodes: parameters with unit and range, diagnostics, polled topics, scheduling and shutdown."""
