"""Receives from a CAN bus in one thread, which opens the bus, reads frames, detects faults and reconnects.

python-can's Notifier is not used, because its thread ends at the first exception and no data arrive after that.
"""

import errno
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import can

from .transport import link_is_up

BACK_OFF_FIRST, BACK_OFF_LAST = 0.1, 5.0  # delay before the bus is reopened [s], doubled after each failure
_RECEIVE_TIMEOUT = 0.2  # timeout of recv [s]; stop(), silence and a removed interface are detected within this time
_ERROR_PASSIVE_TIMEOUT = 5.0  # s without an error frame; some controllers do not report the end of error-passive
# The host's time replaces a stamp that differs from it by more than this: some adapters count from power-on.
_MAX_STAMP_OFFSET_NS = 86_400 * 10**9


class BusState(StrEnum):
    """State of the bus as seen by the receiver."""

    OK = "ok"                        # frames are received
    SILENT = "silent"                # open, but no recent data or remote frame
    ERROR_PASSIVE = "error-passive"  # after many errors, the controller no longer sends active error flags
    BUS_OFF = "bus-off"              # the controller has disconnected from the bus
    DOWN = "down"                    # the interface exists but is switched off
    GONE = "gone"                    # the bus is not open: not opened yet, or opening or reading it has failed


@dataclass
class ReceiverStatus:
    """State of the receiver, and counts since its start. reason: of the state, one line; empty if the state is OK.
    delay, delay_maximum: median and maximum delay [s] from stamp to receipt of the last 512 data or remote frames."""

    state: BusState = BusState.GONE
    reason: str = "not opened yet"
    frames: int = 0  # data and remote frames
    error_frames: int = 0
    last_error: str = ""  # text of the newest error frame
    open_count: int = 0  # times the bus was opened
    failures: int = 0  # failures to open or read the bus
    callback_errors: int = 0  # number of frames for which `on_frame` raised an exception
    delay: float = float("nan")
    delay_maximum: float = float("nan")


