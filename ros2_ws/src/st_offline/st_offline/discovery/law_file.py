"""A proposed law as an effect file a person can read, run and delete."""

from collections.abc import Sequence

import numpy as np
from st_core.proposals import Candidate, Proposal
from st_core.proposals.places import MEMORY, QUANTITIES, WHERE

from . import law_words

KNOTS = 21  # straight lines between; the curve has eight numbers, so that nothing is lost
SLOT = {"front_steer": "front axle", "rear_steer": "rear axle", "front_force": "front axle", "rear_force": "rear axle",
        "front_grip": "front axle", "rear_grip": "rear axle", "both_grip": "both axles", "yaw_moment": "body",
        "side_force": "body",
        "sensor_yaw_rate": "yaw rate", "sensor_acceleration_y": "acceleration", "sensor_velocity_y": "velocity",
        "sensor_heading": "heading"}
OF_MOTION = {"steering": "at.road_wheel_angle", "acceleration_y": "at.velocity_x * at.yaw_rate",
             "acceleration_x": "at.velocity_x_dot", "speed": "at.velocity_x", "yaw_rate": "at.yaw_rate",
             "slip_front": "slip_front", "slip_rear": "slip_rear", "north": "sin(at.yaw)", "east": "cos(at.yaw)",
             "position_x": "at.x", "position_y": "at.y"}
OF_READINGS = {"acceleration_y": "measured.velocity_x * measured.yaw_rate", "speed": "measured.velocity_x",
               "yaw_rate": "measured.yaw_rate"}
FIELD = {"sensor_yaw_rate": "yaw_rate", "sensor_acceleration_y": "acceleration_y", "sensor_velocity_y": "velocity_y",
         "sensor_heading": "yaw"}
MAPPED = ("north", "east", "position_x", "position_y")  # fixed to the map, not to the car
OPS = {"east": "absolute, cos, maximum, minimum", "north": "absolute, maximum, minimum, sin"}
SLIPS = "slip_angles(slip_front, slip_rear, extra, at, given, theta)"
FORCES = "axle_forces(forces, slip_front, slip_rear, at, given, theta)"
AS_BEFORE = "front, rear = forces(slip_front, slip_rear, at)\n        "
HOOKS = {
    # A wheel turned to the left slides less to the left.
    "front_steer": (SLIPS, "return slip_front - {y}, slip_rear"),
    "rear_steer": (SLIPS, "return slip_front, slip_rear - {y}"),
    "front_force": (FORCES, f"{AS_BEFORE}return front + theta.car * {{y}}, rear"),
    "rear_force": (FORCES, f"{AS_BEFORE}return front, rear + theta.car * {{y}}"),
    "front_grip": (FORCES, f"{AS_BEFORE}return front * (1.0 + {{y}}), rear"),
    "rear_grip": (FORCES, f"{AS_BEFORE}return front, rear * (1.0 + {{y}})"),
    "both_grip": (FORCES, f"{AS_BEFORE}y = 1.0 + {{y}}\n        return front * y, rear * y"),
    "yaw_moment": ("acceleration(at, given, theta)", "y = {y}\n        return 0.0 * y, 0.0 * y, y"),
    "side_force": ("acceleration(at, given, theta)", "y = {y}\n        return 0.0 * y, y, 0.0 * y"),
}
LOAD = {"front_force": "cg_to_rear_axle", "rear_force": "cg_to_front_axle"}
FILE = '''"""PROPOSAL, not knowledge: {title}.

Fitted by st discover --propose to {count} drives, {created}: {runs}.
Over {low:.3g} to {high:.3g} {quantity_unit} of {quantity}; constant beyond. {meaning}
Held-out position error after 5 s: {before:.2f} -> {after:.2f} m; by chance with probability {chance:.2g}.
{readings}
Keep it, rename it, or delete it.
"""

from st_core.effects import DYNAMIC, Effect, Parameter, register
from st_core.ops import {ops}

LOW, STEP, HIGH = {low!r}, {step!r}, {high!r}  # {quantity_unit}


def hat(t):
    """1 at 0, 0 from +-1 on, straight between."""
    return maximum(1.0 - absolute(t), 0.0 * t)


def law(u):
    """[{unit}] at u [{quantity_unit}]: straight lines between the heights fitted."""
    t = (minimum(maximum(u, LOW + 0.0 * u), HIGH + 0.0 * u) - LOW) / STEP
    return ({heights})


@register
class {cls}(Effect):
    name = "{name}"
    physics = "{physics}"
    excited_by = "{quantity} from {low:.3g} to {high:.3g} {quantity_unit}"
    kind, slot = "{kind}", "{slot}"
    applies_to = DYNAMIC
    order = 90{memory}
    parameters = (
        Parameter("share", "1", null=0.0, initial=1.0, bounds=(-3.0, 3.0), meaning="of the curve as it was fitted",
                  source="st discover --propose"{odd}),
    )
{body}
'''


