"""All fuzz targets by name."""

from . import recordings, tables, wires

TARGETS = {target.name: target for target in (*wires.TARGETS, *tables.TARGETS, *recordings.TARGETS)}
