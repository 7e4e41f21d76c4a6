"""Scenarios of unlimited duration: S1 to S7 of the paper, the manoeuvres of `st_core.manoeuvres`, and roads from files.

The paper states R ~ 23 m and R ~ 20 m, but its error table is consistent only with diameters of this size.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from pathlib import Path as FilePath
from typing import Any

from canedge_bridge.yaml_reader import read_document
from st_core.errors import ConfigurationError
from st_core.manoeuvres import CATALOGUE, Manoeuvre, PiecewiseLinear

from .path import Path, Piece, SpeedProfile, lane_shift, straight, turn

OpenLoopSteering = Callable[[float], Any]  # wheelbase of the car [m] -> road-wheel angle [rad], positive to the left

LONGEST_ROAD = 20_000.0  # m, longest lap of a road from a file
MAX_SPEED = 100.0  # m/s
MIN_RADIUS = 0.1  # m, of a road; below the turning circle of the smallest model cars
PEDAL_LEAD = 0.15  # s; the pedals move this long before the target speed changes
SPEED_SLACK = 0.15  # m/s; while braking, the target speed is at most this much below the speed


@dataclass(frozen=True)
class Demand:
    """Target of the driver: speed [m/s], acceleration [m/s^2], and steering, which is "path" (follow the road), "hold"
    (constant steering-wheel angle), or an open-loop road-wheel angle."""

    speed: float
    acceleration: float
    steering: str | OpenLoopSteering = "path"


class RoadPlan:
    """Plan that follows a road with its speed profile. acceleration, braking: limits of the profile [m/s^2, > 0]."""

    def __init__(self, pieces: Sequence[Piece], acceleration: float = 1.2, braking: float = 1.5):
        self.path = Path(pieces)
        self._profile = SpeedProfile(self.path, acceleration, braking)

    def speed_at(self, distance: float) -> float:
        """Target speed at a distance [m/s]."""
        return self._profile.interpolate(distance)[0]

    def make_demand(self, time: float, distance: float, speed: float) -> Demand:
        target_speed, _ = self._profile.interpolate(distance)
        _, acceleration = self._profile.interpolate(distance + PEDAL_LEAD * speed)
        return Demand(target_speed, acceleration)


@dataclass(frozen=True)
class Phase:
    """Phase of a plan; it ends after `duration` [s] or at `end_speed` [m/s] (-1: none). steering: see Demand."""

    steering: str
    acceleration: float = 0.0
    duration: float = math.inf
    end_speed: float = -1.0


class PhasePlan:
    """A circle driven in phases, which repeat. radius: [m]; side: 1 left, -1 right; speed: highest target [m/s]."""

    def __init__(self, radius: float, side: int, speed: float, phases: Sequence[Phase]):
        self.path = Path([Piece(2 * math.pi * radius, side / radius, side / radius, speed)])
        self._cruise_speed, self._phases = speed, tuple(phases)
        self._index, self._phase_start, self._target_speed, self._last_time = 0, 0.0, speed, 0.0

    def speed_at(self, distance: float) -> float:
        return self._cruise_speed

    def make_demand(self, time: float, distance: float, speed: float) -> Demand:
        phase = self._phases[self._index]
        if time - self._phase_start >= phase.duration - 1e-9 or speed <= phase.end_speed:
            self._index, self._phase_start = (self._index + 1) % len(self._phases), time
            phase = self._phases[self._index]
        dt, self._last_time = time - self._last_time, time
        self._target_speed = min(max(self._target_speed + phase.acceleration * dt, 0.0), self._cruise_speed)
        if phase.acceleration < 0:
            # While the brake force builds up, a target far below the speed would cause a higher deceleration.
            self._target_speed = max(self._target_speed, speed - SPEED_SLACK)
        is_at_cruise_speed = phase.acceleration > 0 and self._target_speed >= self._cruise_speed
        return Demand(self._target_speed, 0.0 if is_at_cruise_speed else phase.acceleration, phase.steering)


class OpenLoopPlan:
    """Plan with constant speed: straight ahead before time 0, then open-loop steering."""

    def __init__(self, manoeuvre: Manoeuvre):
        self.path = Path(straight(100.0, manoeuvre.speed))
        self._manoeuvre = manoeuvre

    def speed_at(self, distance: float) -> float:
        return self._manoeuvre.speed

    def make_demand(self, time: float, distance: float, speed: float) -> Demand:
        return Demand(self._manoeuvre.speed, 0.0, partial(self._manoeuvre.steering, time) if time >= 0 else "path")


Plan = RoadPlan | PhasePlan | OpenLoopPlan


def make_plan(manoeuvre: Manoeuvre) -> Plan:
    """Plan of a manoeuvre, which is a circle with pedal inputs, a road, or open-loop steering."""
    speed, curvature = manoeuvre.speed, manoeuvre.lateral_acceleration / manoeuvre.speed**2
    if manoeuvre.pedals:
        # While braking, the steering wheel is held; braking ends at a speed, not after a time.
        ends = accumulate(seconds for seconds, _ in manoeuvre.pedals)
        phases = [Phase("hold", acceleration, end_speed=float(manoeuvre.speed_at(end))) if acceleration < 0
                  else Phase("path", acceleration, duration=seconds)
                  for (seconds, acceleration), end in zip(manoeuvre.pedals, ends, strict=True)]
        return PhasePlan(1 / abs(curvature), 1 if curvature > 0 else -1, speed, phases)
    if manoeuvre.closed_loop and isinstance(manoeuvre.profile, PiecewiseLinear):
        return RoadPlan([Piece(length * speed, curvature * first, curvature * last, speed)
                         for length, first, last in manoeuvre.profile.parts])
    return OpenLoopPlan(manoeuvre)


def _make_circle(lateral_acceleration: float) -> Plan:
    radius = 11.5
    return RoadPlan([Piece(2 * math.pi * radius, 1 / radius, 1 / radius, math.sqrt(lateral_acceleration * radius))])


_CIRCLE_WITH_STOPS = (
    Phase("path", duration=18.0), Phase("path", acceleration=-1.5, end_speed=0.0), Phase("path", duration=4.0),
    Phase("path", acceleration=1.2, duration=5.0))
_LEFT_U_TURN = turn(8, 180, 4, 5)
# A lap changes the heading by 180 deg, so the road closes after two laps.
_U_TURNS = (*straight(24, 6), *turn(8, -180, 4, 5), *straight(26, 6), *_LEFT_U_TURN, *straight(26, 6), *_LEFT_U_TURN,
            *straight(2, 6))
_ROUNDABOUT = (
    *straight(30, 16), *turn(230, -24, 16, 20), *straight(85, 16), *turn(12, 450, 5, 7), *straight(110, 16))
CATALOGUE_SCENARIOS = {m.name: (partial(make_plan, m), m.description) for m in CATALOGUE}
SCENARIOS: dict[str, tuple[Callable[[], Plan], str]] = {
    "S1": CATALOGUE_SCENARIOS["S1"],
    "S2": (partial(_make_circle, 1.5), "left circle, R = 11.5 m, 1.5 m/s^2"),
    "S3": (partial(_make_circle, 3.77), "left circle, R = 11.5 m, 3.8 m/s^2"),
    "S4": (partial(_make_circle, 6.37), "left circle, R = 11.5 m, 6.4 m/s^2"),
    "S5": (partial(PhasePlan, 10.0, -1, math.sqrt(1.5 * 10.0), _CIRCLE_WITH_STOPS),
           "right circle, R = 10 m, 1.5 m/s^2, brake to standstill, accelerate, repeat"),
    "S6": (partial(RoadPlan, _U_TURNS), "U-turns right, left, left with straights, 4 to 6 m/s"),
    "S7": (partial(RoadPlan, _ROUNDABOUT, acceleration=1.6, braking=2.0),
           "16 m/s, slightly right, brake to 5 m/s, 450 deg roundabout, back to 16 m/s"),
    **CATALOGUE_SCENARIOS,
}


def load_plan(name: str) -> Plan:
    """New plan of a scenario, given by its name or a YAML file (see config/manoeuvres). Raises ConfigurationError."""
    if name in SCENARIOS:
        return SCENARIOS[name][0]()
    if name.endswith((".yaml", ".yml")):
        return _read_plan(FilePath(name))
    raise ConfigurationError(f"--scenario {name}: unknown; choose {', '.join(SCENARIOS)}, or a .yaml file")


def _read_plan(file: FilePath) -> Plan:
    document = read_document(file)
    try:
        pieces = [piece for row in document["road"] for piece in _make_pieces(row)]
        lengths = [piece.length for piece in pieces]
        if not (min(lengths, default=0.0) >= 0.0 and sum(lengths) <= LONGEST_ROAD):
            raise ValueError(f"lengths must not be negative, and their sum must be at most {LONGEST_ROAD:g} m")
        if not all(abs(k) * MIN_RADIUS <= 1.0 for piece in pieces for k in piece[1:3]):
            raise ValueError(f"turns and shifts must have a radius of at least {MIN_RADIUS:g} m")
        limits = [float(document.get(key, default)) for key, default in (("acceleration", 1.2), ("braking", 1.5))]
        if not all(0.01 <= limit <= 20.0 for limit in limits):
            raise ValueError(f"acceleration and braking {limits}: not within 0.01 to 20 m/s^2")
        return RoadPlan(pieces, *limits)
    except (ArithmeticError, AttributeError, KeyError, StopIteration, TypeError, ValueError) as error:
        reason = f"key {error} is missing" if isinstance(error, KeyError) else (
            str(error) or "a row has none of the keys straight, turn and shift")
        raise ConfigurationError(f"{file}: {reason}; rows of road are {{straight: m, speed: m/s}}, {{turn: deg, "
                                 "radius: m, blend: m, speed: m/s} or {shift: m, length: m, speed: m/s}") from None


def _make_pieces(row: dict[str, Any]) -> list[Piece]:
    values = {key: float(value) for key, value in row.items()}
    shape = next(key for key in ("straight", "turn", "shift") if key in values)
    size, speed = values.pop(shape), values.pop("speed")
    if not 0 < speed <= MAX_SPEED:
        raise ValueError(f"speed {speed:g} m/s: must be above 0 and at most {MAX_SPEED:g} m/s")
    if shape == "turn":
        pieces = turn(values.pop("radius"), size, speed, values.pop("blend", 0.0))
    else:
        pieces = straight(size, speed) if shape == "straight" else lane_shift(size, values.pop("length"), speed)
    if values:
        raise ValueError(f"unknown key {next(iter(values))}")
    return pieces
