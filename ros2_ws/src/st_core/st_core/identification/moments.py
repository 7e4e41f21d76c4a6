"""INS and steering samples, as they arrive, made into moments for `recursive.RecursiveIdentifier`.

Both are interpolated every 20 ms, never across a gap, and averaged over blocks of 0.1 s. The derivatives at a block are
the central differences of its neighbours' averages, so all quantities of a moment belong to the same instant, one block
before the newest. Checked by: test_recursive.py.
"""

from collections.abc import Iterator

import numpy as np

from ..timeseries import TimeSeries
from ..types import InsSample
from ..vehicle import VehicleParameters
from .recursive import Moment

GRID_NS = 20_000_000
POINTS = 5
BLOCK = POINTS * GRID_NS * 1e-9  # s
# Samples are kept until both signals are known; a node that was held up takes ten seconds of them at once.
SPAN, MAXIMUM_GAP = 12.0, 0.1  # s


class Moments:
    """Samples in (any order within half a second), moments out. A jump of time begins anew."""

    def __init__(self, vehicle: VehicleParameters):
        self.vehicle = vehicle
        self._ins = TimeSeries(("velocity_x", "velocity_y", "yaw_rate"), SPAN, MAXIMUM_GAP)
        self._steering = TimeSeries(("steering_wheel_angle",), SPAN, MAXIMUM_GAP)
        self._next: int | None = None
        self._points: list[tuple[float, ...]] = []
        self._blocks: list[np.ndarray] = []

    def add_ins(self, sample: InsSample) -> bool:
        """An INS sample at the INS point; False if it was refused."""
        row = (sample.velocity_x, sample.velocity_y, sample.yaw_rate)
        position, jumped = self._ins.add(sample.time_ns, row)
        if jumped:
            self._steering.clear()
            self._start_over()
        return position is not None

    def add_steering(self, time_ns: int, steering_wheel_angle: float) -> bool:
        """The hand wheel as the sensor says [rad], left +; False if it was refused."""
        return self._steering.add(time_ns, (steering_wheel_angle,))[0] is not None

    def take(self) -> Iterator[Moment]:
        """Moments that are complete by now, oldest first."""
        if not len(self._ins) or not len(self._steering):
            return
        newest = int(min(self._ins.times[-1], self._steering.times[-1]))
        oldest = int(max(self._ins.times[0], self._steering.times[0]))
        if self._next is None or self._next < oldest:
            self._start_over()
            self._next = -(-oldest // GRID_NS) * GRID_NS
        while self._next <= newest:
            ins, steering = self._ins.at(self._next), self._steering.at(self._next)
            self._next += GRID_NS
            if ins is None or steering is None:
                self._points.clear()
                self._blocks.clear()
                continue
            self._points.append((*ins, *steering))
            if len(self._points) == POINTS:
                yield from self._block()

    def _block(self) -> Iterator[Moment]:
        car = self.vehicle
        v_x, v_y, r, hand = np.mean(self._points, axis=0)
        self._points.clear()
        # To the CG: frames.ins_to_cg, for velocities.
        self._blocks.append(np.array([v_x + r * car.cg_to_ins_y, v_y - r * car.cg_to_ins_x, r, hand]))
        if len(self._blocks) == 3:
            before, at, after = self._blocks
            v_x_dot, v_y_dot, r_dot, speed = (after - before) / (2.0 * BLOCK)
            yield Moment(*map(float, (*at[:3], v_x_dot, v_y_dot, r_dot, at[3], speed, BLOCK)))
            self._blocks.pop(0)

    def _start_over(self) -> None:
        self._next = None
        self._points.clear()
        self._blocks.clear()
