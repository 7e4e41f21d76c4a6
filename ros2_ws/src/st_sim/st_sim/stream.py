"""Generates the output of the virtual car in chronological order, and sends it to sockets, buses or files."""

import heapq
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import can
from canedge_bridge.transport import open_bus
from oxts_bridge.ncom import INITIALISING, LOCKED, LOCKING, RAW_IMU
from st_core.errors import ConfigurationError

from .driver import SimulatedCar
from .encoders import FRAME_TIME, NO_DATA, BackgroundTraffic, CanEncoder, NcomEncoder
from .plant import Truth
from .recorded_drive import RecordedDrive
from .sensors import Ins, SteeringSensor, TransmissionLoss, read_wheel_speeds
from .settings import Settings

Source = SimulatedCar | RecordedDrive
TICK_MS = 2  # time step of the stream; every schedule is a multiple of it
# Period and phase [ms]; the phases differ, because the sensors of a car share no clock.
TRUTH_SCHEDULE, STEERING_SCHEDULE, WHEEL_SCHEDULE, GEAR_SCHEDULE = (10, 0), (10, 2), (20, 6), (60, 8)
INS_CAN_DELAY = 0.0015  # s from the datagram to the first CAN frame of the same epoch
EARLY_TOLERANCE = 0.0003  # s; a frame due within this time is sent at once; a real bus has similar jitter
LATE_THRESHOLD = 0.005  # s after the deadline; an output sent later counts as late
# s after power-up of an INS: ends of the phases without data and with raw data, then start and end of initialising.
NO_DATA_END, RAW_IMU_END, INITIALISING_START, INITIALISING_END = 0.5, 2.0, 3.0, 7.0
LOCKING_DURATION = 11.0  # s


class Output(NamedTuple):
    """due: time of sending [s since the start]. order: rank at equal times. payload: packet, frame or true state."""

    due: float
    order: int
    payload: bytes | can.Message | Truth


def find_start_up_status(time: float) -> tuple[int, float] | None:
    """Navigation status and delay [s] of the epoch at `time` [s] after power-up; None if no packet is sent.

    Phases: nothing valid, then raw IMU, both at 10 Hz; pause; initialising, delay 1 s; locking, delay falling; locked.
    """
    if time < RAW_IMU_END:
        return (NO_DATA if time < NO_DATA_END else RAW_IMU, 0.0) if round(time * 1000) % 100 == 0 else None
    if time < INITIALISING_START:
        return None
    if time < INITIALISING_END:
        return INITIALISING, 1.0
    progress = (time - INITIALISING_END) / LOCKING_DURATION
    return (LOCKING, 1.0 - progress) if progress < 1.0 else (LOCKED, 0.0)


def _is_due(now_ms: int, schedule: tuple[int, int]) -> bool:
    period, phase = schedule
    return now_ms % period == phase


