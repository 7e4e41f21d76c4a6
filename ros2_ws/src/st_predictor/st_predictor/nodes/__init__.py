"""The nodes of the package: thin wrappers around st_core and st_recordings."""
