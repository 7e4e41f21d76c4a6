"""One file per verb of the st command."""
