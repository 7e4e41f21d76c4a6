"""python -m bench.discovery: run cases and print the results; see `main`."""

import sys

from . import main

sys.exit(main())
