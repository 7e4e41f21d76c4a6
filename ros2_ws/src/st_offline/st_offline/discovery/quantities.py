"""Numbers and names of a discovery as a reader wants them: angles in degrees, as many digits as the interval bears."""

import math
from collections.abc import Mapping

from st_core.channels import WORDS
from st_core.discovery.result import FittedParameter
from st_core.effects import EFFECTS

MOST_DECIMALS = 6
_DISPLAY = {"rad": ("°", 57.29577951308232), "rad/s": ("°/s", 57.29577951308232)}


def factor(unit: str) -> float:
    """From SI to what is shown."""
    return _DISPLAY.get(unit, ("", 1.0))[1]


def shown_unit(unit: str) -> str:
    return _DISPLAY.get(unit, (unit.replace("^2", "²"), 1.0))[0]


def channel(name: str) -> str:
    return WORDS.get(name, plain(name))


def plain(name: str) -> str:
    """An effect's name as words."""
    return name.replace("_", " ")


def with_unit(number: str, unit: str) -> str:
    """unit: SI; angles are shown in degrees."""
    shown = "" if unit == "1" else shown_unit(unit)
    return f"{number}{'' if not shown or shown.startswith('°') else ' '}{shown}"


def size(value: float, unit: str) -> str:
    """A number of a channel as a reader wants it."""
    return with_unit(f"{value * factor(unit):.3g}", unit)


def metres(value: float) -> str:
    if not math.isfinite(value):
        return "unknown"
    return f"{value:.2f} m" if abs(value) >= 0.095 else f"{value:.3f} m"


def digits(p: FittedParameter) -> int:
    """Decimals that the interval bears."""
    half = 0.5 * (p.interval[1] - p.interval[0]) * factor(p.unit)
    return max(1 - math.floor(math.log10(half) + 1e-6), 0) if math.isfinite(half) and half > 0.0 else 3


def decimal(number: float, decimals: int) -> str:
    """A number with these decimals, with an exponent where they are many."""
    if decimals <= MOST_DECIMALS:
        return f"{number:.{decimals}f}"
    significant = decimals + math.floor(math.log10(abs(number) or 10.0**-decimals)) + 1
    return f"{number:.{max(significant, 1)}g}"


def short_value(p: FittedParameter) -> str:
    """The value alone, one digit less than its interval bears. What changes nothing at 1 is a factor."""
    number = decimal(p.value * factor(p.unit), max(digits(p) - 1, 0))
    return f"× {number}" if p.unit == "1" and p.null == 1.0 else with_unit(number, p.unit)


def value(p: FittedParameter) -> str:
    """Value and 95 % interval."""
    number, low, high = (decimal(x * factor(p.unit), digits(p)) for x in (p.value, *p.interval))
    return f"{with_unit(number, p.unit)} ({low} to {high})"


def short_values(parameters: Mapping[str, FittedParameter]) -> str:
    return ", ".join(f"{plain(name) + ' ' if len(parameters) > 1 else ''}{short_value(p)}"
                     for name, p in parameters.items())


def values(name: str, parameters: Mapping[str, FittedParameter]) -> str:
    """Every parameter with its interval and meaning."""
    meanings = {p.name: p.meaning for p in EFFECTS[name].parameters} if name in EFFECTS else {}
    return ", ".join(f"{plain(key)} {value(p)}{', ' + meanings[key] if key in meanings else ''}"
                     for key, p in parameters.items())


def fitted(name: str, numbers: Mapping[str, float]) -> str:
    """Values of an effect without intervals."""
    units = {p.name: p.unit for p in EFFECTS[name].parameters} if name in EFFECTS else {}
    return ", ".join(f"{plain(key)} {size(number, units.get(key, '1'))}" for key, number in numbers.items())


def fitted_shortly(name: str, numbers: Mapping[str, float]) -> str:
    """The same in few digits; what changes nothing at 1 is a factor."""
    known = {p.name: p for p in EFFECTS[name].parameters} if name in EFFECTS else {}
    sentences = []
    for key, number in numbers.items():
        unit, null = (known[key].unit, known[key].null) if key in known else ("1", 0.0)
        shown = f"× {number:.2f}" if (unit, null) == ("1", 1.0) else with_unit(f"{number * factor(unit):.2g}", unit)
        sentences.append(f"{plain(key) + ' ' if len(numbers) > 1 else ''}{shown}")
    return ", ".join(sentences)


def change(size_of: float, unit: str) -> str:
    """A deviation from null: factors in per cent."""
    return f"{100 * abs(size_of):.3g} %" if unit == "1" else size(abs(size_of), unit)
