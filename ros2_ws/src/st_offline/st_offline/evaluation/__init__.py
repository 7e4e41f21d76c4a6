"""`st evaluate`: reproduces the table and figures of the paper from recordings."""
