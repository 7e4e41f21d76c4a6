"""Code shared by all nodes: parameters with unit and range, diagnostics, polled topics, scheduling and shutdown."""

import os
import sys
from pathlib import Path


def _check_middleware() -> None:
    """Exit with status 2 and one line if RMW_IMPLEMENTATION is not installed; rclpy would end the process with a line
    of C code."""
    indexes = [Path(prefix, "share/ament_index/resource_index/rmw_typesupport")
               for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)]
    installed = {file.name for index in indexes if index.is_dir() for file in index.iterdir()} - {"rmw_implementation"}
    if installed and (name := os.environ.get("RMW_IMPLEMENTATION")) and name not in installed:
        print(f"RMW_IMPLEMENTATION: {name} is not installed; use {' or '.join(sorted(installed))}", file=sys.stderr)
        sys.exit(2)


_check_middleware()
