"""`st discover`: the physical effects that the model lacks, found in recordings; a model file and a page."""
