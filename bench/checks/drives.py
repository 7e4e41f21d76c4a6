"""The drives of the corruption matrix: real drives of the Genesis and drives of the virtual Leaf, in two sets.

The sealed set, with other runs, scenarios and seeds than the development set, is used only once, at the end.
"""

from functools import lru_cache
from pathlib import Path

from st_recordings.paths import config
from st_recordings.runs.csv import read_csv

from .._cars import DATA, SOUND_DRIVES, genesis
from .recording import Recording
from .virtual import drive_name, virtual_drive

REAL = {
    "development": ("cpg_lap_slow", "cpg_lap_fast_controlled", "cpg_low_speed_a", "rfs_turn_b", "rfs_turn_c"),
    "sealed": ("cpg_lap_fast", "cpg_lap_medium", "cpg_low_speed_b", "rfs_turn_a", "cpg_low_speed_f"),
}
VIRTUAL = {
    "development": (("S1", 11), ("S5", 12), ("S6", 13), ("S7", 14), ("step", 15)),
    "sealed": (("lane_change", 81), ("sweep", 82), ("brake_in_turn", 83), (str(config("manoeuvres/slalom.yaml")), 84),
               (str(Path(__file__).with_name("country_road.yaml")), 85)),
}
DURATION = 120.0  # s, of a virtual drive


def list_drives(set_: str) -> tuple[str, ...]:
    """Names of the drives of a set that are available, real ones first."""
    virtual = tuple(drive_name(scenario) for scenario, _ in VIRTUAL[set_])
    return tuple(name for name in REAL[set_] if _file(name).exists()) + virtual


@lru_cache(maxsize=4)
def load(name: str, set_: str) -> Recording:
    for scenario, seed in VIRTUAL[set_]:
        if name == drive_name(scenario):
            return virtual_drive(scenario, seed, DURATION)
    return real_drive(_file(name))


def real_drive(file: Path) -> Recording:
    return Recording(read_csv(file).log, genesis(), True)


def list_real_files() -> list[Path]:
    """Files of all real drives."""
    return sorted(DATA.glob("*/*.csv"))


def _file(name: str) -> Path:
    # For a missing drive, the path of a file that does not exist, which the reader reports.
    files = [file for file in list_real_files() if file.stem == name]
    return files[0] if files else SOUND_DRIVES / f"{name}.csv"
