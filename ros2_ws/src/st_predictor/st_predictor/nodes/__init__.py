"""The nodes of the package: thin shells around st_core and st_recordings."""
