"""Partitions of the drives by run, site, time, place and condition, to test whether an effect is constant."""

import numpy as np
from scipy.sparse.csgraph import connected_components

from .windows import Windows

PLACE_SIZE = 50.0  # m, side of the squares of the map that count as places
SAME_SITE_FRACTION = 0.2  # common fraction of the places of the smaller run above which two runs are at one site
MIN_RUNS, MIN_PARTS = 5, 6  # fewer than MIN_RUNS runs are divided into at least MIN_PARTS parts in total
THIRDS = ("the first third of each run", "the second third of each run", "the last third of each run")
CONDITIONS = ("slow and gentle", "fast and gentle", "slow and hard", "fast and hard")

# ((n,) part of each window, names of the parts)
Partition = tuple[np.ndarray, list[str]]


def make_partitions(windows: Windows) -> dict[str, Partition]:
    """Partitions with at least two parts, by name."""
    site, conditions = find_sites(windows), windows.conditions
    durations = np.zeros(len(windows.names))
    np.maximum.at(durations, windows.run, windows.seconds)
    third = np.minimum((3.0 * windows.seconds / np.maximum(durations[windows.run], 1e-9)).astype(int), 2)
    partitions = {"run": divide_by_run(windows), "site": (site, [f"site {k + 1}" for k in range(int(site.max()) + 1)]),
                  "time": (third, list(THIRDS)), "place": divide_by_place(conditions["x"], conditions["y"]),
                  "condition": divide_by_condition(conditions["speed"], conditions["lateral_acceleration"])}
    if site.max() + 1 == len(windows.names):
        del partitions["site"]  # each run is a site
    return {name: partition for name, partition in partitions.items() if len(np.unique(partition[0])) > 1}


def divide_by_run(windows: Windows) -> Partition:
    """Each run as a part; with fewer than MIN_RUNS runs, each run divided into parts of equal duration."""
    runs = np.unique(windows.run)
    if len(runs) >= MIN_RUNS:
        return windows.run, list(windows.names)
    parts_per_run = int(np.ceil(MIN_PARTS / len(runs)))
    part = np.zeros(len(windows), int)
    for run in runs:
        in_run = windows.run == run
        seconds = windows.seconds[in_run]
        edges = np.linspace(seconds.min(), seconds.max() + 1e-6, parts_per_run + 1)
        part[in_run] = run * parts_per_run + np.searchsorted(edges, seconds, side="right") - 1
    return part, [f"{name}, part {k + 1}" for name in windows.names for k in range(parts_per_run)]


def find_sites(windows: Windows) -> np.ndarray:
    """(n,) site of each window. Runs that share enough places (SAME_SITE_FRACTION), directly or through other runs, are
    at one site. Distances are not used, because the maps of different sites may have different origins."""
    place = divide_by_place(windows.conditions["x"], windows.conditions["y"])[0]
    places = [set(place[windows.run == run]) for run in range(len(windows.names))]
    same_site = [[len(a & b) > SAME_SITE_FRACTION * max(min(len(a), len(b)), 1) for b in places] for a in places]
    return connected_components(np.array(same_site))[1][windows.run]


def divide_by_place(x: np.ndarray, y: np.ndarray) -> Partition:
    """Squares of the map with side PLACE_SIZE as parts. x, y: (n,) [m]."""
    cells = np.stack([np.floor(x / PLACE_SIZE), np.floor(y / PLACE_SIZE)], axis=1)
    squares, place = np.unique(cells, axis=0, return_inverse=True)
    return place.ravel(), [f"east {east:.0f} m, north {north:.0f} m" for east, north in PLACE_SIZE * (squares + 0.5)]


def divide_by_condition(speed: np.ndarray, lateral_acceleration: np.ndarray) -> Partition:
    """Four parts: speed below or above its median, each with lateral acceleration below or above its median there."""
    fast = speed > np.median(speed)
    hard = np.zeros(len(speed), bool)
    for half in (fast, ~fast):
        if half.any():
            hard[half] = lateral_acceleration[half] > np.median(lateral_acceleration[half])
    return fast + 2 * hard, list(CONDITIONS)
