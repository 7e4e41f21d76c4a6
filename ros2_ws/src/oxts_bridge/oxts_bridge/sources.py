"""Where the bytes come from: a UDP port or a file at its own pace, each a thread that hands over what it gets."""

import ipaddress
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .file_decoder import UNKNOWN_TIME, decode_file

# Linux: request and message type of the kernel's receive time; Python's socket module does not name it everywhere.
_SO_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)
_TIMESPEC = struct.Struct("@qq")
_LARGEST_DATAGRAM = 65_535
_RECEIVE_BUFFER = 1 << 20
_WAKE_PERIOD = 0.2
RETRY_PERIOD = 1.0
# Another sender is taken when the one in use has been silent this long.
SENDER_PATIENCE = 2.0
_MOST_SENDERS = 16
# A step of the file's time longer than this is a joined file or a set clock, not a pause to sit through.
LONGEST_PAUSE_NS = 60_000_000_000

# on_data(bytes, received_ns, wanted) -> number of packets in it; wanted: false while a replay runs up to its start
# offset.
OnData = Callable[[bytes, int, bool], int]


@dataclass
class SourceStatus:
    """trouble: why nothing can come, empty when all is well.  done: a replay has reached its end.  sender: address in
    use.

    others: datagrams per ignored address, with its port where that is all that differs.  rivals: those of the latter,
    together.  progress: share of a file replayed so far.  loops: completed.
    """

    name: str
    trouble: str = ""
    done: bool = False
    sender: str = ""
    datagrams: int = 0
    others: dict[str, int] = field(default_factory=dict)
    rivals: int = 0
    progress: float = 0.0
    loops: int = 0


