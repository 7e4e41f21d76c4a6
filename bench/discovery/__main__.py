"""python -m bench.discovery: run cases and print what came out; see `main`."""

import sys

from . import main

sys.exit(main())
