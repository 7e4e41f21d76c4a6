"""Formats the names and numbers of a discovery for reports: angles in degrees, digits according to the interval."""

import math
from collections.abc import Mapping

from st_core.channels import LABELS
from st_core.discovery.result import FittedParameter
from st_core.discovery.settings import Limits
from st_core.effects import EFFECTS, Parameter
from st_core.relations import Candidate, Relation
from st_core.relations.candidates import split_name
from st_core.vehicle import VehicleParameters

MAX_DECIMALS = 6  # numbers that need more are written in format `g`
BOUND_TOLERANCE = Limits().at_bound  # distance from a bound, divided by the typical size of the parameter
DISPLAY_UNITS = {"rad": (math.degrees(1.0), "°"), "rad/s": (math.degrees(1.0), "°/s")}  # (factor from SI, unit)
TERM_NAMES = {
    "front_steer": "additional steer angle of the front wheels",
    "rear_steer": "additional steer angle of the rear wheels",
    "front_force": "additional lateral force of the front axle",
    "rear_force": "additional lateral force of the rear axle",
    "front_grip": "relative change of the grip of the front axle",
    "rear_grip": "relative change of the grip of the rear axle",
    "both_grip": "relative change of the grip of both axles",
    "yaw_moment": "additional yaw moment on the body", "side_force": "additional side force on the body",
    "sensor_yaw_rate": "error of the yaw rate sensor", "sensor_acceleration_y": "error of the lateral accelerometer",
    "sensor_velocity_y": "error of the lateral velocity of the INS",
    "sensor_heading": "error of the yaw angle of the INS",
}
QUANTITY_NAMES = {
    "slip_front": "slip angle of the front axle", "slip_rear": "slip angle of the rear axle",
    "steering": "road-wheel angle", "acceleration_y": "lateral acceleration", "acceleration_x": "forward acceleration",
    "speed": "speed", "yaw_rate": "yaw rate", "steering_rate": "rate of the road-wheel angle",
    "lagging_steering": "road-wheel angle, lagging by 0.2 s",
    "lean": "lateral acceleration, lagging by 0.15 s like the roll angle", "north": "sine of the yaw angle",
    "east": "cosine of the yaw angle", "position_x": "position to the east", "position_y": "position to the north",
    "run_time": "time in the run",
}
SIGNS = {"acceleration_x": " (derivative of the forward speed, so cornering drag is included; negative in braking)",
         **dict.fromkeys(("acceleration_y", "lean"), " (forward speed times yaw rate; positive to the left)"),
         **dict.fromkeys(("slip_front", "slip_rear"), " (positive if the axle moves to its left)"),
         **dict.fromkeys(("steering", "steering_rate", "lagging_steering", "yaw_rate"), " (positive to the left)")}
"""Positive direction of each signed quantity."""


def get_display_unit(unit: str) -> tuple[float, str]:
    """(factor from an SI unit, display unit)."""
    return DISPLAY_UNITS.get(unit, (1.0, unit.replace("^2", "²")))


def label_channel(name: str) -> str:
    """Name of a channel in reports."""
    return LABELS.get(name, to_words(name))


def to_words(name: str) -> str:
    """Name of an effect or parameter as words, with abbreviations in capitals."""
    return " ".join(word.upper() if word in ("cg", "ins") else word for word in name.split("_"))


def append_unit(number: str, unit: str) -> str:
    """A number followed by the display unit of an SI unit."""
    text = "" if unit == "1" else get_display_unit(unit)[1]
    return f"{number}{'' if not text or text.startswith('°') else ' '}{text}"


def format_value(value: float, unit: str) -> str:
    """A value [SI] as text in its display unit."""
    return append_unit(f"{value * get_display_unit(unit)[0]:.3g}", unit)


def format_metres(value: float, sign: str = "") -> str:
    """A length [m] to the centimetre, below 0.095 m to the millimetre; "unknown" if not finite. sign: "+" to write it
    before positive lengths and 0."""
    if not math.isfinite(value):
        return "unknown"
    return (f"{value:{sign}z.2f} m" if abs(value) >= 0.095 else f"{value:{sign}z.3f} m").replace("-", "−")


def format_decimal(number: float, decimals: int) -> str:
    """Text of a number with the given decimals. With more than MAX_DECIMALS, it is written in format `g` to the same
    precision; if it would be rounded to 0, with one significant digit."""
    if decimals <= MAX_DECIMALS:
        text = f"{number:.{decimals}f}"
        return text if float(text) else f"{number + 0.0:.1g}"  # neither "-0.0" nor "× 0" for a small number
    significant = decimals + math.floor(math.log10(abs(number) or 10.0**-decimals)) + 1
    return f"{number:.{max(significant, 1)}g}"


