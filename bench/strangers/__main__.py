"""Runs the benchmark: python -m bench.strangers."""

import sys

from .command import main

sys.exit(main())
