"""Code shared by all nodes: parameters with unit and range, diagnostics, polled topics, scheduling and shutdown."""

import os
import sys
from pathlib import Path

# Without this check, importing rclpy would end the process with a line of C code.
_prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
_found = {path.name for prefix in _prefixes for path in Path(prefix, "share/ament_index/resource_index").glob(
    "rmw_typesupport/*")} - {"rmw_implementation"}
if _found and (_name := os.environ.get("RMW_IMPLEMENTATION")) and _name not in _found:
    print(f"RMW_IMPLEMENTATION: {_name} is not installed; use {' or '.join(sorted(_found))}", file=sys.stderr)
    sys.exit(2)
