"""Flat-plank table of one tyre: loads, slip angles, lateral forces; and whether it can be one."""

import math
from dataclasses import dataclass, replace

import numpy as np

from .result import Coverage, IdentificationError

LARGEST_SLIP = math.radians(40.0)
SMALLEST_SLIP = math.radians(3.0)
LEVEL_GAP = 0.04  # loads closer than this are one level: the carriage does not hold a load to the newton
FEWEST_POINTS = 7  # of the nominal load; five parameters are fitted to them
SLIP_BINS = np.radians([0.0, 0.75, 1.5, 3.0, 5.0, 8.0, 12.0, 20.0])
BINS_NEEDED = 3


@dataclass(frozen=True)
class FlatPlank:
    """load [N], slip [rad], force [N]: (n,) each. tyre: tyre_front or tyre_rear. name: of the data."""

    tyre: str
    load: np.ndarray
    slip: np.ndarray
    force: np.ndarray
    name: str


def load_levels(data: FlatPlank) -> tuple[np.ndarray, np.ndarray]:
    """Mean load of each level, rising (m,) [N], and the level of each row (n,)."""
    if len(data.load) < FEWEST_POINTS or not (np.isfinite(data.load).all() and (data.load > 0.0).all()):
        lowest = float(np.min(data.load)) if len(data.load) else math.nan
        raise IdentificationError(f"{data.tyre}: {len(data.load)} rows with loads from {lowest:.4g} N: "
                                  f"{FEWEST_POINTS} rows with loads above 0 are needed; are load and lateral force "
                                  "exchanged?")
    order = np.argsort(data.load)
    rising = data.load[order]
    steps = np.diff(rising) > LEVEL_GAP * rising[:-1]
    level = np.empty(len(rising), int)
    level[order] = np.concatenate([[0], np.cumsum(steps)])
    return np.array([data.load[level == k].mean() for k in range(level.max() + 1)]), level


def check(data: FlatPlank, levels: np.ndarray, level: np.ndarray, nominal_load: float) -> tuple[FlatPlank, bool]:
    """The table with the force opposing the slip angle, and whether its sign was changed for that.

    Raises IdentificationError, with the numbers, for a table that is none.
    """
    if not (np.isfinite(data.slip).all() and np.isfinite(data.force).all()):
        raise IdentificationError(f"{data.tyre}: every row needs a slip angle and a lateral force")
    if len(levels) > max(3, len(data.load) // 4):
        raise IdentificationError(f"{data.tyre}: {len(levels)} different loads in {len(data.load)} rows; a flat-plank "
                                  "test holds a few loads. Are load and lateral force exchanged?")
    for k, value in enumerate(levels):
        if (level == k).sum() < 3:
            raise IdentificationError(f"{data.tyre}: {(level == k).sum()} rows at {value:.0f} N, at least 3 are "
                                      "needed: add some, or leave them out; or are load and lateral force exchanged?")
    largest = float(np.abs(data.slip).max())
    if largest > LARGEST_SLIP:
        raise IdentificationError(f"{data.tyre}: slip angle reaches {largest:.4g} rad = {math.degrees(largest):.0f} "
                                  "deg, limit 40 deg: if the column holds degrees, name it slip_angle_deg")
    if largest < SMALLEST_SLIP:
        raise IdentificationError(f"{data.tyre}: slip angle reaches {math.degrees(largest):.3g} deg only, at least 3 "
                                  "are needed; if the column holds radians, name it slip_angle_rad")
    ratio = float((np.abs(data.force) / data.load).max())
    if not 0.2 < ratio < 3.0:
        raise IdentificationError(f"{data.tyre}: the lateral force reaches {ratio:.3g} times the load, 0.2 to 3 is a "
                                  "tyre's: are the units in the header right, or two columns exchanged?")
    nominal = int(np.argmin(np.abs(levels - nominal_load)))
    if abs(levels[nominal] - nominal_load) > 0.1 * nominal_load:
        raise IdentificationError(f"{data.tyre}: no load near nominal_load {nominal_load:.0f} N of the vehicle file, "
                                  f"the nearest is {levels[nominal]:.0f} N: test that load, or change nominal_load in "
                                  "the file")
    rows = level == nominal
    distinct = len(np.unique(np.round(np.degrees(data.slip[rows]), 2)))
    if distinct < FEWEST_POINTS:
        raise IdentificationError(f"{data.tyre}: {distinct} different slip angles at {levels[nominal]:.0f} N, at least "
                                  f"{FEWEST_POINTS} are needed")
    coverage = slip_coverage(data, levels, level)[nominal]
    if not coverage.enough:
        raise IdentificationError(f"{data.tyre}: {coverage.words()}")
    trend = float(data.slip @ data.force) / math.sqrt(float(data.slip @ data.slip) * float(data.force @ data.force))
    if abs(trend) < 0.5:
        raise IdentificationError(f"{data.tyre}: lateral force and slip angle are correlated by {trend:+.2f} only: "
                                  "are two columns exchanged, or signs lost?")
    return (replace(data, slip=-data.slip), True) if trend > 0.0 else (data, False)


def slip_coverage(data: FlatPlank, levels: np.ndarray, level: np.ndarray) -> tuple[Coverage, ...]:
    """One entry per load: how the slip angle's magnitude is covered."""
    magnitude = np.abs(data.slip)
    return tuple(Coverage(f"slip angle at {load:.0f} N", "deg", np.degrees(SLIP_BINS),
                          np.histogram(magnitude[level == k], SLIP_BINS)[0], 1, BINS_NEEDED)
                 for k, load in enumerate(levels))
