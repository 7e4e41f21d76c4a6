"""Brings a growing file to the disk in a thread of its own, so that a loss of power costs no more than its end."""

import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path

# Between two beginnings; a writer that hands over more often than this must not keep the disk busy all the time.
SHORTEST_PERIOD = 0.25


class Syncer:
    """fdatasync of one file in a thread of its own, after each `wake`.

    error: of the disk, empty without one. It stays: data refused once may be missing, whatever the
    system reports afterwards. longest: the slowest so far [s].
    """

    def __init__(self, descriptor: int, folders: Sequence[Path]):
        """folders: brought to the disk once, with the first data: a file without its directory entry is
        lost too.
        """
        # One of its own: the writer's may be closed, and its number given to another file, at any moment.
        self._descriptor = os.dup(descriptor)
        self._folders = tuple(folders)
        self._condition = threading.Condition()
        # When what is not on the disk yet was handed over first, and the same of what the disk works on [s, monotonic].
        self._since: float | None = None
        self._working_on: float | None = None
        self._stopped = False
        self.error = ""
        self.count, self.longest = 0, 0.0
        self._thread = threading.Thread(target=self._work, name="sync", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Something was written. Returns at once."""
        with self._condition:
            if self._since is None:
                self._since = time.monotonic()
            self._condition.notify()

    @property
    def behind(self) -> float:
        """How long the oldest data that is not on the disk has been waiting [s]."""
        with self._condition:
            waiting = [since for since in (self._since, self._working_on) if since is not None]
        return time.monotonic() - min(waiting) if waiting else 0.0

    def stop(self) -> None:
        """Returns when the thread has ended; what was not synced stays so."""
        with self._condition:
            self._stopped = True
            self._condition.notify()
        self._thread.join()

    def _work(self) -> None:
        began = float("-inf")
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._stopped or self._since is not None)
                early = began + SHORTEST_PERIOD - time.monotonic()
                if early > 0.0:
                    self._condition.wait_for(lambda: self._stopped, early)
                if self._stopped:
                    break
                self._working_on, self._since = self._since, None
            began = time.monotonic()
            try:
                os.fdatasync(self._descriptor)
                while self._folders:
                    _sync_folder(self._folders[0])
                    self._folders = self._folders[1:]
            except OSError as error:
                self.error = error.strerror or str(error)
            with self._condition:
                self._working_on = None
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