def name_of(one: Proposal) -> str:
    """Of the effect; numbered where the model has a law at that place already."""
    name = f"proposed_{one.candidate.place}"
    before = sum(e.name == name or e.name.startswith(f"{name}_") for e in one.model.effects)
    return f"{name}_{before + 1}" if before else name


def law_in_words(one: Proposal) -> str:
    return law_words.law(one.candidate, bool(one.readings) and one.readings[0].shape == "constant")


def title(one: Proposal) -> str:
    causes = f" (in textbooks: {one.readings[0].causes})" if one.readings and one.readings[0].causes else ""
    return f"{law_in_words(one)}{causes}"


def effect_file(one: Proposal, runs: Sequence[str], created: str) -> str:
    """The text of an effect file. Its law is the fitted curve to the width of a line."""
    c = one.candidate
    meaning = WHERE[c.place][1] + (f", for each {QUANTITIES[c.by]} of {c.by.replace('_', ' ')}" if c.by else "")
    knots = np.linspace(c.low, c.high, KNOTS)
    heights = one.coefficients @ c.splines(knots)
    terms = "\n            + ".join(f"{h:.6g} * hat(t - {k}.0)" for k, h in enumerate(heights))
    read = "\n".join(f"Reading {k}: {r.text} ({r.shape}, explains {r.explained:.0%} of the curve)"
                     for k, r in enumerate(one.readings, 1)) or "No simple formula fits it."
    return FILE.format(
        title=title(one), count=len(runs), runs=", ".join(runs), created=created, low=c.low, high=c.high,
        step=(c.high - c.low) / (KNOTS - 1), quantity=c.quantity.replace("_", " "),
        quantity_unit=QUANTITIES[c.quantity],
        unit=c.unit, meaning=f"y [{c.unit}]: {meaning}.", before=one.position_5s[0], after=one.position_5s[1],
        chance=one.chance, readings=read, heights=terms, cls="".join(w.title() for w in name_of(one).split("_")),
        odd=", odd=True" if c.changes_sides else "", name=name_of(one),
        ops=OPS.get(c.quantity, "absolute, maximum, minimum"), memory=_memory(c),
        physics=f"y = curve of {c.quantity}: {meaning}", body=_body(one),
        kind=_kind(c), slot=SLOT[c.place])


def _body(one: Proposal) -> str:
    c = one.candidate
    if c.place in FIELD:
        field, u = FIELD[c.place], OF_READINGS[c.quantity]
        return "".join(f"\n    @staticmethod\n    def {hook}(measured, theta):\n        y = theta.share * law({u})\n"
                       f"        return measured._replace({field}=measured.{field} {sign} y)\n"
                       for hook, sign in (("observe", "+"), ("correct", "-"))).rstrip("\n")
    hook, text = HOOKS[c.place]
    before = ""
    if c.place in LOAD:
        before = ("\n    @staticmethod\n    def constants(vehicle):  # static load of the axle [N]\n"
                  f"        return 9.81 * vehicle.mass * vehicle.{LOAD[c.place]} / vehicle.wheelbase\n")
    y = f"theta.share * law({_quantity(c.quantity)})" + (f" * {_quantity(c.by)}" if c.by else "")
    return f"{before}\n    @staticmethod\n    def {hook}:\n        {text.format(y=y)}{_lagging(c)}"


def _remembered(c: Candidate) -> str:
    """The quantity with memory among those of a law; "" for none."""
    return next((q for q in (c.quantity, c.by) if q in MEMORY), "")


def _quantity(name: str) -> str:
    """Its formula in a hook of the slip angles, or of the motion."""
    if name not in MEMORY:
        return OF_MOTION[name]
    source, kind, tau = MEMORY[name]
    return "extra[0]" if kind == "lagging" else f"({OF_MOTION[source]} - extra[0]) / {tau!r}"


def _memory(c: Candidate) -> str:
    if not _remembered(c):
        return ""
    unit = QUANTITIES[MEMORY[_remembered(c)][0]]
    return f'\n    extra_states = ("lagging",)\n    extra_units = ("{unit}",)'


def _lagging(c: Candidate) -> str:
    """The hooks of a law with memory."""
    if not _remembered(c):
        return ""
    source, _, tau = MEMORY[_remembered(c)]
    now = OF_MOTION[source]
    return (f"\n\n    @staticmethod\n    def start(slips, at, given, theta):\n        return ({now},)\n\n"
            "    @staticmethod\n    def rates(extra, slips, forces, at, given, theta):\n"
            f"        return (({now} - extra[0]) / {tau!r},)")


def _kind(c: Candidate) -> str:
    if c.quantity in MAPPED:
        return "surroundings"
    return "sensors" if c.of_sensor else "physics"
