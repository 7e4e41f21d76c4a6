"""The unit's numbers for its GNSS modes, and what they are for sensor_msgs/NavSatStatus. Source: ncom.md section 8."""

_POST = ("Doppler", "SPS", "differential", "float", "integer")
MODES = dict(enumerate((
    "none", "search", "Doppler", "SPS", "differential", "RTK float", "RTK integer", "SBAS", "OmniSTAR VBS",
    "OmniSTAR HP", "no data", "blanked", *(f"post-processed {name}" for name in _POST), "OmniSTAR XP", "CDGPS",
    "not recognised", *(f"gx {name}" for name in _POST), *(f"ix {name}" for name in _POST), "PPP converging", "PPP",
    "unknown")))

NO_FIX, FIX, SBAS_FIX, GBAS_FIX = -1, 0, 1, 2
_STATUS = {
    **dict.fromkeys((3, 13, 21, 26), FIX),
    **dict.fromkeys((7, 8, 9, 17, 18, 30, 31), SBAS_FIX),
    **dict.fromkeys((4, 5, 6, 14, 15, 16, 22, 23, 24, 27, 28, 29), GBAS_FIX),
}


def mode_text(mode: int | None) -> str:
    """Name of a position, velocity or orientation mode; empty when not sent, "unknown (n)" for a number without a
    name."""
    return "" if mode is None else MODES.get(mode, f"unknown ({mode})")


_QUALITY = {mode: rank for rank, mode in enumerate((0, 1, 2, 3, 7, 4, 5, 6))}


def quality(mode: int | None) -> int:
    """Rank of a live GNSS mode, none 0 to RTK integer 7; -1 for others, which are not compared."""
    return -1 if mode is None else _QUALITY.get(mode, -1)


def fix_status(mode: int | None) -> int:
    """NavSatStatus.status of a position mode. Unknown numbers and a mode not sent yet are no fix."""
    return NO_FIX if mode is None else _STATUS.get(mode, NO_FIX)