class Stream:
    """Generator of outputs. ins_rate: INS epochs per second. start_up: whether time 0 is the power-up of the INS."""

    def __init__(self, source: Source, settings: Settings, ins: Ins, steering: SteeringSensor, ncom: NcomEncoder,
                 can: CanEncoder, ins_rate: int, seed: int, background: bool = False, start_up: bool = False):
        self._source, self._settings = source, settings
        self._ins, self._steering, self._ncom, self._can = ins, steering, ncom, can
        self._ins_schedule = 1000 // ins_rate, 0
        self._background = BackgroundTraffic(seed) if background else None
        self._start_up = start_up
        self._ins_loss = TransmissionLoss(settings["ins_packet_loss"], settings["ins_outage_every"], (seed, 7))
        self._can_loss = TransmissionLoss(settings["can_frame_loss"], settings["can_outage_every"], (seed, 8))
        self._queue: list[Output] = []
        self._output_count = 0

    def generate_outputs(self, duration: float) -> Iterator[Output]:
        """Yield the outputs of the measurements in [0, duration) in the order of `due`, while the source advances."""
        for now_ms in range(0, round(duration * 1000), TICK_MS):
            time = now_ms / 1000
            self._source.advance(time)
            self._queue_measurements(now_ms, time)
            next_time = (now_ms + TICK_MS) / 1000
            while self._queue and self._queue[0].due < next_time:
                yield heapq.heappop(self._queue)
        while self._queue:
            yield heapq.heappop(self._queue)

    def _queue_measurements(self, now_ms: int, time: float) -> None:
        if _is_due(now_ms, self._ins_schedule):
            self._queue_ins(self._source.make_truth(), time)
        if _is_due(now_ms, TRUTH_SCHEDULE):
            self._push(time, self._source.make_truth())
        if _is_due(now_ms, STEERING_SCHEDULE):
            truth = self._source.make_truth()
            frames = self._can.encode_steering(self._steering.read(truth), truth.steering_wheel_rate)
            self._queue_frames(frames, time + self._settings["steering_sensor_latency"])
        if _is_due(now_ms, WHEEL_SCHEDULE):
            wheel_speeds, vehicle_speed = read_wheel_speeds(self._source.make_truth(), self._settings)
            self._queue_frames(self._can.encode_wheel_speeds(wheel_speeds, vehicle_speed), time)
        if _is_due(now_ms, GEAR_SCHEDULE):
            self._queue_frames(self._can.encode_gear(self._source.make_truth().gear), time)
        if self._background:
            for ms in range(now_ms, now_ms + TICK_MS):
                self._queue_frames(self._background.select_frames(ms), ms / 1000)

    def _queue_ins(self, truth: Truth, time: float) -> None:
        reading = self._ins.read(truth)
        status_and_delay = find_start_up_status(time) if self._start_up else (LOCKED, 0.0)
        if status_and_delay is None:
            return
        status, delay = status_and_delay
        due = time + self._settings["ins_latency"] + delay
        packet = self._ncom.encode_packet(reading, status)
        if not self._ins_loss.is_lost(time):
            self._push(due, packet)
        if status >= INITIALISING:
            self._queue_frames(self._can.encode_ins(reading), due + INS_CAN_DELAY)

    def _queue_frames(self, frames: list[can.Message], due: float) -> None:
        for i, frame in enumerate(frames):
            if not self._can_loss.is_lost(due):
                self._push(due + i * FRAME_TIME, frame)

    def _push(self, due: float, payload: bytes | can.Message | Truth) -> None:
        self._output_count += 1
        heapq.heappush(self._queue, Output(due, self._output_count, payload))


@dataclass
class Report:
    """Numbers of sent outputs, of frames not sent, of outputs later than LATE_THRESHOLD, and largest delay [s]."""

    ncom_packets: int = 0
    can_frames: int = 0
    can_errors: int = 0
    late: int = 0
    worst_delay: float = 0.0


class LiveOutput:
    """UDP socket and CAN bus for the output. Raises ConfigurationError naming the option if one cannot be opened."""

    def __init__(self, ncom_host: str, ncom_port: int, can_interface: str, can_channel: str):
        self.report = Report()
        try:
            self._address = (socket.gethostbyname(ncom_host), ncom_port)
        except OSError as error:
            raise ConfigurationError(f"--ncom-host {ncom_host}: {error.strerror}") from None
        try:
            self._bus = open_bus(can_interface, can_channel)
        except (ValueError, OSError, can.CanError) as error:
            raise ConfigurationError(f"--can-interface {can_interface} --can-channel {can_channel}: {error}") from None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def send_ncom(self, packet: bytes) -> None:
        try:
            self._socket.sendto(packet, self._address)
            self.report.ncom_packets += 1
        except OSError:
            pass  # no receiver or a full buffer, which a real INS does not detect either

    def send_frame(self, frame: can.Message, due: float) -> None:
        try:
            self._bus.send(frame)
            self.report.can_frames += 1
        except (can.CanError, OSError):
            self.report.can_errors += 1

    def close(self) -> None:
        self._bus.shutdown()
        self._socket.close()


def send(outputs: Iterable[Output], send_ncom: Callable[[bytes], object],
         send_frame: Callable[[can.Message, float], object], record_truth: Callable[[Truth], None] | None,
         stop_requested: Callable[[], bool], report: Report, start_time: float | None = None) -> float:
    """Send outputs at their deadlines, late ones at once, until there are no more or stop_requested() returns True;
    returns the due time of the last one sent [s since the start], 0 without any. start_time: monotonic time of the
    start of the drive [s]; None: send as fast as possible."""
    due = 0.0
    for output in outputs:
        deadline = time.monotonic() if start_time is None else start_time + output.due
        wait = deadline - time.monotonic()
        # A packet must not arrive before its time of measurement.
        if wait > (0.0 if isinstance(output.payload, bytes) else EARLY_TOLERANCE):
            time.sleep(wait)
        if stop_requested():
            break
        due = output.due
        if isinstance(output.payload, Truth):
            if record_truth is not None:
                record_truth(output.payload)
            continue
        if isinstance(output.payload, bytes):
            send_ncom(output.payload)
        else:
            send_frame(output.payload, due)
        delay = time.monotonic() - deadline
        report.worst_delay = max(report.worst_delay, delay)
        report.late += delay > LATE_THRESHOLD
    return due
