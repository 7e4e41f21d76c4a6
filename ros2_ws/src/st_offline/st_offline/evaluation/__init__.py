"""`st evaluate`: makes the table and figures of the paper from recordings."""
