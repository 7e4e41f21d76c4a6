"""Sending in real time.

Absolute deadlines on the monotonic clock, so nothing drifts; what is late is sent at once and caught up.
"""

import socket
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass

import can
from canedge_bridge.transport import open_bus

from .can_wire import Frame
from .errors import SimulationError
from .stream import Kind, Output
from .truth import Truth

EARLY = 0.0003
"""s. A frame due this soon goes out at once: a bus is not more exact than that."""
LATE = 0.005


@dataclass
class Report:
    """What became of a run.

    worst_delay: latest departure after its deadline [s]; late: outputs more than 5 ms behind.
    """

    ncom_packets: int = 0
    can_frames: int = 0
    can_errors: int = 0
    late: int = 0
    worst_delay: float = 0.0

    def as_dict(self) -> dict[str, float]:
        return asdict(self)


class Wires:
    """The UDP socket and the CAN bus. Raises SimulationError naming the option that cannot be served."""

    def __init__(self, ncom_host: str, ncom_port: int, can_interface: str, can_channel: str):
        self.report = Report()
        try:
            self._address = (socket.gethostbyname(ncom_host), ncom_port)
        except OSError as error:
            raise SimulationError(f"--ncom-host {ncom_host}: {error}") from None
        try:
            self._bus = open_bus(can_interface, can_channel)
        except (ValueError, OSError, can.CanError) as error:
            raise SimulationError(f"--can-interface {can_interface} --can-channel {can_channel}: {error}") from None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def send_ncom(self, packet: bytes) -> None:
        try:
            self._socket.sendto(packet, self._address)
            self.report.ncom_packets += 1
        except OSError:
            # Nobody there, or the buffer is full: a unit on a network would not notice either.
            pass

    def send_frame(self, frame: Frame) -> None:
        try:
            self._bus.send(frame.message)
            self.report.can_frames += 1
        except (can.CanError, OSError):
            self.report.can_errors += 1

    def close(self) -> None:
        self._bus.shutdown()
        self._socket.close()


def send(
    outputs: Iterable[Output],
    wires: Wires,
    keep_truth: Callable[[Truth], None],
    started: float,
    stopped: Callable[[], bool],
) -> Report:
    """Until the outputs end or `stopped`. started: monotonic time of the start of the drive [s]."""
    report = wires.report
    for output in outputs:
        deadline = started + output.due
        wait = deadline - time.monotonic()
        # Frames of one instant leave together; a packet never leaves before what it says was measured.
        if wait > (0.0 if output.kind is Kind.NCOM else EARLY):
            time.sleep(wait)
        if stopped():
            break
        if output.kind is Kind.NCOM:
            wires.send_ncom(output.payload)
        elif output.kind is Kind.CAN:
            wires.send_frame(output.payload)
        else:
            keep_truth(output.payload)
            continue
        delay = time.monotonic() - deadline
        report.worst_delay = max(report.worst_delay, delay)
        report.late += delay > LATE
    return report
