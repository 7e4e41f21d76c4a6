"""python -m bench.checks: run the matrix and print the results; see `main`."""

import sys

from .command import main

sys.exit(main())
