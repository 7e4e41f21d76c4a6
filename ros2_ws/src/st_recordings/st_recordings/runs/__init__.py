"""Reads recordings of every kind: `find_runs` groups files into runs, and `read` returns the LoadedRun of one.

    for source in find_runs(paths):
        try:
            run = read(source, vehicle)
        except RunError as error:
            ...            # str(error) is one sentence for the user; continue with the next run
"""

from .errors import RunError
from .load import read
from .run_types import Label, LoadedRun, ReadSettings, RunSource
from .sources import find_runs

__all__ = ["Label", "LoadedRun", "ReadSettings", "RunError", "RunSource", "find_runs", "read"]
