"""Brings a growing file to the disk in a separate thread, so that a loss of power costs no more than its end."""

import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path

SHORTEST_PERIOD = 0.25
"""s, between two synchronisations: a writer that wakes more often must not keep the disk busy all the time."""


class Syncer:
    """Calls fdatasync on one file in a separate thread, after each `wake`.

    error: what the disk reported, empty without an error. It is never cleared: data refused once may be missing,
    whatever the system reports afterwards. count: synchronisations so far. longest: the slowest of them [s].
    """

    def __init__(self, descriptor: int, folders: Sequence[Path]):
        """folders: synchronised once, with the first data: a file without its directory entry is lost too."""
        # A duplicate: the writer may close its descriptor at any moment, and the number is then given to another file.
        self._descriptor = os.dup(descriptor)
        self._folders = tuple(folders)
        self._condition = threading.Condition()
        # When the oldest data was handed over [s, monotonic]: of what waits, and of what is being synchronised.
        self._waiting_since: float | None = None
        self._syncing_since: float | None = None
        self._stopped = False
        self.error = ""
        self.count, self.longest = 0, 0.0
        self._thread = threading.Thread(target=self._work, name="sync", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Reports that something was written. Returns at once."""
        with self._condition:
            if self._waiting_since is None:
                self._waiting_since = time.monotonic()
            self._condition.notify()

    @property
    def behind(self) -> float:
        """How long the oldest data that is not on the disk has been waiting [s]."""
        with self._condition:
            since = [t for t in (self._waiting_since, self._syncing_since) if t is not None]
        return time.monotonic() - min(since) if since else 0.0

    def stop(self) -> None:
        """Ends the thread and waits for it; what was not synchronised stays so."""
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
                    _sync_folder(self._folders[0])
                    self._folders = self._folders[1:]
            except OSError as error:
                self.error = error.strerror or str(error)
            with self._condition:
                self._syncing_since = None
                self.count, self.longest = self.count + 1, max(self.longest, time.monotonic() - began)
        os.close(self._descriptor)


def _sync_folder(folder: Path) -> None:
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except FileNotFoundError:
        return  # renamed or deleted meanwhile: the writer notices and reports
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
