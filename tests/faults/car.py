"""A car on a circle, as it looks on the wires: NCOM at the rate of the unit, CAN frames with counters and checksums.

It costs a few per cent of a core, so that what is measured is the suite. The circle is exact and never ends.
"""

import math
import threading
import time
from collections.abc import Iterator

from canedge_bridge.decode import Decoder
from st_offline.paths import config
from st_sim.can_wire import Background, CanWire, Frame
from st_sim.geodesy import Origin
from st_sim.ncom_wire import NcomWire
from st_sim.sensors import InsReading, WheelSpeeds

from .wires import Wire, pack

RADIUS, SPEED = 30.0, 8.0  # m, m/s
STEERING_WHEEL = 1.55  # rad, about what the circle takes
GRAVITY = 9.81
TICK = 0.002  # s
STEERING_PERIOD, WHEEL_PERIOD = 10, 20  # ms
COUNTERS = 256  # values of the widest counter; the others go round several times


def reading(t: float) -> InsReading:
    """The INS point t seconds after the start, a left turn from the origin towards east."""
    angle = SPEED / RADIUS * t
    place = (RADIUS * math.sin(angle), RADIUS - RADIUS * math.cos(angle), 0.0)
    rates = (0.0, 0.0, SPEED / RADIUS)
    return InsReading(t, *place, SPEED, 0.0, 0.0, math.remainder(angle, math.tau), 0.0, 0.0, rates,
                      (0.0, SPEED**2 / RADIUS, GRAVITY))


class Car(threading.Thread):
    """Sends until it is closed. extra: more CAN datagrams every tick. `behind`: the latest departure so far [s]."""

    def __init__(self, ins: Wire, can: Wire, ncom_rate: int = 100, full_bus: bool = False):
        super().__init__(name="car", daemon=True)
        self.ins, self.can = ins, can
        self.extra: tuple[bytes, ...] = ()
        self.behind = 0.0
        self._ncom_period = round(1000 / ncom_rate)
        self._ncom_rate, self._full_bus = ncom_rate, full_bus
        self._ending = threading.Event()

    def run(self) -> None:
        start_ns = time.time_ns() // 10**6 * 10**6
        began = time.monotonic()
        origin = Origin(51.0, 4.0, 50.0)
        unit = NcomWire(origin, start_ns, self._ncom_rate)
        wires = CanWire(Decoder(config("can/leaf_ze0.dbc"), config("can/leaf_ze0.yaml")), origin, start_ns)
        frames = _Frames(wires, self._full_bus)
        now = 0
        while not self._ending.is_set():
            wait = began + now / 1000 - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            self.behind = max(self.behind, -wait)
            if now % self._ncom_period == 0:
                self.ins.send(unit.packet(reading(now / 1000)))
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
    """All frames of the bus, packed once: nothing but the counters changes."""

    def __init__(self, wires: CanWire, full: bool):
        def packed(frames: list[Frame]) -> list[bytes]:
            return [pack(frame.message) for frame in frames]

        speeds = WheelSpeeds((SPEED,) * 4, SPEED)
        self._steering = [packed(wires.steering(STEERING_WHEEL, 0.0)) for _ in range(COUNTERS)]
        self._wheels = [packed(wires.wheel_speeds(speeds)) for _ in range(COUNTERS)]
        background = Background(0) if full else None
        self._others = [packed(background.frames(ms)) for ms in range(100)] if background else []

    def at(self, now: int) -> Iterator[bytes]:
        """now: even milliseconds since the start; what is due in this one and the next."""
        if now % STEERING_PERIOD == 2:
            yield from self._steering[now // STEERING_PERIOD % COUNTERS]
        if now % WHEEL_PERIOD == 6:
            yield from self._wheels[now // WHEEL_PERIOD % COUNTERS]
        if self._others:
            yield from self._others[now % 100]
            yield from self._others[(now + 1) % 100]
