"""`st discover`: identifies physical effects missing from the model, and writes vehicle file, model file and page."""
