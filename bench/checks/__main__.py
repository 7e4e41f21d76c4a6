"""Runs the corruption matrix: python -m bench.checks."""

import sys

from .command import main

sys.exit(main())
