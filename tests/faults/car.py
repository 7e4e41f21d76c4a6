"""A simulated car that sends NCOM packets at the rate of the unit, and CAN frames with counters and checksums.

It uses a few per cent of a core, so that it hardly loads the measured suite.
"""

import math
import threading
import time
from collections.abc import Iterator
from typing import Protocol

import can
from canedge_bridge.decode import Decoder
from st_core.vehicle import VehicleParameters
from st_recordings.paths import config
from st_sim.encoders import BackgroundTraffic, CanEncoder, NcomEncoder, Origin
from st_sim.sensors import InsReading
from winding_road import RATE, Truth, winding_road

from .wires import Wire, pack

GRAVITY = 9.81
TICK = 0.002  # s
STEERING_PERIOD, WHEEL_PERIOD = 10, 20  # ms


class Drive(Protocol):
    """t: seconds after the start."""

    def reading(self, t: float) -> InsReading:
        """Measurement at the INS point."""

    def steering_wheel(self, t: float) -> float:
        """Steering wheel angle, left positive [rad]."""


class Circle:
    """An endless left turn without noise that starts at the origin towards east."""

    RADIUS, SPEED = 30.0, 8.0  # m, m/s
    STEERING_WHEEL = 1.55  # rad, approximately that of the circle

    def reading(self, t: float) -> InsReading:
        radius, speed = self.RADIUS, self.SPEED
        angle = speed / radius * t
        place = (radius * math.sin(angle), radius - radius * math.cos(angle), 0.0)
        return InsReading(t, *place, speed, 0.0, 0.0, math.remainder(angle, math.tau), 0.0, 0.0,
                          (0.0, 0.0, speed / radius), (0.0, speed**2 / radius, GRAVITY))

    def steering_wheel(self, t: float) -> float:
        return self.STEERING_WHEEL


class WindingRoad:
    """Straights and bends to both sides at 6 to 15 m/s with the noise of an INS with RTK: ordinary driving."""

    def __init__(self, seconds: float, seed: int = 1):
        file = config("vehicle/leaf.yaml")
        vehicle = VehicleParameters.from_yaml(file.read_text(), str(file))
        truth = Truth(vehicle.steering_wheel_offset, vehicle.steering_ratio, 1.0)
        self._rows = winding_road(vehicle, truth, seconds, seed)

    def _at(self, t: float) -> list[float]:
        whole, part = divmod(t * RATE, 1.0)
        before, after = self._rows[int(whole)], self._rows[int(whole) + 1]
        return (before + part * (after - before)).tolist()

    def reading(self, t: float) -> InsReading:
        _, x, y, yaw, v_x, v_y, rate, _ = self._at(t)
        return InsReading(t, x, y, 0.0, v_x, v_y, 0.0, math.remainder(yaw, math.tau), 0.0, 0.0, (0.0, 0.0, rate),
                          (0.0, v_x * rate, GRAVITY))

    def steering_wheel(self, t: float) -> float:
        return self._at(t)[-1]


class Car(threading.Thread):
    """Sends until it is closed. extra: further CAN datagrams in every tick. behind: largest delay so far [s]."""

    def __init__(self, ins: Wire, can: Wire, drive: Drive, ncom_rate: int = 100, full_bus: bool = False):
        super().__init__(name="car", daemon=True)
        self.ins, self.can, self._drive = ins, can, drive
        self.extra: tuple[bytes, ...] = ()
        self.behind = 0.0
        self._ncom_period = round(1000 / ncom_rate)
        self._ncom_rate, self._full_bus = ncom_rate, full_bus
        self._ending = threading.Event()

    def run(self) -> None:
        start_ns = time.time_ns() // 10**6 * 10**6
        began = time.monotonic()
        origin = Origin(51.0, 4.0, 50.0)
        unit = NcomEncoder(origin, start_ns, self._ncom_rate)
        encoder = CanEncoder(Decoder(config("can/leaf_ze0.dbc"), config("can/leaf_ze0.yaml")), origin, start_ns)
        frames = _Frames(encoder, self._drive, self._full_bus)
        now = 0
        while not self._ending.is_set():
            wait = began + now / 1000 - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            self.behind = max(self.behind, -wait)
            if now % self._ncom_period == 0:
                self.ins.send(unit.encode_packet(self._drive.reading(now / 1000)))
            for data in frames.at(now):
                self.can.send(data)
            for data in self.extra:
                self.can.send(data)
            now += round(TICK * 1000)

    def close(self) -> None:
        self._ending.set()
        if self.ident:
            self.join()
        self.ins.close()
        self.can.close()


class _Frames:
    """All frames of the bus. The constant frames of other control units are packed once."""

    def __init__(self, encoder: CanEncoder, drive: Drive, full: bool):
        self._encoder, self._drive = encoder, drive
        background = BackgroundTraffic(0) if full else None
        self._others = [_packed(background.select_frames(ms)) for ms in range(100)] if background else []

    def at(self, now: int) -> Iterator[bytes]:
        """Frames that are due in two milliseconds. now: the first of them, an even number since the start."""
        if now % STEERING_PERIOD == 2:
            yield from _packed(self._encoder.encode_steering(self._drive.steering_wheel(now / 1000), 0.0))
        if now % WHEEL_PERIOD == 6:
            speed = self._drive.reading(now / 1000).velocity_x
            yield from _packed(self._encoder.encode_wheel_speeds((speed,) * 4, speed))
        if self._others:
            yield from self._others[now % 100]
            yield from self._others[(now + 1) % 100]


def _packed(frames: list[can.Message]) -> list[bytes]:
    return [pack(frame) for frame in frames]
