"""`st identify`: data files in, parameters with uncertainty, figures and a vehicle file out."""