class UdpSource:
    """Reads every datagram of a port as it comes. A port that cannot be opened is tried again every second.

    Without a filter it stays with the first address that sends NCOM, so that two units on one network do not mix. Of
    two ports of one address it stays with the first as well; what comes from another is taken where it continues the
    stream (a sender that opens a port for every datagram, a relay that was started again).
    """

    def __init__(self, address: str, port: int, sender_filter: str, on_data: OnData, on_change: Callable[[], None],
                 continues: Callable[[bytes], bool] = lambda data: False):
        """sender_filter: IP address, or empty for any. on_change: called from the thread when `trouble` comes or
        goes. continues: whether a datagram goes on where the stream in use has been, see continuity.py."""
        self.status = SourceStatus(f"udp {address}:{port}")
        self._address, self._port, self._filter = address, port, sender_filter
        self._on_data, self._on_change, self._continues = on_data, on_change, continues
        self._in_use: tuple[str, int] | None = None
        self._heard = float("-inf")
        self._stop = threading.Event()
        self._tried = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ncom-udp", daemon=True)

    def start(self) -> None:
        """Returns when the port is open, or could not be opened."""
        self._thread.start()
        self._tried.wait()

    def stop(self) -> None:
        """Ends the thread, if it runs; returns within about 0.2 s."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                with self._open() as sock:
                    self._tell("")
                    self._receive(sock)
            except OSError as error:
                self._tell(self._explain(error))
                self._stop.wait(RETRY_PERIOD)

    def _open(self) -> socket.socket:
        family = socket.AF_INET6 if ":" in self._address else socket.AF_INET
        sock = socket.socket(family, socket.SOCK_DGRAM)
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            sock.settimeout(_WAKE_PERIOD)
            sock.bind((self._address, self._port))
        except OSError:
            sock.close()
            raise
        return sock

    def _receive(self, sock: socket.socket) -> None:
        ancillary = socket.CMSG_SPACE(_TIMESPEC.size)
        while not self._stop.is_set():
            try:
                data, control, _, peer = sock.recvmsg(_LARGEST_DATAGRAM, ancillary)
            except TimeoutError:
                continue
            self._take(data, _kernel_time(control), peer[:2])

    def _take(self, data: bytes, received_ns: int, sender: tuple[str, int]) -> None:
        self.status.datagrams += 1
        if sender != self._in_use and not self._chosen(sender[0], data):
            self._ignore(*sender)
        elif self._on_data(data, received_ns, True):
            self._heard = time.monotonic()
            self._in_use, self.status.sender = sender, sender[0]

    def _chosen(self, address: str, data: bytes) -> bool:
        """Whether the datagram of a sender that is not the one in use is to be taken."""
        if self._filter and address != self._filter:
            return False
        if time.monotonic() - self._heard > SENDER_PATIENCE:
            return True
        return self._in_use is not None and address == self._in_use[0] and self._continues(data)

    def _ignore(self, address: str, port: int) -> None:
        status = self.status
        rival = self._in_use is not None and address == self._in_use[0]
        status.rivals += rival
        name = f"{address} port {port}" if rival else address
        if name in status.others or len(status.others) < _MOST_SENDERS:
            status.others[name] = status.others.get(name, 0) + 1

    def _tell(self, trouble: str) -> None:
        changed, self.status.trouble = trouble != self.status.trouble, trouble
        self._tried.set()
        if changed:
            self._on_change()

    def _explain(self, error: OSError) -> str:
        reason = error.strerror or error
        return f"cannot listen on {self._address} port {self._port}: {reason}; trying again every second"


def _kernel_time(control: list[tuple[int, int, bytes]]) -> int:
    for level, kind, data in control:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            return seconds * 1_000_000_000 + nanoseconds
    return time.time_ns()


def is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


class ReplaySource:
    """Feeds a file packet by packet at the pace of its own times. Raises NcomError or OSError at once for a file
    without."""

    def __init__(
        self,
        path: Path,
        on_data: OnData,
        on_restart: Callable[[], None],
        speed_factor: float = 1.0,
        loop: bool = False,
        start_offset: float = 0.0,
    ):
        """start_offset: [s] after the first time in the file; what comes before only sets the status. on_restart: at
        a loop."""
        self.status = SourceStatus(f"file {path}")
        columns = decode_file(path)
        self._data = path.read_bytes()
        self._offsets = columns.offset
        self._due = _due_times(columns.gps_ns, start_offset)
        self._on_data, self._on_restart = on_data, on_restart
        self._speed, self._loop = speed_factor, loop
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ncom-replay", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._play()
            if not self._loop or self._stop.is_set():
                break
            self.status.loops += 1
            self._on_restart()
        self.status.done = not self._stop.is_set()

    def _play(self) -> None:
        start = time.monotonic()
        count = len(self._offsets)
        for number, (offset, due) in enumerate(zip(self._offsets.tolist(), self._due.tolist(), strict=True), 1):
            if due >= 0:
                wait = start + due * 1e-9 / self._speed - time.monotonic()
                if wait > 0 and self._stop.wait(wait):
                    return
            self._on_data(self._data[offset : offset + 72], time.time_ns(), due >= 0)
            self.status.datagrams += 1
            self.status.progress = number / count


def _due_times(gps_ns: np.ndarray, start_offset: float) -> np.ndarray:
    """When to send each packet [ns after the start], -1 for those before the start offset. Packets without a time go
    at once."""
    known = gps_ns != UNKNOWN_TIME
    if not known.any():
        return np.zeros(len(gps_ns), np.int64)
    times = gps_ns[known]
    steps = np.diff(times, prepend=times[:1])
    steps[(steps < 0) | (steps > LONGEST_PAUSE_NS)] = 0
    due = np.full(len(gps_ns), -1, np.int64)
    due[known] = np.cumsum(steps) - round(start_offset * 1e9)
    # Fill gaps with the time of the packet before, and the head with the first time.
    filled = np.maximum.accumulate(np.where(known, np.arange(len(due)), -1))
    return np.where(filled >= 0, due[np.maximum(filled, 0)], due[np.argmax(known)])
