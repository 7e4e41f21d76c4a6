"""Units of CAN signals and of the columns of tables, and their spellings."""

import math
import re
import unicodedata
from collections.abc import Mapping
from functools import cache

from st_core.tyres import STANDARD_GRAVITY

# Kind of quantity -> unit -> (factor to SI, other spellings). The first unit is the default.
UNITS: Mapping[str, Mapping[str, tuple[float, tuple[str, ...]]]] = {
    "time": {"s": (1.0, ("sec", "secs", "second", "seconds")),
             "ms": (1e-3, ("msec", "millis", "milliseconds")), "0.1 ms": (1e-4, ()),
             "us": (1e-6, ("µs", "usec", "micros", "microseconds")),
             "ns": (1e-9, ("nsec", "nanos", "nanoseconds")), "min": (60.0, ("minute", "minutes")),
             "h": (3600.0, ("hr", "hour", "hours"))},
    "length": {"m": (1.0, ("meter", "meters", "metre", "metres")), "cm": (1e-2, ()), "mm": (1e-3, ()),
               "km": (1e3, ("kilometer", "kilometers", "kilometre", "kilometres")), "ft": (0.3048, ("feet", "foot")),
               "in": (0.0254, ("inch", "inches")), "mi": (1609.344, ("mile", "miles"))},
    "angle": {"rad": (1.0, ("rads", "radian", "radians")), "deg": (math.pi / 180, ("°", "degs", "degree", "degrees")),
              "mrad": (1e-3, ("milliradian",)), "gon": (math.pi / 200, ("gradian", "gradians"))},
    "latitude or longitude": {"deg": (math.pi / 180, ("°", "degs", "degree", "degrees")),
                              "min": (math.pi / 10800, ("arcmin", "minute", "minutes")), "rad": (1.0, ("radian",)),
                              "1e-7 deg": (math.pi / 180e7, ())},
    "speed": {"m/s": (1.0, ("mps", "m per s", "m s-1")), "km/h": (1 / 3.6, ("kph", "kmph")),
              "mph": (0.44704, ("mi/h",)), "kn": (1852 / 3600, ("kt", "kts", "knot", "knots")),
              "ft/s": (0.3048, ("fps",)), "cm/s": (1e-2, ()), "mm/s": (1e-3, ())},
    "angular rate": {"rad/s": (1.0, ("radps", "rad per s", "rad s-1", "1/s")),
                     "deg/s": (math.pi / 180, ("dps", "degps", "deg per s", "deg s-1")),
                     "mrad/s": (1e-3, ())},
    "ratio": {"1": (1.0, ("-", "none", "unitless")), "%": (1e-2, ("percent",))},
    "acceleration": {"m/s^2": (1.0, ("m/s/s", "mps2", "m s-2")),
                     "g": (STANDARD_GRAVITY, ("g0", "gs")), "ft/s^2": (0.3048, ("ft/s2",))},
}

_SPELLINGS = str.maketrans({
    **dict.fromkeys("º˚⁰", "°"), **dict.fromkeys("µμ", "u"), **dict.fromkeys("äÄ", "ae"), **dict.fromkeys("öÖ", "oe"),
    **dict.fromkeys("üÜ", "ue"), "%": "percent", "ψ": "psi", "δ": "delta", "ω": "omega", "\u0307": "dot"})
_CLOCK = re.compile(r"(?i)\b(gps|(utc|gmt)( ?[+-]\d[\d.,:]*)?|local|unix|since|start|boot|epoch|of|day|week|time|in)\b"
                    r"|[ymdt./ -]*h+:?m+:?s+[.:sfx\d]*")  # clocks, and formats such as HH:MM:SS.SS


@cache
def normalise(text: str) -> str:
    """Normal form of a name or unit for comparison: in lower case, without blanks and punctuation."""
    text = unicodedata.normalize("NFKC", unicodedata.normalize("NFC", text).translate(_SPELLINGS)).lower()
    return "".join(c for c in text if c.isalnum() or (
        unicodedata.category(c)[0] in "MS" and not c.isascii() and c not in "⋅−∕⁄"))


_UNITS_BY_SPELLING = {kind: {normalise(text): unit for unit, (_, others) in units.items() for text in (unit, *others)}
                      for kind, units in UNITS.items()}
_BASE_UNITS = {**_UNITS_BY_SPELLING["length"], **_UNITS_BY_SPELLING["angle"], **_UNITS_BY_SPELLING["time"]}


def find_unit(kind: str, text: str) -> str | None:
    """The unit named by a text such as "in degrees per sec"; "" for a clock or time format, None for other texts."""
    text = text.translate(_SPELLINGS).replace("_", " ")
    if kind == "time":
        words = set(re.findall("[a-z]+", text.lower())) - {"start", "time", "in"}
        text = _CLOCK.sub("", text)
        if words and not normalise(text):  # days or weeks alone are a duration, not a clock
            return None if words & {"day", "week"} and "of" not in words else ""
    text = re.sub(r"(?i)^\W*in (?=.)", "", text)
    terms = (re.fullmatch(r"[^\w°]*(.*?)[^\w°]*([2²]|squared)?[^\w°]*", term) for term in re.split(
        r"(?i)[/∕⁄]|\bper\b", text))
    quotient = "/".join(_BASE_UNITS.get(normalise(term[1]), term[1]) + "2" * bool(term[2]) for term in terms if term)
    return _UNITS_BY_SPELLING[kind].get(normalise(text)) or _UNITS_BY_SPELLING[kind].get(normalise(quotient))


def list_kinds(text: str) -> list[str]:
    """The kinds of quantity that have a unit with this spelling; "ratio" also for an empty text."""
    return [kind for kind in UNITS if find_unit(kind, text)]
