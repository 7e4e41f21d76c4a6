"""Reads recordings of every kind: `find_runs` groups files into runs, and `read` converts a run to a DriveLog.

    for source in find_runs(paths):
        try:
            run = read(source, vehicle)
        except RunError as error:
            ...            # one sentence for the user; the batch continues
"""

from .errors import RunError
from .load import read
from .run_types import Label, LoadedRun, ReadSettings, RunSource
from .sources import find_runs

__all__ = ["Label", "LoadedRun", "ReadSettings", "RunError", "RunSource", "find_runs", "read"]
