"""Runs the benchmark: python -m bench.discovery."""

import sys

from . import main

sys.exit(main())
