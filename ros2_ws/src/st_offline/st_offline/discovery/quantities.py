"""Names and numbers of a discovery in reports: angles in degrees, number of digits according to the interval."""

import math
from collections.abc import Iterable, Mapping

from st_core.channels import LABELS
from st_core.discovery.result import FittedParameter
from st_core.discovery.settings import Limits
from st_core.effects import EFFECTS, Parameter
from st_core.relations import Candidate
from st_core.vehicle import VehicleParameters

MAX_DECIMALS = 6
ON_BOUND = Limits().at_bound  # distance from a bound, in parameter scales
_DISPLAY = {"rad": ("°", 57.29577951308232), "rad/s": ("°/s", 57.29577951308232)}


def factor(unit: str) -> float:
    """From SI to the unit of reports."""
    return _DISPLAY.get(unit, ("", 1.0))[1]


def display_unit(unit: str) -> str:
    """The unit of reports."""
    return _DISPLAY.get(unit, (unit.replace("^2", "²"), 1.0))[0]


def channel(name: str) -> str:
    """Name of a channel in reports."""
    return LABELS.get(name, plain(name))


def plain(name: str) -> str:
    """Name of an effect as separate words."""
    return name.replace("_", " ")


def with_unit(number: str, unit: str) -> str:
    """unit: SI; angles in degrees."""
    text = "" if unit == "1" else display_unit(unit)
    return f"{number}{'' if not text or text.startswith('°') else ' '}{text}"


def size(value: float, unit: str) -> str:
    """A value of a channel with its unit; angles in degrees."""
    return with_unit(f"{value * factor(unit):.3g}", unit)


def metres(value: float) -> str:
    """A length [m]; in millimetres below 0.1 m."""
    if not math.isfinite(value):
        return "unknown"
    return f"{value:.2f} m" if abs(value) >= 0.095 else f"{value:.3f} m"


def decimals(uncertainty: float) -> int:
    """Decimals up to the second significant digit of an uncertainty; 3 if the uncertainty is unknown."""
    is_known = math.isfinite(uncertainty) and uncertainty > 0.0
    return max(1 - math.floor(math.log10(uncertainty) + 1e-6), 0) if is_known else 3


def decimal(number: float, count: int) -> str:
    """A number with `count` decimals; with an exponent if `count` exceeds MAX_DECIMALS."""
    if count <= MAX_DECIMALS:
        text = f"{number:.{count}f}"
        return text if float(text) else f"{number + 0.0:.1g}"  # neither "-0.0" nor "x 0" for a small number
    significant = count + math.floor(math.log10(abs(number) or 10.0**-count)) + 1
    return f"{number:.{max(significant, 1)}g}"


def value(p: FittedParameter, parameter: Parameter | None = None, interval: bool = True) -> str:
    """Value and 95 % interval, in significant digits; with the null 1 as a factor.

    parameter: of the effect; a value on one of its bounds is reported as such. The interval may cross a bound.
    """
    typical_size = abs(parameter.initial - parameter.null) if parameter else 0.0
    bounds = [] if parameter is None or parameter.shape else [
        bound for bound in parameter.bounds if bound not in (parameter.null, parameter.theory)]
    half_width = 0.5 * (p.interval[1] - p.interval[0]) * factor(p.unit)
    number, *ends = (decimal(x * factor(p.unit), decimals(half_width)) for x in (p.value, *p.interval))
    text = f"× {number}" if p.unit == "1" and p.null == 1.0 else with_unit(number, p.unit)
    on_bound = " on its bound" if any(abs(p.value - bound) < ON_BOUND * typical_size for bound in bounds) else ""
    return f"{text}{on_bound}{f' ({ends[0]} to {ends[1]})' if interval else ''}"


def values(effect: str, parameters: Mapping[str, FittedParameter], interval: bool = True) -> list[str]:
    """A text for each parameter of an effect, with the name of the parameter if there are several."""
    known = {p.name: p for p in EFFECTS[effect].parameters} if effect in EFFECTS else {}
    return [f"{plain(name) + ' ' if len(parameters) > 1 else ''}{value(p, known.get(name), interval)}"
            for name, p in parameters.items()]


def short_values(effect: str, parameters: Mapping[str, FittedParameter]) -> str:
    """Values without intervals."""
    return ", ".join(values(effect, parameters, interval=False))


def fitted(name: str, numbers: Mapping[str, float]) -> str:
    """Values of an effect without intervals, in few digits; with the null 1 as a factor."""
    known = {p.name: p for p in EFFECTS[name].parameters} if name in EFFECTS else {}
    texts = []
    for key, number in numbers.items():
        unit, null = (known[key].unit, known[key].null) if key in known else ("1", 0.0)
        count = max(2, 1 - math.floor(math.log10(abs(number - null)))) if number != null else 2
        text = (f"× {number:.{count}f}" if (unit, null) == ("1", 1.0) else
                with_unit(f"{float(f'{number * factor(unit):.2g}'):g}", unit))
        texts.append(f"{plain(key) + ' ' if len(numbers) > 1 else ''}{text}")
    return ", ".join(texts)


