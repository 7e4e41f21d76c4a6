"""Units a recording may be in: how they are written, and what they are in SI."""

import math
import re
from collections.abc import Mapping

# Kind of quantity -> unit -> (factor to SI, other ways to write it). The first is the default.
UNITS: Mapping[str, Mapping[str, tuple[float, tuple[str, ...]]]] = {
    "time": {"s": (1.0, ("sec", "secs", "second", "seconds")),
             "ms": (1e-3, ("msec", "millis", "milliseconds")),
             "us": (1e-6, ("µs", "usec", "micros", "microseconds")),
             "ns": (1e-9, ("nsec", "nanos", "nanoseconds"))},
    "length": {"m": (1.0, ("meter", "meters", "metre", "metres")), "cm": (1e-2, ()), "mm": (1e-3, ()),
               "km": (1e3, ()), "ft": (0.3048, ("feet", "foot"))},
    "angle": {"rad": (1.0, ("rads", "radian", "radians")), "deg": (math.pi / 180, ("°", "degs", "degree", "degrees")),
              "mrad": (1e-3, ())},
    "latitude or longitude": {"deg": (math.pi / 180, ("°", "degs", "degree", "degrees")),
                              "min": (math.pi / 10800, ("arcmin", "minute", "minutes")), "rad": (1.0, ("radian",))},
    "speed": {"m/s": (1.0, ("mps", "m s-1", "m per s", "m per sec", "ms-1")),
              "km/h": (1 / 3.6, ("kph", "kmh", "kmph", "km per h")),
              "mph": (0.44704, ("mi/h",)), "kn": (1852 / 3600, ("kt", "kts", "knot", "knots")),
              "ft/s": (0.3048, ("fps",)), "cm/s": (1e-2, ()), "mm/s": (1e-3, ())},
    "angular rate": {"rad/s": (1.0, ("radps", "rps", "rad per s", "rad per sec", "rad s-1")),
                     "deg/s": (math.pi / 180, ("°/s", "dps", "degps", "deg per s", "deg per sec", "deg s-1")),
                     "mrad/s": (1e-3, ())},
    "acceleration": {"m/s^2": (1.0, ("m/s2", "m/s²", "m/s/s", "mps2", "ms2", "m s-2", "m per s2", "m per s 2")),
                     "g": (9.80665, ("g0", "gs")), "ft/s^2": (0.3048, ("ft/s2",))},
}


def plain(text: str) -> str:
    """As names and units are compared: lower case, letters and digits (and ° and µ) only."""
    return re.sub(r"[^a-z0-9°]", "", text.lower().replace("µ", "u").replace("μ", "u").replace("²", "2"))


_KNOWN = {kind: {plain(text): unit for unit, (_, others) in units.items() for text in (unit, *others)}
          for kind, units in UNITS.items()}


def unit_named(kind: str, text: str) -> str | None:
    """The unit of a kind of quantity that a text means; None where it means none."""
    return _KNOWN[kind].get(plain(text))


def kind_of(unit: str) -> str:
    """The kind of quantity an SI unit is of."""
    return next(kind for kind, units in UNITS.items() if unit in units)


def factor(kind: str, unit: str) -> float:
    """SI value of one of this unit."""
    return UNITS[kind][unit][0]
