"""Partitions of the driving by run, site, time, place and condition, to test whether an effect is constant."""

import numpy as np

from .windows import Windows

PLACE_SIZE = 50.0  # m, side of the squares of the map that count as places
SAME_SITE_SHARE = 0.2  # fraction of the places of the smaller run; runs with more places in common share a site
MIN_RUNS = 5  # fewer runs are divided into stretches
TIMES = ("the first third of the runs", "the second third", "the last third")
CONDITIONS = ("slow and gentle", "fast and gentle", "slow and hard", "fast and hard")

# ((n,) part of each window, names of the parts), like a factor in an analysis of variance.
Partition = tuple[np.ndarray, list[str]]


def partitions(windows: Windows) -> dict[str, Partition]:
    """Partitions by name; only those with at least two parts."""
    site, driving = sites(windows), windows.driving
    longest = np.zeros(len(windows.names))
    np.maximum.at(longest, windows.run, windows.seconds)
    third = np.minimum((3.0 * windows.seconds / np.maximum(longest[windows.run], 1e-9)).astype(int), 2)
    parts = {"run": runs(windows), "site": (site, [f"site {k + 1}" for k in range(int(site.max()) + 1)]),
             "time": (third, list(TIMES)), "place": places(driving["x"], driving["y"]),
             "condition": conditions(driving["speed"], driving["lateral_acceleration"])}
    if site.max() + 1 == len(windows.names):
        del parts["site"]  # each run is a site
    return {name: partition for name, partition in parts.items() if len(np.unique(partition[0])) > 1}


def runs(windows: Windows) -> Partition:
    """The runs as parts; with fewer than MIN_RUNS, stretches of equal duration of the runs."""
    numbers = np.unique(windows.run)
    if len(numbers) >= MIN_RUNS:
        return windows.run, list(windows.names)
    pieces = int(np.ceil(6 / len(numbers)))
    part = np.zeros(len(windows), int)
    for run in numbers:
        of_run = windows.run == run
        seconds = windows.seconds[of_run]
        edges = np.linspace(seconds.min(), seconds.max() + 1e-6, pieces + 1)
        part[of_run] = run * pieces + np.searchsorted(edges, seconds, side="right") - 1
    return part, [f"{name}, part {k + 1}" for name in windows.names for k in range(pieces)]


def sites(windows: Windows) -> np.ndarray:
    """(n,) site of each window. Runs with common `places`, directly or through other runs, are at one site. Distance
    does not count, because the maps of different sites may have different origins."""
    number = places(windows.driving["x"], windows.driving["y"])[0]
    visited = [set(number[windows.run == run]) for run in range(len(windows.names))]
    site = list(range(len(visited)))
    for i, a in enumerate(visited):
        for j, b in enumerate(visited[:i]):
            if len(a & b) > SAME_SITE_SHARE * max(min(len(a), len(b)), 1):
                site = [site[j] if s == site[i] else s for s in site]
    return np.unique(np.array(site), return_inverse=True)[1][windows.run]


def places(x: np.ndarray, y: np.ndarray) -> Partition:
    """Places: squares of the map with side PLACE_SIZE."""
    cells = np.stack([np.floor(x / PLACE_SIZE), np.floor(y / PLACE_SIZE)], axis=1)
    unique, number = np.unique(cells, axis=0, return_inverse=True)
    return number.ravel(), [f"east {east:.0f} m, north {north:.0f} m" for east, north in PLACE_SIZE * (unique + 0.5)]


def conditions(speed: np.ndarray, lateral: np.ndarray) -> Partition:
    """Four kinds of driving: slower or faster than the median speed, each with less or more lateral acceleration than
    its median."""
    fast = speed > np.median(speed)
    hard = np.zeros(len(speed), bool)
    for half in (fast, ~fast):
        hard[half] = lateral[half] > np.median(lateral[half]) if half.any() else False
    return fast + 2 * hard, list(CONDITIONS)
