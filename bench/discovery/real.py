"""Half blind: recorded drives of a real car, with a known effect put into one of the recorded channels.

The laps of one track among the Genesis drives (four drives) are cut into pieces of 40 s. A case takes some as
reference and others as suspect; an effect is put into the suspect ones by changing what was recorded, the inverse of
how the library reads it. Ten cases in a row share the reference.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from st_core.discovery import CHANNELS
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_offline.runs.csv import read_drive

from .._mounting import moved, turned
from .cases import PER_CAR, Drives, seed_of
from .effects import Hidden
from .paths import ROOT

GENESIS = ROOT.parent / "shared" / "data" / "hyundai_genesis_oxts"
VEHICLE_FILE = ROOT / "config" / "vehicle" / "hyundai_genesis.yaml"
PIECE = 40.0
"""s."""
SLOWEST, STRAIGHTEST = 5.0, 0.05
"""m/s (mean) and rad/s (root mean square): pieces below these show nothing."""
RUNS, HELD_OUT, REFERENCE = 3, 2, 6
SHARE_HEALTHY = 4
"""Every so many-th case has nothing in it."""


def _offset(log: DriveLog, angle: float) -> DriveLog:
    return _steering(log, log.road_wheel_angle - angle)


def _ratio(log: DriveLog, factor: float) -> DriveLog:
    return _steering(log, log.road_wheel_angle * (1.0 + factor))


def _steering(log: DriveLog, angle: np.ndarray) -> DriveLog:
    return replace(log, road_wheel_angle=angle, steering_wheel_angle=None)


def _delay(log: DriveLog, time: float) -> DriveLog:
    return replace(log, steering_time_ns=log.steering_time_ns - round(time * 1e9))


def _yaw_rate_scale(log: DriveLog, change: float) -> DriveLog:
    return replace(log, yaw_rate=log.yaw_rate * (1.0 + change))


def _yaw_rate_bias(log: DriveLog, bias: float) -> DriveLog:
    return replace(log, yaw_rate=log.yaw_rate + bias)


def _speed_scale(log: DriveLog, change: float) -> DriveLog:
    return replace(log, velocity_x=log.velocity_x * (1.0 + change), velocity_y=log.velocity_y * (1.0 + change))


def _bias(log: DriveLog, bias: float) -> DriveLog:
    return replace(log, acceleration_y=log.acceleration_y + bias)


# name in the library -> (how it is put in, large size)
INJECTED: dict[str, tuple[Callable[[DriveLog, float], DriveLog], float]] = {
    "steering_offset": (_offset, 0.012), "steering_ratio": (_ratio, 0.10), "steering_delay": (_delay, 0.12),
    "yaw_rate_scale": (_yaw_rate_scale, 0.05), "yaw_rate_bias": (_yaw_rate_bias, 0.02),
    "speed_scale": (_speed_scale, 0.05), "lateral_acceleration_bias": (_bias, 0.4),
    "heading_misalignment": (turned, 0.03), "sensor_lever_arm": (moved, 0.6),
}


@dataclass(frozen=True)
class RealCase:
    """Fields as `cases.Case`."""

    set_: str
    index: int
    truth: tuple[str, ...]
    hidden: tuple[tuple[Hidden, float, int], ...]
    kind: str = "real"
    with_vy: bool = True
    effects: tuple[str, ...] | None = None
    shifted: bool = False
    note: str = ""
    channels: tuple[str, ...] = CHANNELS

    @property
    def seed(self) -> int:
        return seed_of(self.set_, self.kind, self.index)


def cases_of(set_: str, count: int) -> list[RealCase]:
    draw = np.random.default_rng(seed_of(set_, "real"))
    names, cases, turn = list(INJECTED), [], 0
    for index in range(count):
        if index % SHARE_HEALTHY == SHARE_HEALTHY - 1:
            cases.append(RealCase(set_, index, (), ()))
            continue
        name = names[turn % len(names)]
        turn += 1
        signs = (1,) if name == "steering_delay" else (1, -1)
        hidden = Hidden(name, name, INJECTED[name][1], signs)
        size = float(draw.choice([1.0, 0.6]))
        cases.append(RealCase(set_, index, (name,), ((hidden, size, int(draw.choice(signs))),)))
    return cases


def drives_of(case: RealCase, folder: Path = GENESIS) -> Drives:
    """Raises FileNotFoundError without the recordings."""
    vehicle = VehicleParameters.from_yaml(VEHICLE_FILE.read_text())
    reference, rest = _shared_out(case.set_, case.index // PER_CAR, folder)
    order = np.random.default_rng(case.seed).permutation(len(rest))
    healthy = [rest[i] for i in order[: RUNS + HELD_OUT]]
    faulty = healthy
    for hidden, scale, sign in case.hidden:
        faulty = [INJECTED[hidden.library][0](log, sign * scale * hidden.full) for log in faulty]
    faulty = [replace(log, name=f"suspect_{i + 1}") for i, log in enumerate(faulty)]
    return Drives(reference, tuple(faulty[:RUNS]), tuple(faulty[RUNS:]), tuple(healthy[RUNS:]), vehicle)


@cache
def _shared_out(set_: str, number: int, folder: Path) -> tuple[tuple[DriveLog, ...], tuple[DriveLog, ...]]:
    """Reference pieces, and all the others."""
    pieces = _pieces(folder)
    order = np.random.default_rng(seed_of(set_, "real", "reference", number)).permutation(len(pieces))
    reference = tuple(replace(pieces[i], name=f"reference_{k + 1}") for k, i in enumerate(order[:REFERENCE]))
    return reference, tuple(pieces[i] for i in order[REFERENCE:])


@cache
def _pieces(folder: Path) -> tuple[DriveLog, ...]:
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: the recorded drives are not there")
    pieces = []
    for file in sorted(folder.glob("cpg_lap_*.csv")):
        log, _ = read_drive(file)
        length = round(PIECE * 1e9)
        for start in range(log.start_ns, log.end_ns - length, length):
            piece = log.slice(start, start + length, f"{file.stem}_{(start - log.start_ns) // 10**9}")
            if np.mean(piece.velocity_x) > SLOWEST and np.sqrt(np.mean(piece.yaw_rate**2)) > STRAIGHTEST:
                pieces.append(piece)
    return tuple(pieces)
