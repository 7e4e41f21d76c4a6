"""Reads NCOM bytes in a separate thread, from a UDP port or from a file replayed with its recorded timing."""

import socket
import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path

import numpy as np
from st_core.measurement_history import unexplained_displacement

from .file_decoder import UNKNOWN_TIME, decode_file
from .geometry import LocalFrame
from .ncom import MINUTE_MS, PACKET_SIZE, Packet, decode

# Linux socket option and message type for the kernel's receive time; not every Python build defines the name.
_SO_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)
_TIMESPEC = struct.Struct("@qq")
_LARGEST_DATAGRAM = 65_535  # bytes
_RECEIVE_BUFFER = 1 << 20  # bytes
_WAKE_PERIOD = 0.2  # s; longest time until the thread notices stop()
RETRY_PERIOD = 1.0  # s between attempts to open the port
SENDER_TIMEOUT = 2.0  # s; if the sender in use is silent for longer, another one is accepted
_MAX_COUNTED_SENDERS = 16
# A longer step of the recorded time [ns] comes from joined files or a clock change; the replay does not wait for it.
LONGEST_PAUSE_NS = 60_000_000_000
LONGEST_CONTINUATION_MS = 1_000  # a datagram from another port continues the stream only within this time

# (bytes, received_ns, publish) -> number of packets. publish: whether to publish them; false before the start offset.
OnData = Callable[[bytes, int, bool], int]


def continues_stream(newest: Packet | None, data: bytes) -> bool:
    """Whether a datagram continues a stream; false for a second unit at the same address.

    The first packet in `data` must be at most 1 s later than the newest packet of the stream, at a position consistent
    with the velocity. False also without a packet, or if a position or velocity is unknown.
    """
    if newest is None:
        return False
    try:
        packet = decode(data[:PACKET_SIZE])
        frame = LocalFrame(newest.latitude, newest.longitude, newest.altitude)
        east, north, _ = frame.to_enu(packet.latitude, packet.longitude, packet.altitude)
    except ValueError:  # not a packet, or a position is not finite
        return False
    elapsed_ms = (packet.milliseconds - newest.milliseconds) % MINUTE_MS
    # Rows (x, y, yaw, v_x, v_y) in axes that point east and north.
    rows = tuple((x, y, 0.0, p.velocity_ned[1], p.velocity_ned[0])
                 for x, y, p in ((0.0, 0.0, newest), (east, north, packet)))
    if not 0 < elapsed_ms <= LONGEST_CONTINUATION_MS or not all(map(isfinite, (*rows[0], *rows[1]))):
        return False
    return not unexplained_displacement(elapsed_ms * 1.0e-3, *rows)


@dataclass
class SourceStatus:
    """State of a source for the diagnostics."""

    name: str
    problem: str = ""  # reason why no data can arrive, or empty
    is_done: bool = False  # a replay has reached its end
    sender: str = ""  # address in use
    is_shared: bool = False  # another program had the UDP port open before
    datagrams: int = 0  # received datagrams, or packets of a replay
    # Number from each of the first 16 ignored senders, by address, or by address and port for the address in use.
    ignored_datagrams: dict[str, int] = field(default_factory=dict)
    competing_datagrams: int = 0  # ignored ones from other ports of this address or, without a filter, from any sender
    progress: float = 0.0  # fraction of the file replayed
    loops: int = 0  # completed passes of a looped replay


class Source(ABC):
    """Source of NCOM bytes, read in a separate thread."""

    def __init__(self, name: str):
        self.status = SourceStatus(name)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread if it runs; returns within about 0.2 s."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    @abstractmethod
    def _run(self) -> None: ...


