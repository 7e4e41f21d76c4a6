"""`st evaluate`: recordings in, the paper's table and figures out."""
