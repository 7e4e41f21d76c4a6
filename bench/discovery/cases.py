"""The cases: what is hidden, in which car, in which drives. Everything follows from set, kind and index.

Ten cases in a row share one healthy car and its reference drives. Truth is never handed to `discover`; it is kept
beside the drives for the score.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
from st_core.discovery import CHANNELS
from st_core.effects import applicable
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_sim.car import Car, read_car
from st_sim.settings import Settings

from . import manoeuvres as m
from .cars import HealthyCar, healthy_car
from .compiled import Stopped, drive
from .effects import BY_NAME, FOREIGN, KNOWN, UNSEEN, Hidden
from .paths import ROOT
from .sensing import log_of

LEAF_FILE = ROOT / "config" / "vehicle" / "leaf.yaml"
NOMINAL: Car = read_car(LEAF_FILE)
LEAF = VehicleParameters.from_yaml(LEAF_FILE.read_text())
SEALED = "single track, discovery, sealed set 10"
PER_CAR = 10
RUNS, HELD_OUT = 3, 2
SCALES, ODDS = (1.0, 0.5, 0.25), (0.45, 0.35, 0.2)
COUNTS = {"single": 240, "healthy": 100, "double": 60, "unknown": 60, "untestable": 30, "partial": 10, "real": 120}
"""Cases of the sealed set; kind real is in `real`."""
SLID_AWAY = 6.0
"""m/s of sideways speed: the car has spun and the drive is not used."""


@dataclass(frozen=True)
class Case:
    """truth: names in the library of what is hidden, or what a discovery should call untestable. hidden: (switch,
    scale, sign). effects: names that take part, None for all. shifted: driven otherwise than the reference. parts: of
    the manoeuvres, None for the usual ones. from_: share of each run after which the effect is there.
    """

    set_: str
    kind: str
    index: int
    truth: tuple[str, ...]
    hidden: tuple[tuple[Hidden, float, int], ...] = ()
    with_vy: bool = True
    effects: tuple[str, ...] | None = None
    shifted: bool = False
    parts: tuple[m.Part, ...] | None = None
    from_: float = 0.0
    car: HealthyCar | None = None
    note: str = ""

    @property
    def channels(self) -> tuple[str, ...]:
        return CHANNELS if self.with_vy else tuple(c for c in CHANNELS if c != "velocity_y")

    @property
    def seed(self) -> int:
        return seed_of(self.set_, self.kind, self.index)


@dataclass(frozen=True)
class Drives:
    """reference, suspect: what `discover` gets. held_out: more drives of the suspect car; twin: the same programmes
    driven by the healthy car."""

    reference: tuple[DriveLog, ...]
    suspect: tuple[DriveLog, ...]
    held_out: tuple[DriveLog, ...]
    twin: tuple[DriveLog, ...]
    vehicle: VehicleParameters = LEAF
    faulty: Settings = field(default_factory=dict)


def seed_of(set_: str, *what: object) -> int:
    """The development set may be looked at; the sealed seeds are hashes."""
    text = f"{SEALED if set_ == 'sealed' else set_} {' '.join(map(str, what))}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "big")


def cases_of(set_: str, kind: str, count: int) -> list[Case]:
    """The first `count` cases of a kind."""
    made = {"single": _singles, "healthy": _healthy, "double": _doubles, "unknown": _unknown,
            "untestable": _untestable, "partial": _partial}[kind](set_)
    return made[:count]


def _singles(set_: str) -> list[Case]:
    """Every effect of the table ten times; each third car without v_y."""
    draw = np.random.default_rng(seed_of(set_, "single"))
    plan = [KNOWN[i] for i in draw.permutation(np.repeat(np.arange(len(KNOWN)), COUNTS["single"] // len(KNOWN)))]
    _gather(plan, draw)
    cases = []
    for index, hidden in enumerate(plan):
        special = (index // PER_CAR) % 3 == 0
        sign, scale = _sign(draw, hidden), float(draw.choice(SCALES, p=ODDS))
        cases.append(Case(set_, "single", index, (hidden.library,), ((hidden, scale, sign),),
                          index // PER_CAR % 3 != 2,
                          car=_car(set_, "single", index, {"combined_slip": 0.0} if special else {})))
    return cases


def _gather(plan: list[Hidden], draw: np.random.Generator) -> None:
    """Effects that need room in the healthy car go to every third car, which gives it."""
    def special(i: int) -> bool:
        return (i // PER_CAR) % 3 == 0
    free = [i for i, h in enumerate(plan) if special(i) and not h.with_]
    for i, hidden in enumerate(plan):
        if hidden.with_ and not special(i):
            j = free.pop(draw.integers(len(free)))
            plan[i], plan[j] = plan[j], hidden


def _sign(draw: np.random.Generator, hidden: Hidden) -> int:
    return int(draw.choice(hidden.signs))


def _car(set_: str, kind: str, index: int, others: dict[str, float] | None = None) -> HealthyCar:
    return healthy_car((seed_of(set_, kind, "car", index // PER_CAR),), **(others or {}))


def _healthy(set_: str) -> list[Case]:
    """In turn under the conditions of the reference and under others; every fifth car without v_y."""
    draw = np.random.default_rng(seed_of(set_, "healthy"))
    cases = []
    for index in range(COUNTS["healthy"]):
        shifted = index % 2 == 1
        parts = None
        if shifted:
            pool = (m.SWEEP, m.STEPS, m.SLALOM, m.WEAVE, m.BRAKING, m.ORDINARY, m.CIRCLE, m.LIMIT)
            parts = tuple(pool[i] for i in draw.choice(len(pool), 5, replace=False))
        cases.append(Case(set_, "healthy", index, (), with_vy=index // PER_CAR % 5 != 2, shifted=shifted, parts=parts,
                          car=_car(set_, "healthy", index)))
    return cases


def _doubles(set_: str) -> list[Case]:
    draw = np.random.default_rng(seed_of(set_, "double"))
    pairs = [(a, b) for a, b in combinations(KNOWN, 2) if a.group != b.group and not (a.with_ or b.with_)]
    cases = []
    for index in range(COUNTS["double"]):
        pair = pairs[draw.integers(len(pairs))]
        hidden = tuple((h, float(draw.choice([1.0, 0.5])), _sign(draw, h)) for h in pair)
        cases.append(Case(set_, "double", index, tuple(h.library for h in pair), hidden,
                          car=_car(set_, "double", index)))
    return cases


def _unknown(set_: str) -> list[Case]:
    """In turn a switch no effect equals, and an effect of the library that is left out."""
    draw = np.random.default_rng(seed_of(set_, "unknown"))
    left_out = [h for h in KNOWN if not h.with_]
    everything = applicable("nonlinear")
    cases = []
    for index in range(COUNTS["unknown"]):
        if index % 2 == 0:
            hidden, names, note = FOREIGN[(index // 2) % len(FOREIGN)], None, "foreign"
        else:
            # The same one for a car: what the library holds decides what the reference teaches.
            absent = np.random.default_rng(seed_of(set_, "unknown", "left out", index // PER_CAR))
            hidden, note = left_out[absent.integers(len(left_out))], "left out"
            names = tuple(n for n in everything if n != hidden.library)
        truth = (hidden.library or hidden.setting,)
        scale = float(draw.choice([1.0, 0.6]))
        cases.append(Case(set_, "unknown", index, truth, ((hidden, scale, _sign(draw, hidden)),), effects=names,
                          car=_car(set_, "unknown", index), note=note))
    return cases


def _untestable(set_: str) -> list[Case]:
    """Longitudinal changes; and effects in drives that do not show them."""
    draw = np.random.default_rng(seed_of(set_, "untestable"))
    gentle = (m.Part(m.ordinary, (7.0, 12.0), (0.7, 1.0)),) * 4
    no_pedals = (m.SWEEP, m.Part(m.slalom, (12.0, 13.0), (2.5, 3.5)), m.WEAVE,
                 m.Part(m.steps, (12.0, 13.0), (2.5, 3.5)))
    steady = (m.SLOW_CIRCLE,) * 2
    hard = [("friction", gentle), ("lateral_load_transfer", gentle), ("longitudinal_load_transfer", no_pedals),
            ("friction", steady), ("combined_slip", no_pedals)]
    cases = []
    for index in range(COUNTS["untestable"]):
        if index % 2 == 0:
            setting = tuple(UNSEEN)[index // 2 % len(UNSEEN)]
            name, change = UNSEEN[setting]
            hidden, parts = Hidden(setting, name, change, UP_OR_BOTH[setting]), None
        else:
            name, parts = hard[index // 2 % len(hard)]
            hidden = BY_NAME[name]
        # Ten cases share a car, so all of these have room for combined slip.
        cases.append(Case(set_, "untestable", index, (name,), ((hidden, 0.6, _sign(draw, hidden)),), parts=parts,
                          car=_car(set_, "untestable", index, {"combined_slip": 0.0})))
    return cases


UP_OR_BOTH = {"drag_area": (1,), "rolling_resistance": (1,), "grade_angle": (1, -1)}


def _partial(set_: str) -> list[Case]:
    """Large effects that begin in the middle of every run."""
    draw = np.random.default_rng(seed_of(set_, "partial"))
    pool = [h for h in KNOWN if not h.with_ and h.setting not in ("mass_factor", "cg_shift", "yaw_inertia_factor")]
    cases = []
    for index in range(COUNTS["partial"]):
        hidden = pool[draw.integers(len(pool))]
        cases.append(Case(set_, "partial", index, (hidden.library,), ((hidden, 1.0, _sign(draw, hidden)),),
                          from_=float(draw.uniform(0.35, 0.55)), car=_car(set_, "partial", index)))
    return cases


def drives_of(case: Case) -> Drives:
    """All drives of a case; reference and twin are kept for the next cases of the same car."""
    faulty = dict(case.car.settings)
    for hidden, scale, sign in case.hidden:
        faulty = hidden.applied(faulty, scale, sign)
    draw = np.random.default_rng([case.seed, 9])
    if case.shifted:
        faulty["ins_noise"] *= 1.4
    suspect = tuple(_run(f"suspect_{i + 1}", case, faulty, (case.seed, i), _factors(draw, case.shifted))
                    for i in range(RUNS))
    if not case.with_vy:
        suspect = tuple(without_vy(log) for log in suspect)
    car = case.car
    held_out = _held_out(car.number, tuple(sorted(faulty.items())))
    twin = _held_out(car.number, tuple(sorted(car.settings.items())))
    return Drives(_reference(car.number, tuple(sorted(car.settings.items())), case.with_vy), suspect, held_out, twin,
                  faulty=faulty)


def _factors(draw: np.random.Generator, shifted: bool) -> tuple[float, float]:
    if not shifted:
        return 1.0, 1.0
    return float(draw.choice([draw.uniform(0.8, 0.9), draw.uniform(1.1, 1.2)])), float(draw.uniform(0.7, 1.1))


def _run(name: str, case: Case, faulty: Settings, seed: tuple[int, ...], factors: tuple[float, float]) -> DriveLog:
    healthy = case.car.settings if case.from_ else None
    return driven(name, faulty, seed, case.parts, factors, healthy, case.from_)


def driven(name: str, settings: Settings, seed: tuple[int, ...], parts: tuple[m.Part, ...] | None = None,
           factors: tuple[float, float] = (1.0, 1.0), before: Settings | None = None, from_: float = 0.0) -> DriveLog:
    """One run; where the car spins or stops, the next attempt. before: settings until the share `from_` of it."""
    for attempt in range(20):
        tried = (*seed, attempt)
        programme = m.mixed(NOMINAL, tried, parts, *factors)
        noise = int(np.random.default_rng(tried).integers(2**31))
        first, later = (settings, None) if before is None else (
            before, (settings, round(from_ * len(programme.hand))))
        try:
            recording = drive(NOMINAL, first, programme, noise, later)
        except Stopped:
            continue
        if np.abs(recording.rows[:, 5]).max() < SLID_AWAY:
            return log_of(name, recording, NOMINAL, LEAF, first, noise, later)
    raise Stopped(f"{name}: twenty attempts spun or stopped")


def without_vy(log: DriveLog) -> DriveLog:
    """A set of sensors that does not give v_y: nothing can use it by accident."""
    return replace(log, velocity_y=np.zeros_like(log.velocity_y))


@lru_cache(maxsize=4)
def _reference(number: tuple[int, ...], settings: tuple, with_vy: bool) -> tuple[DriveLog, ...]:
    logs = tuple(driven(f"reference_{i + 1}", dict(settings), (*number, 100 + i)) for i in range(RUNS))
    return logs if with_vy else tuple(without_vy(log) for log in logs)


@lru_cache(maxsize=4)
def _held_out(number: tuple[int, ...], settings: tuple) -> tuple[DriveLog, ...]:
    speeds = (1.0, 0.9)
    return tuple(driven(f"held_out_{i + 1}", dict(settings), (*number, 200 + i), factors=(speeds[i], 1.0))
                 for i in range(HELD_OUT))


def named(cases: Sequence[Case]) -> list[str]:
    """Of what is hidden, for a person to read."""
    return [" + ".join(f"{h.setting} x{sign * scale:g}" for h, scale, sign in c.hidden) or "nothing" for c in cases]