class UdpSource(Source):
    """Receives the datagrams of a UDP port; a port that cannot be opened is retried every second.

    Without a filter, only the first address that sends NCOM is used until it is silent for SENDER_TIMEOUT, so that two
    units on one network do not mix. Of this address, only the first port is used; datagrams from another port are
    accepted if they continue the stream (from a sender that opens a port per datagram, or a restarted relay).
    """

    def __init__(self, address: str, port: int, sender_filter: str, on_data: OnData, on_change: Callable[[], None],
                 continues: Callable[[bytes], bool] = lambda data: False):
        """sender_filter: IP address, or empty for any sender. on_change: called from the thread when `problem` changes.
        continues: tests whether a datagram from another port continues the stream, see `continues_stream`."""
        super().__init__(f"udp {address}:{port}")
        self._address, self._port, self._filter = address, port, sender_filter
        self._on_data, self._on_change, self._continues = on_data, on_change, continues
        self._sender: tuple[str, int] | None = None  # address and port in use
        self._last_packet_at = float("-inf")
        self._open_attempted = threading.Event()

    def start(self) -> None:
        """Start the thread; returns after the first attempt to open the port."""
        super().start()
        self._open_attempted.wait()

    def _run(self) -> None:
        family = socket.AF_INET6 if ":" in self._address else socket.AF_INET
        while not self._stop.is_set():
            try:
                with socket.socket(family, socket.SOCK_DGRAM) as sock:
                    self._open(sock)
                    self._set_problem("")
                    self._receive(sock)
            except OSError as error:
                self._set_problem(f"cannot listen on {self._address} port {self._port}: {error.strerror or error}; "
                                  "retrying every second")
                self._stop.wait(RETRY_PERIOD)

    def _open(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        sock.settimeout(_WAKE_PERIOD)
        try:
            sock.bind((self._address, self._port))
            self.status.is_shared = False
        except OSError:  # in use: opened too if the other program permits it
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((self._address, self._port))
            self.status.is_shared = True
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # permit others, which receive broadcasts too

    def _receive(self, sock: socket.socket) -> None:
        ancillary = socket.CMSG_SPACE(_TIMESPEC.size)
        while not self._stop.is_set():
            try:
                data, control, _, peer = sock.recvmsg(_LARGEST_DATAGRAM, ancillary)
            except TimeoutError:
                continue
            self._process(data, _extract_kernel_time(control), peer[:2])

    def _process(self, data: bytes, received_ns: int, sender: tuple[str, int]) -> None:
        self.status.datagrams += 1
        address, port = sender
        if sender != self._sender and not self._accepts(address, data):
            same_address = address == self.status.sender
            self.status.competing_datagrams += same_address or not self._filter
            name, ignored = f"{address} port {port}" if same_address else address, self.status.ignored_datagrams
            if name in ignored or len(ignored) < _MAX_COUNTED_SENDERS:
                ignored[name] = ignored.get(name, 0) + 1
        elif self._on_data(data, received_ns, True):
            self._last_packet_at = time.monotonic()
            self._sender, self.status.sender = sender, address

    def _accepts(self, address: str, data: bytes) -> bool:
        """Whether to use the datagram of a sender other than the one in use."""
        silent = time.monotonic() - self._last_packet_at > SENDER_TIMEOUT
        return self._filter in ("", address) and (silent or (address == self.status.sender and self._continues(data)))

    def _set_problem(self, problem: str) -> None:
        changed, self.status.problem = problem != self.status.problem, problem
        self._open_attempted.set()
        if changed:
            self._on_change()


def _extract_kernel_time(control: list[tuple[int, int, bytes]]) -> int:
    """Kernel receive time of a datagram [ns since 1970], or the current time if the kernel gives none."""
    for level, kind, data in control:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            return seconds * 1_000_000_000 + nanoseconds
    return time.time_ns()


class ReplaySource(Source):
    """Replays a file packet by packet with its recorded timing.

    The constructor raises NcomError for a file without packets and OSError for one that cannot be read.
    """

    def __init__(self, path: Path, on_data: OnData, on_restart: Callable[[], None], speed_factor: float = 1.0,
                 loop: bool = False, start_offset: float = 0.0):
        """start_offset: [s] after the first time in the file; earlier packets are not published, but update the status.
        on_restart: called before each repetition."""
        super().__init__(f"file {path}")
        columns = decode_file(path)
        self._packets = columns.raw
        self._due = _compute_due_times(columns.gps_ns, start_offset)
        self._on_data, self._on_restart = on_data, on_restart
        self._speed, self._loop = speed_factor, loop

    def _run(self) -> None:
        self._play()
        while self._loop and not self._stop.is_set():
            self.status.loops += 1
            self._on_restart()
            self._play()
        self.status.is_done = not self._stop.is_set()

    def _play(self) -> None:
        start = time.monotonic()
        for number, (packet, due) in enumerate(zip(self._packets, self._due.tolist(), strict=True), 1):
            now = time.monotonic()
            start = now if due < 0 else start  # packets before the start offset are sent at once
            if self._stop.wait(start + max(due, 0) * 1e-9 / self._speed - now):
                return
            self._on_data(packet.tobytes(), time.time_ns(), due >= 0)
            self.status.datagrams += 1
            self.status.progress = number / len(self._packets)


def _compute_due_times(gps_ns: np.ndarray, start_offset: float) -> np.ndarray:
    """Time to send each packet at normal speed [ns after the start], negative before the start offset [s].

    A packet without a time is sent with the previous packet; before the first time, with the first timed packet.
    """
    timed = np.flatnonzero(gps_ns != UNKNOWN_TIME)
    if not len(timed):
        return np.zeros(len(gps_ns), np.int64)
    steps = np.diff(gps_ns[timed], prepend=gps_ns[timed[0]])
    steps[(steps < 0) | (steps > LONGEST_PAUSE_NS)] = 0
    due = np.cumsum(steps) - round(start_offset * 1e9)
    newest = np.searchsorted(timed, np.arange(len(gps_ns)), side="right") - 1
    return due[np.maximum(newest, 0)]
