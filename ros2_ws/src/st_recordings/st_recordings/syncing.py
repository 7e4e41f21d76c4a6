"""Synchronises a growing file with the disk in a separate thread, so that a power failure loses only its last data."""

import contextlib
import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path

SHORTEST_PERIOD = 0.25
"""Minimum time [s] between the starts of two synchronisations, so that frequent writes do not occupy the disk."""


class Syncer:
    """Calls fdatasync on one file in a separate thread after `wake`, at most once per SHORTEST_PERIOD.

    error: text of the last error, or empty. It is never cleared, because data of a failed call may be missing even if
    later calls succeed. count: number of calls, with failed ones. longest: duration of the slowest call [s].
    """

    def __init__(self, descriptor: int, folders: Sequence[Path]):
        """folders: directories to synchronise once, because a file without a directory entry is lost."""
        # Duplicated, because the writer may close its descriptor, and its number may then be reused for another file.
        self._descriptor = os.dup(descriptor)
        self._folders = tuple(folders)
        self._condition = threading.Condition()
        # Write times [s, monotonic] of the oldest data to be synchronised, and of the oldest data being synchronised.
        self._waiting_since: float | None = None
        self._syncing_since: float | None = None
        self._stopped = False
        self.error = ""
        self.count, self.longest = 0, 0.0
        self._thread = threading.Thread(target=self._work, name="sync", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Requests a synchronisation after a write. Returns at once."""
        with self._condition:
            if self._waiting_since is None:
                self._waiting_since = time.monotonic()
            self._condition.notify()

    @property
    def delay(self) -> float:
        """Age of the oldest data whose synchronisation has not ended [s]; 0 if there is none."""
        with self._condition:
            since = [t for t in (self._waiting_since, self._syncing_since) if t is not None]
        return time.monotonic() - min(since) if since else 0.0

    def stop(self) -> None:
        """Ends the thread and waits for it; remaining data is not synchronised."""
        with self._condition:
            self._stopped = True
            self._condition.notify()
        self._thread.join()

    def _work(self) -> None:
        began = float("-inf")
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._stopped or self._waiting_since is not None)
                pause = began + SHORTEST_PERIOD - time.monotonic()
                if pause > 0.0:
                    self._condition.wait_for(lambda: self._stopped, pause)
                if self._stopped:
                    break
                self._syncing_since, self._waiting_since = self._waiting_since, None
            began = time.monotonic()
            try:
                os.fdatasync(self._descriptor)
                while self._folders:
                    with contextlib.suppress(FileNotFoundError):  # renamed or deleted, which the writer reports
                        descriptor = os.open(self._folders[0], os.O_RDONLY | os.O_DIRECTORY)
                        try:
                            os.fsync(descriptor)
                        finally:
                            os.close(descriptor)
                    self._folders = self._folders[1:]
            except OSError as error:
                self.error = error.strerror or str(error)
            with self._condition:
                self._syncing_since = None
                self.count, self.longest = self.count + 1, max(self.longest, time.monotonic() - began)
        os.close(self._descriptor)