def format_parameter(p: FittedParameter, parameter: Parameter | None = None, interval: bool = True) -> str:
    """Value and 95 % interval; a parameter with the null value 1 is written as a factor. parameter: definition of
    `p`; with it, a value at a limit of its range is marked. The interval may cross that limit."""
    typical_size = abs(parameter.initial - parameter.null) if parameter else 0.0
    bounds = parameter.hard_bounds if parameter else ()
    factor, _ = get_display_unit(p.unit)
    half_width = 0.5 * (p.interval[1] - p.interval[0]) * factor
    has_width = math.isfinite(half_width) and half_width > 0.0
    decimals = max(1 - math.floor(math.log10(half_width) + 1e-6), 0) if has_width else 3  # second significant digit
    number, *ends = (format_decimal(x * factor, decimals) for x in (p.value, *p.interval))
    text = f"× {number}" if p.unit == "1" and p.null == 1.0 else append_unit(number, p.unit)
    is_at_limit = any(abs(p.value - bound) < BOUND_TOLERANCE * typical_size for bound in bounds)
    text += " at a limit of its range" if is_at_limit else ""
    return f"{text}{f' ({ends[0]} to {ends[1]})' if interval else ''}"


def format_parameters(effect: str, parameters: Mapping[str, FittedParameter], interval: bool = True) -> list[str]:
    """Text for each parameter of an effect, starting with its name if there are several."""
    definitions = {p.name: p for p in EFFECTS[effect].parameters} if effect in EFFECTS else {}
    return [f"{to_words(name) + ' ' if len(parameters) > 1 else ''}"
            f"{format_parameter(p, definitions.get(name), interval)}" for name, p in parameters.items()]


def format_briefly(effect: str, parameters: Mapping[str, FittedParameter]) -> str:
    """Values of an effect without intervals."""
    return ", ".join(format_parameters(effect, parameters, interval=False))


def format_fitted(name: str, numbers: Mapping[str, float]) -> str:
    """Values of an effect without intervals, to two significant digits; factors to two decimals, or more if the
    difference from 1 is below 0.1."""
    definitions = {p.name: p for p in EFFECTS[name].parameters} if name in EFFECTS else {}
    texts = []
    for key, number in numbers.items():
        unit, null = (definitions[key].unit, definitions[key].null) if key in definitions else ("1", 0.0)
        decimals = max(2, 1 - math.floor(math.log10(abs(number - null)))) if number != null else 2
        text = (f"× {number:.{decimals}f}" if (unit, null) == ("1", 1.0) else
                append_unit(f"{float(f'{number * get_display_unit(unit)[0]:.2g}'):g}", unit))
        texts.append(f"{to_words(key) + ' ' if len(numbers) > 1 else ''}{text}")
    return ", ".join(texts)


def format_deviation(deviation: float, unit: str) -> str:
    """Magnitude of a deviation from the null value; in per cent if it is dimensionless."""
    return f"{float(f'{100 * abs(deviation):.2g}'):g} %" if unit == "1" else format_value(abs(deviation), unit)


def make_axis_label(c: Candidate) -> str:
    """Label of the vertical axis of a relation, with its divisor and its positive direction."""
    divisor = {"front_force": " divided by its static load", "rear_force": " divided by its static load",
               "yaw_moment": " divided by the yaw inertia", "side_force": " divided by the mass"}.get(c.term, "")
    sign = (", measured minus true value, positive to the left" if c.is_sensor_error else
            ", positive: more force" if c.term.endswith("grip") else f"{divisor}, positive to the left")
    return f"{TERM_NAMES[c.term]}{sign}{f', per unit of {QUANTITY_NAMES[c.factor]}' if c.factor else ''}"


def explain_unit(c: Candidate, vehicle: VehicleParameters) -> str:
    """Force or moment on this car for one unit of the curve y of a relation; "" if y is neither, or has a factor."""
    loads = {"yaw_moment": ("1 rad/s²", f"moment of {vehicle.yaw_inertia:.4g} N m", "yaw inertia"),
             "side_force": ("1 m/s²", f"force of {vehicle.mass:.4g} N", "mass"),
             "front_force": ("1", f"force of {2.0 * vehicle.static_tyre_load_front:.4g} N", "axle load"),
             "rear_force": ("1", f"force of {2.0 * vehicle.static_tyre_load_rear:.4g} N", "axle load")}
    if c.term not in loads or c.factor:
        return ""
    unit, load, source = loads[c.term]
    return f"y = {unit} corresponds to a {load}, with the {source} of the vehicle file"


def spell_out(name: str) -> str:
    """Description of the relation with this `Candidate.name`; the name itself for an unknown term or quantity."""
    term, quantity, factor = split_name(name)
    if term not in TERM_NAMES or quantity not in QUANTITY_NAMES:
        return name
    text = f"{TERM_NAMES[term]} as a function of the {QUANTITY_NAMES[quantity]}"
    return f"{text}, multiplied by the {QUANTITY_NAMES[factor]}" if factor else text


def get_curve_unit(unit: str) -> tuple[float, str]:
    """(factor from SI, unit) for the axis of a curve."""
    return (100.0, "%") if unit == "1" else get_display_unit(unit)


def describe_relation(relation: Relation) -> str:
    """Description of the relation by its term and quantity."""
    c, is_constant = relation.candidate, bool(relation.formulas) and relation.formulas[0].shape == "constant"
    factor = f", for each unit of {QUANTITY_NAMES[c.factor]}" if c.factor else ""
    dependence = "the same for every" if is_constant else "as a function of the"
    return f"{TERM_NAMES[c.term]}{factor}, {dependence} {QUANTITY_NAMES[c.quantity]}"
