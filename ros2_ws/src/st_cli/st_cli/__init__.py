"""The program `st`: commands, options and error messages."""