def change(deviation: float, unit: str) -> str:
    """A deviation from null: factors in per cent."""
    return f"{float(f'{100 * abs(deviation):.2g}'):g} %" if unit == "1" else size(abs(deviation), unit)


TERMS = {
    "front_steer": "steering of the front wheels", "rear_steer": "steering of the rear wheels",
    "front_force": "lateral force of the front axle", "rear_force": "lateral force of the rear axle",
    "front_grip": "grip of the front axle", "rear_grip": "grip of the rear axle", "both_grip": "grip of both axles",
    "yaw_moment": "yaw moment on the body", "side_force": "side force on the body",
    "sensor_yaw_rate": "error of the yaw rate sensor", "sensor_acceleration_y": "error of the lateral accelerometer",
    "sensor_velocity_y": "error of the lateral velocity of the INS",
    "sensor_heading": "error of the heading of the INS",
}
QUANTITIES = {
    "slip_front": "slip angle of the front axle", "slip_rear": "slip angle of the rear axle",
    "steering": "road-wheel angle", "acceleration_y": "lateral acceleration", "acceleration_x": "forward acceleration",
    "speed": "speed", "yaw_rate": "yaw rate", "steering_rate": "rate of the road-wheel angle",
    "lagging_steering": "road-wheel angle, lagging by 0.2 s",
    "lean": "lateral acceleration, lagging by 0.15 s as the body rolls", "north": "sine of the course",
    "east": "cosine of the course", "position_x": "position to the east", "position_y": "position to the north",
    "run_time": "time in the run",
}
SIGNS = {"acceleration_x": " (derivative of the forward speed, also where a bend slows the car; braking −)",
         "steering": " (left +)", "lagging_steering": " (left +)",
         "acceleration_y": " (left +)", "lean": " (left +)", "yaw_rate": " (left +)",
         "steering_rate": " (to the left +)", "slip_front": " (axle moving to its left +)",
         "slip_rear": " (axle moving to its left +)"}
"""Positive direction of a quantity."""


def axis(c: Candidate) -> str:
    """Label of the vertical axis. Grip is relative to the force, force to the static load."""
    per = {"front_force": " over its static load", "rear_force": " over its static load",
           "yaw_moment": " over the yaw inertia", "side_force": " over the mass"}.get(c.term, "")
    side = (", + reads too large" if c.of_sensor else ", relative, + more force" if c.term.endswith("grip")
            else f"{per}, left +")
    return f"{TERMS[c.term]}{side}{f', for each unit of {QUANTITIES[c.factor]}' if c.factor else ''}"


def in_newtons(c: Candidate, vehicle: VehicleParameters) -> str:
    """Unit of y as a force or moment of that car; "" for other terms."""
    sizes = {"yaw_moment": f"1 rad/s² is a moment of {vehicle.yaw_inertia:.4g} N m, from the yaw inertia",
             "side_force": f"1 m/s² is a force of {vehicle.mass:.4g} N, from the mass",
             "front_force": f"1 is a force of {2.0 * vehicle.static_tyre_load_front:.4g} N, from the axle load",
             "rear_force": f"1 is a force of {2.0 * vehicle.static_tyre_load_rear:.4g} N, from the axle load"}
    return f"y = {sizes[c.term]} of the vehicle file" if c.term in sizes and not c.factor else ""


def title(c: Candidate, constant: bool = False) -> str:
    """Term and quantity of a relation, written out. constant: whether its formula is a constant."""
    per = f", for each {QUANTITIES[c.factor]}" if c.factor else ""
    if constant:
        return f"{TERMS[c.term]}{per}, the same at every {QUANTITIES[c.quantity]}"
    return f"{TERMS[c.term]}{per}, as a function of the {QUANTITIES[c.quantity]}"


def written_out(name: str) -> str:
    """A relation by `Candidate.name`, written out."""
    term, _, rest = name.partition(" over ")
    quantity, _, by = rest.partition(" times ")
    if term not in TERMS or quantity not in QUANTITIES:
        return name
    return f"{TERMS[term]} as a function of the {QUANTITIES[quantity]}" + (f" times {QUANTITIES[by]}" if by else "")


def spell_out(text: str, names: Iterable[str]) -> str:
    """A sentence with the names of relations written out."""
    for name in sorted(names, key=len, reverse=True):  # a name may begin with another
        text = text.replace(name, written_out(name))
    return text
