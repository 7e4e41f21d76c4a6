"""python -m bench.checks: run the matrix and print what came out; see `main`."""

import sys

from .command import main

sys.exit(main())
