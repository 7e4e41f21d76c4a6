"""`st identify`: identifies parameters with uncertainty from data files, and writes figures and a vehicle file."""
