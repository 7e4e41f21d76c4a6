"""`st discover`: from recordings to the name of what the model lacks, a model file and a page."""
