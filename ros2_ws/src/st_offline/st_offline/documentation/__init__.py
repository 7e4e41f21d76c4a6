"""Pages of docs/ that are made from the code and from real output: `st docs`."""
