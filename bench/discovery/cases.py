"""The cases of blocks A to E: hidden effects, cars and drives, determined by set, block and index.

`discover` does not receive the truth, which is stored with the drives for the score. Block F is in `edits`.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from st_core.effects import EFFECTS, find_applicable_effects
from st_sim.settings import Settings

from ..plants import programmes
from ..plants.record import LEAF, PLANTS, HealthyCar, has_setting, healthy_car
from .effects import BY_NAME, KNOWN, OUTSIDE_LIBRARY, PHYSICS, PLACE_DEPENDENT, SENSORS, InjectedChange, is_similar

SEALED = "single track, discovery, sealed set 11"
COUNTS = {"A": 100, "B": 120, "C": 120, "D": 150, "E": 60, "F": 100}
PER_CAR = 10  # cases of block D with the same healthy car and reference drives
SCALES, SCALE_PROBABILITIES = (1.0, 0.5, 0.25), (0.45, 0.35, 0.2)
SITE_DISTANCE = 5000.0  # m, between a site with and a site without a slope

FILE_ERRORS = {
    "steering_ratio": (("steering_ratio_factor",), 0.12), "front_stiffness": (("front_stiffness_factor",), 0.2),
    "rear_stiffness": (("rear_stiffness_factor",), 0.2),
    "both stiffnesses": (("front_stiffness_factor", "rear_stiffness_factor"), 0.2), "mass": (("mass_factor",), 0.15),
    "steering_offset": (("steering_offset",), 0.006), "heading_misalignment": (("ins_misalignment",), 0.01745),
}
"""Block B: quantity that is wrong in the vehicle file -> (settings, largest error: relative, or [rad] for angles)."""
ADDITIVE = ("steering_offset", "ins_misalignment")
STIFFNESS = ("front_stiffness", "rear_stiffness", "both stiffnesses")


@dataclass(frozen=True)
class Case:
    """One task for `discover`."""

    set_: str
    block: str  # A to E
    index: int
    kind: str  # within the block
    car: HealthyCar  # the healthy car
    settings: Settings  # of the driven car
    file: Settings | None  # settings that the vehicle file assumes, None if it is identified
    hidden: tuple[str, ...] = ()  # effects of the library that are present, or wrong in the file
    description: str = "nothing"  # of the hidden effects
    scales: tuple[float, ...] = ()  # sizes of the hidden effects, relative to a large one
    with_vy: bool = True  # whether v_y is measured
    reference: bool = False  # whether there are reference drives
    effects: tuple[str, ...] | None = None  # candidate effects of the discovery, None for all
    shifted: bool = False  # whether roads or speeds differ from the reference
    parts: tuple[programmes.Part, ...] | None = None  # manoeuvres, None for the default
    change_at: float = 0.0  # fraction of each run at which the change begins
    other_site: Settings | None = None  # settings at the second site, where every other run is driven

    @property
    def seed(self) -> int:
        return seed_of(self.set_, self.block, self.index)


def seed_of(set_: str, *labels: object) -> int:
    """A seed: the hash of the set and the `labels`."""
    text = f"{SEALED if set_ == 'sealed' else set_} {' '.join(map(str, labels))}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "big")


def cases_of(set_: str, block: str, count: int | None = None) -> list[Case]:
    """The first `count` cases of a block from A to E; case k does not depend on `count`."""
    make = {"A": _single_effect, "B": _several_errors, "C": _no_error, "D": _with_reference,
            "E": _varying_effect}[block]
    return [make(set_, i) for i in range(COUNTS[block] if count is None else count)]


def _draw(set_: str, block: str, index: int) -> np.random.Generator:
    return np.random.default_rng(seed_of(set_, block, index, "what"))


def _choose_plant(index: int) -> str:
    """The plant: in every third case one of the multi-body cars, in turn."""
    return PLANTS[1 + index // 3 % (len(PLANTS) - 1)] if index % 3 == 2 else LEAF


def _list_changes(plant: str) -> list[InjectedChange]:
    return [h for h in KNOWN if has_setting(plant, h.setting) and h.library in EFFECTS]


def _draw_from_deck(set_: str, block: str, plant: str, number: int) -> InjectedChange:
    """Draws from shuffled decks with one card per effect, so that every effect occurs equally often."""
    cards = _list_changes(plant)
    deck = np.random.default_rng(seed_of(set_, block, plant == LEAF, "deck", number // len(cards)))
    return cards[deck.permutation(len(cards))[number % len(cards)]]


def _apply(settings: Settings, chosen: Iterable[tuple[InjectedChange, float, int]]) -> Settings:
    for hidden, scale, sign in chosen:
        settings = hidden.apply(settings, scale, sign)
    return settings


def _describe(chosen: Iterable[tuple[InjectedChange, float, int]]) -> str:
    return " + ".join(f"{h.setting} x{sign * scale:g}" for h, scale, sign in chosen)


def _single_effect(set_: str, index: int) -> Case:
    """A: one effect, no reference; otherwise the vehicle file is correct."""
    draw, plant = _draw(set_, "A", index), _choose_plant(index)
    number = index // 3 if index % 3 == 2 else index - index // 3
    hidden = _draw_from_deck(set_, "A", plant, number)
    required = hidden.requires or {}
    car = healthy_car(plant, (seed_of(set_, "A", index, "car"),), **(required if plant == LEAF else {}))
    chosen = [(hidden, float(draw.choice(SCALES, p=SCALE_PROBABILITIES)), int(draw.choice(hidden.signs)))]
    return Case(set_, "A", index, "one", car, _apply(car.settings, chosen), car.settings, (hidden.library,),
                _describe(chosen), (chosen[0][1],), with_vy=index % 5 != 4)


def _several_errors(set_: str, index: int) -> Case:
    """B: three to five wrong parameters, up to two sensor errors and two physical effects, no reference."""
    draw, plant = _draw(set_, "B", index), _choose_plant(index)
    car = healthy_car(plant, (seed_of(set_, "B", index, "car"),))
    file, driven, hidden, parts = dict(car.settings), car.settings, [], []
    count, chosen = int(draw.integers(3, 6)), []
    for name in draw.permutation(list(FILE_ERRORS)):
        if len(chosen) < count and not (name in STIFFNESS and set(chosen) & set(STIFFNESS)):
            chosen.append(str(name))
    for name in chosen:
        settings, largest = FILE_ERRORS[name]
        change = float(draw.choice([-1, 1]) * draw.uniform(0.4, 1.0) * largest)
        for setting in settings:
            if name == "heading_misalignment":  # not in a vehicle file
                driven = {**driven, setting: driven[setting] + change}
            else:
                file[setting] = file[setting] + change if setting in ADDITIVE else file[setting] * (1.0 + change)
        hidden += ["front_stiffness", "rear_stiffness"] if name == "both stiffnesses" else [name]
        parts.append(f"{name} of the file {change:+.3g}" if setting != "ins_misalignment" else f"{name} {change:+.3g}")
    for names in (SENSORS, PHYSICS):
        usable = [n for n in names if has_setting(plant, BY_NAME[n].setting) and n not in hidden]
        chosen_effects = [BY_NAME[str(n)] for n in draw.choice(usable, int(draw.integers(0, 3)), replace=False)]
        added = [(h, float(draw.choice([1.0, 0.5])), int(draw.choice(h.signs))) for h in chosen_effects]
        driven = _apply(driven, added)
        hidden += [h.library for h in chosen_effects]
        parts += [_describe([a]) for a in added]
    return Case(set_, "B", index, "several", car, driven, file, tuple(hidden), " + ".join(parts))


def _no_error(set_: str, index: int) -> Case:
    """C: alternately, the car is the base model itself, or its vehicle file is identified on other drives."""
    car = healthy_car(_choose_plant(index), (seed_of(set_, "C", index, "car"),))
    kind = "base" if index % 2 == 0 else "identified"
    return Case(set_, "C", index, kind, car, car.settings, car.settings if kind == "base" else None)


def _with_reference(set_: str, index: int) -> Case:
    """D: the nominal vehicle file and healthy reference drives; three of five cases have one effect, the others
    none."""
    draw = _draw(set_, "D", index)
    group = index // PER_CAR
    with_vy = group % 5 != 4
    # Every third car has the setting that some changes require.
    required = {"combined_slip": 0.0} if group % 3 == 0 else {}
    car = healthy_car(LEAF, (seed_of(set_, "D", "car", group),), **required)
    nominal = healthy_car(LEAF, (0,)).settings | _file_of_leaf()
    if index % 5 < 3:
        hidden = _draw_from_deck(set_, "D", LEAF, index)
        if hidden.requires and not required:
            hidden = _draw_from_deck(set_, "D", LEAF, index + 1)
        if hidden.requires and not required:
            hidden = BY_NAME["steering_ratio"]
        chosen = [(hidden, float(draw.choice(SCALES, p=SCALE_PROBABILITIES)), int(draw.choice(hidden.signs)))]
        return Case(set_, "D", index, "one", car, _apply(car.settings, chosen), nominal, (hidden.library,),
                    _describe(chosen), (chosen[0][1],), with_vy, True)
    shifted = index % 5 == 4
    parts, settings = None, car.settings
    if shifted:
        pool = (programmes.SWEEP, *programmes.EXTRA, programmes.BRAKING, programmes.ORDINARY, programmes.CIRCLE,
                programmes.LIMIT)
        parts = tuple(pool[i] for i in draw.choice(len(pool), 5, replace=False))
        settings = {**settings, "ins_noise": 1.4}
    return Case(set_, "D", index, "healthy", car, settings, nominal, with_vy=with_vy, reference=True, shifted=shifted,
                parts=parts)


def _file_of_leaf() -> Settings:
    """Settings of the virtual Leaf for which the vehicle file of the Leaf is right."""
    return {"mass_factor": 1.0, "yaw_inertia_factor": 1.0, "front_stiffness_factor": 1.0, "rear_stiffness_factor": 1.0,
            "friction_factor": 1.0, "steering_ratio_factor": 1.0, "steering_offset": 0.0, "cg_shift": 0.0,
            "ins_lever_error": 0.0}


def _varying_effect(set_: str, index: int) -> Case:
    """E: in turn, an effect that depends on the place, one that begins in the middle of every run, and one outside the
    library; no reference, a correct vehicle file."""
    draw = _draw(set_, "E", index)
    car = healthy_car(LEAF, (seed_of(set_, "E", index, "car"),))
    kind = ("place", "time", "unknown")[index % 3]
    number = index // 3
    case = Case(set_, "E", index, kind, car, car.settings, car.settings)
    return {"place": _depends_on_place, "time": _begins_midway, "unknown": _outside_library}[kind](case, number, draw)


def _add_effect(case: Case, added: InjectedChange, scale: float, draw: np.random.Generator, **others) -> Case:
    chosen = [(added, scale, int(draw.choice(added.signs)))]
    return replace(case, settings=_apply(case.settings, chosen), description=_describe(chosen), scales=(scale,),
                   **others)


def _depends_on_place(case: Case, number: int, draw: np.random.Generator) -> Case:
    hidden = PLACE_DEPENDENT[number % len(PLACE_DEPENDENT)]
    other = case.settings if hidden.setting == "hillside_slope" else None
    return _add_effect(case, hidden, float(draw.choice([1.0, 0.6])), draw, other_site=other)


def _begins_midway(case: Case, number: int, draw: np.random.Generator) -> Case:
    pool = [h for h in _list_changes(LEAF) if not h.requires and h.setting not in ("mass_factor", "cg_shift",
                                                                               "yaw_inertia_factor")]
    hidden = pool[draw.integers(len(pool))]
    return _add_effect(case, hidden, 1.0, draw, change_at=float(draw.uniform(0.35, 0.55)), hidden=(hidden.library,))


def _outside_library(case: Case, number: int, draw: np.random.Generator) -> Case:
    """Alternately, a change that no effect describes, and an effect that is removed from the library together with
    similar ones."""
    if number % 2 == 0:
        return _add_effect(case, OUTSIDE_LIBRARY[number // 2 % len(OUTSIDE_LIBRARY)], 1.0, draw)
    pool = [h for h in _list_changes(LEAF) if not h.requires]
    hidden = pool[draw.integers(len(pool))]
    names = tuple(n for n in find_applicable_effects("nonlinear") if not is_similar(n, hidden.library))
    return _add_effect(case, hidden, 1.0, draw, effects=names, hidden=(hidden.library,))

