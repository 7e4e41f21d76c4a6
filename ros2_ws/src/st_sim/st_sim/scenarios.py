"""What is driven: S1 to S7 of the paper and the standard manoeuvres. All of them go on until they are stopped.

The paper prints R ~ 23 m and R ~ 20 m where its own error table fits the diameters; 11.5 m and 10 m are used.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any, Protocol

from canedge_bridge.table_reader import TableError, read_document

from .errors import SimulationError
from .path import Path, Piece, SpeedProfile, lane_shift, straight, turn

LONGEST_ROAD = 20_000.0
"""m, of one round given by a file."""
FASTEST = 100.0
"""m/s."""
PEDAL_LEAD = 0.15
"""s."""
SPEED_SLACK = 0.15
"""m/s."""


@dataclass(frozen=True)
class Demand:
    """What the driver is to do now.

    steer: "path" (follow the road), "hold" (hands still) or a road-wheel angle [rad, left +].
    """

    speed: float
    acceleration: float
    steer: str | float = "path"


class Plan(Protocol):
    """start: distance along the path to start at [m]."""

    path: Path
    start: float

    def speed_at(self, distance: float) -> float:
        """What the car drives there when the drive begins [m/s]."""
        ...

    def demand(self, time: float, distance: float, speed: float) -> Demand: ...


class RoadPlan:
    """Follow the road at the speed that belongs to it."""

    def __init__(self, pieces: Sequence[Piece], acceleration: float = 1.2, braking: float = 1.5, start: float = 0.0):
        self.path = Path(pieces)
        self._profile = SpeedProfile(self.path, acceleration, braking)
        self.start = start

    def speed_at(self, distance: float) -> float:
        return self._profile.at(distance)[0]

    def demand(self, time: float, distance: float, speed: float) -> Demand:
        # The foot is a little slow: it starts to move before the speed has to change.
        return Demand(self._profile.at(distance)[0], self._profile.at(distance + PEDAL_LEAD * speed)[1])


@dataclass(frozen=True)
class Phase:
    """Part of a plan; steer as in Demand.

    Ends after `duration` [s], or when the car is slower than `until` [m/s]. Braking to a stop: until 0.
    """

    steer: str
    acceleration: float = 0.0
    duration: float = math.inf
    until: float = -1.0


class PhasePlan:
    """A circle driven in phases, over and over: cruise, brake, rest, pull away."""

    def __init__(self, radius: float, side: int, speed: float, phases: Sequence[Phase]):
        self.path = Path([Piece(2 * math.pi * radius, side / radius, side / radius, speed)])
        self.start = 0.0
        self._cruise, self._phases = speed, tuple(phases)
        self._index, self._since, self._wanted, self._last = 0, 0.0, speed, 0.0

    def speed_at(self, distance: float) -> float:
        return self._cruise

    def demand(self, time: float, distance: float, speed: float) -> Demand:
        phase = self._phases[self._index]
        if time - self._since >= phase.duration - 1e-9 or speed <= phase.until:
            self._index, self._since = (self._index + 1) % len(self._phases), time
            phase = self._phases[self._index]
        dt, self._last = time - self._last, time
        self._wanted = min(max(self._wanted + phase.acceleration * dt, 0.0), self._cruise)
        if phase.acceleration < 0:
            # While the brakes build up the car falls behind; catching that up would be braking harder than wanted.
            self._wanted = max(self._wanted, speed - SPEED_SLACK)
        reached = phase.acceleration > 0 and self._wanted >= self._cruise
        return Demand(self._wanted, 0.0 if reached else phase.acceleration, phase.steer)


class OpenLoopPlan:
    """Constant speed and a hand that does not look at the road.

    steer(time) -> road-wheel angle [rad], time from the start >= 0.
    """

    def __init__(self, speed: float, steer: Callable[[float], float]):
        self.path = Path(straight(100.0, speed))
        self.start, self._speed, self._steer = 0.0, speed, steer

    def speed_at(self, distance: float) -> float:
        return self._speed

    def demand(self, time: float, distance: float, speed: float) -> Demand:
        return Demand(self._speed, 0.0, self._steer(time) if time >= 0 else "path")


def _circle(lateral_acceleration: float, radius: float = 11.5) -> Plan:
    speed = math.sqrt(lateral_acceleration * radius)
    return RoadPlan([Piece(2 * math.pi * radius, 1 / radius, 1 / radius, speed)])


def _figure_eight(radius: float = 11.5, loop_deg: float = 240.0, blend: float = 6.0, speed: float = 4.0) -> Plan:
    """Left loop, straight, right loop, straight; the straights are as long as it takes to close.

    Chord / |cos(loop / 2)|.
    """
    end = Path(turn(radius, loop_deg, speed, blend)).pose(
        Path(turn(radius, loop_deg, speed, blend)).length * (1 - 1e-12)
    )
    length = math.hypot(end.x, end.y) / abs(math.cos(math.radians(loop_deg / 2)))
    pieces = [
        *turn(radius, loop_deg, speed, blend),
        *straight(length, speed),
        *turn(radius, -loop_deg, speed, blend),
        *straight(length, speed),
    ]
    return RoadPlan(pieces, start=-length / 2)


def _u_turns() -> Plan:
    """Right, left, left; turned by 180 deg after that, so two rounds close."""
    return RoadPlan(
        [
            *straight(24, 6),
            *turn(8, -180, 4, 5),
            *straight(26, 6),
            *turn(8, 180, 4, 5),
            *straight(26, 6),
            *turn(8, 180, 4, 5),
            *straight(2, 6),
        ]
    )


def _roundabout() -> Plan:
    """16 m/s slightly right (1.1 m/s^2), brake, 450 deg to the left at 5 m/s, back to 16 m/s."""
    return RoadPlan(
        [*straight(30, 16), *turn(230, -24, 16, 20), *straight(85, 16), *turn(12, 450, 5, 7), *straight(110, 16)],
        acceleration=1.6,
        braking=2.0,
    )


def _sweep(speed: float = 14.0, amplitude: float = 0.055) -> Plan:
    """0.2 to 2.8 Hz in 26 s, exponential, then 4 s straight."""
    low, high, length, pause = 0.2, 2.8, 26.0, 4.0
    rate = math.log(high / low) / length

    def steer(time: float) -> float:
        t = time % (length + pause)
        return amplitude * math.sin(2 * math.pi * low / rate * (math.exp(rate * t) - 1)) if t < length else 0.0

    return OpenLoopPlan(speed, steer)


def _step(speed: float = 12.0, amplitude: float = 0.09) -> Plan:
    """Left for 4 s, straight for 3 s, right for 4 s, straight for 3 s; 0.09 rad at 12 m/s is about 4 m/s^2."""

    def steer(time: float) -> float:
        t = time % 14.0
        return 0.0 if t < 3 or 7 <= t < 10 else amplitude if t < 7 else -amplitude

    return OpenLoopPlan(speed, steer)


def _ramp_to_limit(speed: float = 11.0, rate: float = 0.016, top: float = 0.4) -> Plan:
    """Slowly in to beyond the friction limit, quickly out, rest; then to the other side."""
    up, out, rest = top / rate, 2.0, 4.0
    period = up + out + rest

    def steer(time: float) -> float:
        half, t = divmod(time, period)
        angle = rate * t if t < up else top * max(0.0, 1 - (t - up) / out)
        return angle if half % 2 == 0 else -angle

    return OpenLoopPlan(speed, steer)


def _lane_change(speed: float = 12.0) -> Plan:
    """Double lane change: 3.5 m to the left within 30 m, 25 m there, back."""
    return RoadPlan(
        [
            *straight(40, speed),
            *lane_shift(3.5, 30, speed),
            *straight(25, speed),
            *lane_shift(-3.5, 30, speed),
            *straight(35, speed),
        ]
    )


def _brake_in_turn() -> Plan:
    """R = 30 m to the left at 4 m/s^2, then 4 m/s^2 of braking with the hands still, down to 3 m/s, and again."""
    return PhasePlan(
        30.0,
        1,
        math.sqrt(4.0 * 30.0),
        [
            Phase("path", duration=8.0),
            Phase("hold", acceleration=-4.0, until=3.0),
            Phase("path", acceleration=2.0, duration=6.0),
        ],
    )


def _circle_to_rest() -> Plan:
    """R = 10 m to the right at 1.5 m/s^2; brakes at 1.5 m/s^2 to rest, stands 4 s, pulls away and does it again."""
    return PhasePlan(
        10.0,
        -1,
        math.sqrt(1.5 * 10.0),
        [
            Phase("path", duration=18.0),
            Phase("path", acceleration=-1.5, until=0.0),
            Phase("path", duration=4.0),
            Phase("path", acceleration=1.2, duration=5.0),
        ],
    )


SCENARIOS: dict[str, tuple[Callable[[], Plan], str]] = {
    "S1": (_figure_eight, "figure eight at 4 m/s, R = 11.5 m"),
    "S2": (lambda: _circle(1.5), "left circle, R = 11.5 m, 1.5 m/s^2"),
    "S3": (lambda: _circle(3.77), "left circle, R = 11.5 m, 3.8 m/s^2"),
    "S4": (lambda: _circle(6.37), "left circle, R = 11.5 m, 6.4 m/s^2"),
    "S5": (_circle_to_rest, "right circle, R = 10 m, 1.5 m/s^2, brake to standstill, pull away, again"),
    "S6": (_u_turns, "U-turns right, left, left with straights, 4 to 6 m/s"),
    "S7": (_roundabout, "16 m/s, slightly right, brake to 5 m/s, 450 deg roundabout, back to 16 m/s"),
    "sweep": (_sweep, "sine steering 0.2 to 2.8 Hz at 14 m/s"),
    "step": (_step, "steps of steering to both sides at 12 m/s"),
    "lane_change": (_lane_change, "double lane changes at 12 m/s"),
    "brake_in_turn": (_brake_in_turn, "R = 30 m at 4 m/s^2, braking at 4 m/s^2 with the hands still"),
    "ramp_to_limit": (_ramp_to_limit, "steering slowly increased to the limit at 11 m/s"),
}


def load(name: str) -> Plan:
    """A fresh plan by name, or from a YAML file (see config/manoeuvres). Raises SimulationError."""
    if name in SCENARIOS:
        return SCENARIOS[name][0]()
    if name.endswith((".yaml", ".yml")):
        return _from_file(FilePath(name))
    raise SimulationError(f"--scenario {name}: there are {', '.join(SCENARIOS)}, or a .yaml file")


def _from_file(file: FilePath) -> Plan:
    try:
        document = read_document(file)
    except TableError as error:
        raise SimulationError(str(error)) from None
    try:
        pieces = [piece for row in document["road"] for piece in _pieces(row)]
        if not pieces:
            raise ValueError("no rows")
        if not sum(abs(piece.length) for piece in pieces) <= LONGEST_ROAD:
            raise ValueError(f"longer than {LONGEST_ROAD:g} m")
        pedals = [float(document.get(key, usual)) for key, usual in (("acceleration", 1.2), ("braking", 1.5))]
        if not all(0.01 <= pedal <= 20.0 for pedal in pedals):
            raise ValueError(f"acceleration and braking {pedals}: 0.01 to 20 m/s^2 wanted")
        return RoadPlan(pieces, *pedals)
    except (ArithmeticError, AttributeError, KeyError, StopIteration, TypeError, ValueError) as error:
        raise SimulationError(
            f"{file}: road: {error!r}; rows are {{straight: m, speed: m/s}}, {{turn: deg, radius: m, blend: m, "
            "speed: m/s} or {shift: m, length: m, speed: m/s}"
        ) from None


def _pieces(row: dict[str, Any]) -> list[Piece]:
    values = {key: float(value) for key, value in row.items()}
    kind = next(key for key in ("straight", "turn", "shift") if key in values)
    size, speed = values.pop(kind), values.pop("speed")
    if not 0 < speed <= FASTEST:
        raise ValueError(f"speed {speed:g} is not above 0 and at most {FASTEST:g} m/s")
    made = {
        "straight": lambda: straight(size, speed),
        "turn": lambda: turn(values.pop("radius"), size, speed, values.pop("blend", 0.0)),
        "shift": lambda: lane_shift(size, values.pop("length"), speed),
    }[kind]()
    if values:
        raise ValueError(f"unknown key {next(iter(values))}")
    return made