class Receiver:
    """Calls `on_frame(frame, time_ns)` in its own thread for every frame, including error and remote frames.

    open_bus: opens the bus; called again after a failure to open or read it (except ENETDOWN when reading), after a
    delay of 0.1 s that doubles with each failure, up to 5 s.
    on_state(state, reason): called in the same thread at every change of state or reason.
    silence: seconds without a data or remote frame after which an open bus counts as silent.
    network_interface: checked while no frame arrives, because not every socket reports that its interface is down or
    removed; empty for a bus without a network interface.
    on_error: called with every exception raised by `on_frame`, `on_state` or by closing the bus; the thread continues.
    """

    def __init__(self, open_bus: Callable[[], can.BusABC], on_frame: Callable[[can.Message, int], None], *,
                 on_state: Callable[[BusState, str], None] = lambda state, reason: None,
                 on_error: Callable[[Exception], None] = lambda error: None,
                 silence: float = 1.0, network_interface: str = ""):
        self._open_bus, self._on_frame, self._on_state = open_bus, on_frame, on_state
        self._on_error, self._silence, self._network_interface = on_error, silence, network_interface
        self._status = ReceiverStatus()
        self._delays: deque[int] = deque(maxlen=512)
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._bus: can.BusABC | None = None
        self._back_off, self._last_frame_at, self._last_error_frame_at = BACK_OFF_FIRST, 0.0, 0.0
        self._thread = threading.Thread(target=self._run, name="can receiver", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread and closes the bus; returns when this is done. May be called twice."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def status(self) -> ReceiverStatus:
        with self._lock:
            status, delays = replace(self._status), list(self._delays)
        if delays:
            status.delay, status.delay_maximum = statistics.median(delays) * 1e-9, max(delays) * 1e-9
        return status

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                if self._bus is not None:
                    self._receive(self._bus)
                    continue
                self._bus = self._open_bus()
                self._last_frame_at = time.monotonic()
                with self._lock:
                    self._status.open_count += 1
                self._set_state(BusState.SILENT, "no frame yet")
            except Exception as error:  # no exception of a driver may end the thread
                self._handle_failure(error)
        self._close()

    def _close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            try:
                bus.shutdown()
            except Exception as error:  # a removed device may fail to close
                self._on_error(error)

    def _receive(self, bus: can.BusABC) -> None:
        frame = bus.recv(_RECEIVE_TIMEOUT)
        if frame is None:
            self._handle_silence()
            return
        now_ns = time.time_ns()
        # python-can converts the kernel's nanoseconds to a float with a resolution of 0.24 us.
        time_ns = round(frame.timestamp * 1e9)
        if abs(now_ns - time_ns) > _MAX_STAMP_OFFSET_NS:
            time_ns = now_ns
        self._back_off = BACK_OFF_FIRST
        if frame.is_error_frame:
            self._handle_error_frame(frame)
        else:
            self._last_frame_at = time.monotonic()
            with self._lock:
                self._delays.append(now_ns - time_ns)
                self._status.frames += 1
            if self._status.state is not BusState.OK and not self._is_passive():
                self._set_state(BusState.OK, "")
        try:
            self._on_frame(frame, time_ns)
        except Exception as error:
            with self._lock:
                self._status.callback_errors += 1
            self._on_error(error)

    def _handle_error_frame(self, frame: can.Message) -> None:
        text, state = describe_error_frame(frame)
        self._last_error_frame_at = time.monotonic()
        with self._lock:
            self._status.error_frames += 1
            self._status.last_error = text
        if state is BusState.OK:
            if self._status.state in (BusState.BUS_OFF, BusState.ERROR_PASSIVE):
                self._set_state(BusState.SILENT, f"{text}, no frame yet")
        elif state is not None:
            self._set_state(state, f"{text}; check the bit rate and the wiring")
        elif (self._status.state in (BusState.OK, BusState.SILENT, BusState.DOWN)
              and time.monotonic() - self._last_frame_at > self._silence):
            self._set_state(BusState.SILENT, "only error frames; check the bit rate and the wiring")

    def _is_passive(self) -> bool:
        """Whether the state is error-passive and an error frame was received within _ERROR_PASSIVE_TIMEOUT."""
        return (self._status.state is BusState.ERROR_PASSIVE
                and time.monotonic() - self._last_error_frame_at < _ERROR_PASSIVE_TIMEOUT)

    def _handle_silence(self) -> None:
        state = self._status.state
        is_up = link_is_up(self._network_interface)
        if is_up is None and self._network_interface:
            raise can.CanOperationError(f"interface {self._network_interface} was removed", errno.ENODEV)
        if is_up is False:
            self._set_state(BusState.DOWN, f"interface {self._network_interface} is down; switch it on: "
                            f"ip link set {self._network_interface} up")
            return
        self._back_off = BACK_OFF_FIRST
        is_silent = time.monotonic() - self._last_frame_at > self._silence
        if state is BusState.DOWN:
            self._set_state(BusState.SILENT, "interface is up again, no frame yet")
        elif is_silent and state in (BusState.OK, BusState.ERROR_PASSIVE) and not self._is_passive():
            self._set_state(BusState.SILENT, f"no frame for more than {self._silence:g} s")

    def _handle_failure(self, error: Exception) -> None:
        """Reports a failure and waits. A socket recovers from ENETDOWN by itself; other failures need a new socket."""
        with self._lock:
            self._status.failures += 1
        if _error_number(error) == errno.ENETDOWN and self._bus is not None:
            self._set_state(BusState.DOWN, f"interface is down: {_describe(error)}")
        else:
            self._close()
            self._set_state(BusState.GONE, _describe(error))
        self._stop.wait(self._back_off)
        self._back_off = min(2 * self._back_off, BACK_OFF_LAST)

    def _set_state(self, state: BusState, reason: str) -> None:
        changed = (self._status.state, self._status.reason) != (state, reason)
        with self._lock:
            self._status.state, self._status.reason = state, reason
        if changed:
            try:
                self._on_state(state, reason)
            except Exception as error:  # no exception of a callback may end the thread either
                self._on_error(error)


def _error_number(error: BaseException) -> int | None:
    """Error number of a python-can error (`error_code`), an OSError, or the cause of either; None if unknown."""
    for candidate in (error, error.__cause__, error.__context__):
        if code := getattr(candidate, "error_code", None) or getattr(candidate, "errno", None):
            return int(code)
    return None


def _describe(error: Exception) -> str:
    if _error_number(error) == errno.EAFNOSUPPORT:
        return "this kernel has no SocketCAN; try modprobe can_raw"
    return " ".join(str(error).split()) or type(error).__name__


# Error frames of SocketCAN, bits as in linux/can/error.h. python-can passes the identifier without flags.
_BUS_OFF, _RESTARTED, _CONTROLLER = 0x040, 0x100, 0x004
_ACTIVE, _PASSIVE = 0x40, 0x30  # in the controller status: error-active; receive or transmit error-passive
_CLASSES = {
    0x001: "transmit timeout", 0x002: "lost arbitration", 0x004: "controller", 0x008: "protocol violation",
    0x010: "transceiver", 0x020: "no acknowledge", 0x040: "bus-off", 0x080: "bus error", 0x100: "controller restarted",
    0x200: "error counters",
}
_CONTROLLER_STATUS = {
    0x01: "receive buffer overflow", 0x02: "transmit buffer overflow", 0x04: "receive warning level",
    0x08: "transmit warning level", 0x10: "receive error-passive", 0x20: "transmit error-passive", 0x40: "error-active",
}
_PROTOCOL = {
    0x01: "single bit", 0x02: "frame format", 0x04: "bit stuffing", 0x08: "dominant bit not sent",
    0x10: "recessive bit not sent", 0x20: "bus overload", 0x40: "active error announcement", 0x80: "on transmission",
}


def describe_error_frame(frame: can.Message) -> tuple[str, BusState | None]:
    """(text of the error classes in an error frame, bus state that it reports or None)."""
    bits = frame.arbitration_id
    data = bytes(frame.data).ljust(8, b"\0")
    details = {0x002: f"bit {data[0]}" if data[0] else "",
               0x004: ", ".join(name for bit, name in _CONTROLLER_STATUS.items() if data[1] & bit),
               0x008: ", ".join(name for bit, name in _PROTOCOL.items() if data[2] & bit),
               0x200: f"transmit {data[6]}, receive {data[7]}"}
    texts = [f"{name} ({details[bit]})" if details.get(bit) else name for bit, name in _CLASSES.items() if bits & bit]
    state = None
    if bits & _RESTARTED or (bits & _CONTROLLER and data[1] & _ACTIVE):
        state = BusState.OK
    if bits & _CONTROLLER and data[1] & _PASSIVE:
        state = BusState.ERROR_PASSIVE
    if bits & _BUS_OFF:
        state = BusState.BUS_OFF
    return ", ".join(texts) or f"unknown error class {bits:#x}", state
