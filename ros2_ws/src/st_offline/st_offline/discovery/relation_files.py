"""Writes a proposed relation as an effect file with a model file that uses it, and as an entry of discovery.json."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from st_core.discovery.next_manoeuvre import REPETITIONS
from st_core.effects import Effect, find_source_file, load_file, unload_folder
from st_core.model_file import EffectValue, ModelFile, ModelProvenance
from st_core.relations import Candidate, Relation, RelationSearch
from st_core.relations.candidates import ALL_TERMS, FILTERED, QUANTITIES, SENSOR_READINGS
from st_core.vehicle import VehicleParameters

from . import quantities

EFFECTS_FOLDER = Path(find_source_file(Effect)).parent
KNOTS = 21  # of the linear interpolation that approximates the fitted spline
SLOTS = {"front_steer": "front axle", "rear_steer": "rear axle", "front_force": "front axle", "rear_force": "rear axle",
        "front_grip": "front axle", "rear_grip": "rear axle", "both_grip": "both axles", "yaw_moment": "body",
        "side_force": "body", "sensor_yaw_rate": "yaw rate", "sensor_acceleration_y": "acceleration",
        "sensor_velocity_y": "velocity", "sensor_heading": "heading"}
STATE_EXPRESSIONS = {
    "steering": "instant.road_wheel_angle", "acceleration_y": "instant.velocity_x * instant.yaw_rate",
    "acceleration_x": "instant.velocity_x_dot", "speed": "instant.velocity_x", "yaw_rate": "instant.yaw_rate",
    "slip_front": "slip_front", "slip_rear": "slip_rear", "north": "sin(instant.yaw)", "east": "cos(instant.yaw)",
    "position_x": "instant.x", "position_y": "instant.y"}
READING_EXPRESSIONS = {"acceleration_y": "measured.velocity_x * measured.yaw_rate", "speed": "measured.velocity_x",
                       "yaw_rate": "measured.yaw_rate"}
MAP_QUANTITIES = ("north", "east", "position_x", "position_y")  # relative to the map, not the car
IMPORTED_OPS = {"east": "absolute, cos, maximum, minimum", "north": "absolute, maximum, minimum, sin"}
SLIP_HOOK = "slip_angles(slip_front, slip_rear, extra, instant, prepared, theta)"
FORCE_HOOK = "axle_forces(forces, slip_front, slip_rear, instant, prepared, theta)"
COMPUTE_FORCES = "front, rear = forces(slip_front, slip_rear, instant)\n        "
HOOKS = {  # (signature, body) of the effect's method, by term
    # Steering a wheel to the left reduces its slip angle, which is positive if the wheel moves to its left.
    "front_steer": (SLIP_HOOK, "return slip_front - {y}, slip_rear"),
    "rear_steer": (SLIP_HOOK, "return slip_front, slip_rear - {y}"),
    "front_force": (FORCE_HOOK, f"{COMPUTE_FORCES}return front + theta.constants * {{y}}, rear"),
    "rear_force": (FORCE_HOOK, f"{COMPUTE_FORCES}return front, rear + theta.constants * {{y}}"),
    "front_grip": (FORCE_HOOK, f"{COMPUTE_FORCES}return front * (1.0 + {{y}}), rear"),
    "rear_grip": (FORCE_HOOK, f"{COMPUTE_FORCES}return front, rear * (1.0 + {{y}})"),
    "both_grip": (FORCE_HOOK, f"{COMPUTE_FORCES}y = 1.0 + {{y}}\n        return front * y, rear * y"),
    "yaw_moment": ("acceleration(instant, prepared, theta)", "y = {y}\n        return 0.0 * y, 0.0 * y, y"),
    "side_force": ("acceleration(instant, prepared, theta)", "y = {y}\n        return 0.0 * y, y, 0.0 * y"),
}
OPPOSITE_AXLES = {"front_force": "cg_to_rear_axle", "rear_force": "cg_to_front_axle"}  # its CG distance sets the load
EFFECT_FILE = '''"""PROPOSAL, not an established effect: {title}.

Fitted by st discover to {count} drives, {created}: {runs}.
For {quantity} from {range}; constant beyond. {meaning}
Held-out position error after 5 s: {before:.2f} -> {after:.2f} m; p = {p_value:.2g} over all candidates.
{formulas}
Keep it, rename it, or delete it.
"""

from st_core.effects import DYNAMIC, Effect, Parameter, register
from st_core.ops import {ops}

LOW, STEP, HIGH = {low!r}, {step!r}, {high!r}  # {quantity_unit}


def hat(t):
    """1 at 0, 0 beyond +-1, linear between."""
    return maximum(1.0 - absolute(t), 0.0 * t)


def relation(u):
    """[{unit}] at u [{quantity_unit}]: linear interpolation of the fitted curve."""
    t = (minimum(maximum(u, LOW + 0.0 * u), HIGH + 0.0 * u) - LOW) / STEP
    return ({interpolation})


@register
class {cls}(Effect):
    physics = "{physics}"
    excited_by = "{quantity} from {range}"
    kind, slot = "{kind}", "{slot}"
    applies_to = DYNAMIC
    order = 90{states}
    parameter = Parameter("share", "1", null=0.0, initial=1.0, bounds=(-3.0, 3.0),
                          meaning="fraction of the fitted curve", source="st discover --propose"{odd})
{body}
'''


def effect_name(relation: Relation) -> str:
    """Name of the effect, with a number if the model already has a relation for the same term."""
    name = f"proposed_{relation.candidate.term}"
    existing = sum(e.name == name or e.name.startswith(f"{name}_") for e in relation.model.effects)
    return f"{name}_{existing + 1}" if existing else name


def full_title(relation: Relation) -> str:
    """Description of the relation by its term and quantity."""
    c, is_constant = relation.candidate, bool(relation.formulas) and relation.formulas[0].shape == "constant"
    factor = f", for each unit of {quantities.QUANTITY_NAMES[c.factor]}" if c.factor else ""
    dependence = "the same for every" if is_constant else "as a function of the"
    return f"{quantities.TERM_NAMES[c.term]}{factor}, {dependence} {quantities.QUANTITY_NAMES[c.quantity]}"


def _title_with_causes(relation: Relation) -> str:
    causes = relation.formulas[0].causes if relation.formulas else ""
    return full_title(relation) + (f" (textbook causes: {causes})" if causes else "")


def effect_source(relation: Relation, runs: Sequence[str], created: str) -> str:
    """Source code of the effect file, with the fitted curve interpolated linearly between KNOTS points."""
    c = relation.candidate
    meaning = ALL_TERMS[c.term][1] + (f", for each {QUANTITIES[c.factor]} of {quantities.QUANTITY_NAMES[c.factor]}"
                                      if c.factor else "")
    knots = np.linspace(c.low, c.high, KNOTS)
    heights = relation.coefficients @ c.compute_splines(knots)
    terms = "\n            + ".join(f"{h:.6g} * hat(t - {k}.0)" for k, h in enumerate(heights))
    formulas = "\n".join(f"Formula {k}: {f.text} ({f.shape}, keeps {f.retained:.0%} of the curve's held-out gain)"
                         for k, f in enumerate(relation.formulas, 1)) or "No simple formula can replace the curve."
    return EFFECT_FILE.format(
        title=_title_with_causes(relation), count=len(runs), runs=", ".join(runs), created=created, low=c.low,
        high=c.high, step=(c.high - c.low) / (KNOTS - 1), quantity=quantities.QUANTITY_NAMES[c.quantity],
        range=f"{c.low:.3g} to {c.high:.3g} {QUANTITIES[c.quantity]}".removesuffix(" 1"),
        quantity_unit=QUANTITIES[c.quantity], unit=c.unit, meaning=f"y [{c.unit}]: {meaning}.",
        before=relation.position_5s[0], after=relation.position_5s[1], p_value=relation.p_value, formulas=formulas,
        interpolation=terms, cls="".join(word.title() for word in effect_name(relation).split("_")),
        odd=", odd=True" if c.is_one_sided else "",
        ops=IMPORTED_OPS.get(c.quantity, "absolute, maximum, minimum"), states=_state_source(c)[0],
        physics=f"y = curve of the {quantities.QUANTITY_NAMES[c.quantity]}: {meaning}", body=_hooks_source(relation),
        kind="surroundings" if c.quantity in MAP_QUANTITIES else "sensors" if c.is_sensor_error else "physics",
        slot=SLOTS[c.term])


def _hooks_source(relation: Relation) -> str:
    """Source code of the methods of the effect."""
    c = relation.candidate
    if c.is_sensor_error:
        field, u = SENSOR_READINGS[c.term], READING_EXPRESSIONS[c.quantity]
        return "".join(f"\n    @staticmethod\n    def {hook}(measured, theta):\n"
                       f"        y = theta.share * relation({u})\n"
                       f"        return measured._replace({field}=measured.{field} {sign} y)\n"
                       for hook, sign in (("observe", "+"), ("correct", "-"))).rstrip("\n")
    signature, body = HOOKS[c.term]
    constants = ""
    if c.term in OPPOSITE_AXLES:
        constants = ("\n    @staticmethod\n    def constants(vehicle):  # static load of the axle [N]\n"
                     f"        return 9.81 * vehicle.mass * vehicle.{OPPOSITE_AXLES[c.term]} / vehicle.wheelbase\n")
    y = f"theta.share * relation({_expression(c.quantity)})" + (f" * {_expression(c.factor)}" if c.factor else "")
    return f"{constants}\n    @staticmethod\n    def {signature}:\n        {body.format(y=y)}{_state_source(c)[1]}"


def _expression(name: str) -> str:
    """Python expression of a quantity, for a hook of the effect file."""
    if name not in FILTERED:
        return STATE_EXPRESSIONS[name]
    source, kind, tau = FILTERED[name]
    return "extra[0]" if kind == "lagging" else f"({STATE_EXPRESSIONS[source]} - extra[0]) / {tau!r}"


def _state_source(c: Candidate) -> tuple[str, str]:
    """(declaration of the state, hooks that integrate it) for a quantity that depends on earlier values, such as a lag;
    two empty strings for other quantities."""
    name = next((q for q in (c.quantity, c.factor) if q in FILTERED), "")
    if not name:
        return "", ""
    source, _, tau = FILTERED[name]
    current = STATE_EXPRESSIONS[source]
    return (f'\n    extra_states = ("lagging",)\n    extra_units = ("{QUANTITIES[source]}",)',
            f"\n\n    @staticmethod\n    def start(slips, instant, prepared, theta):\n        return ({current},)\n\n"
            "    @staticmethod\n    def rates(extra, slips, forces, instant, prepared, theta):\n"
            f"        return (({current} - extra[0]) / {tau!r},)")


def write_files(search: RelationSearch, vehicle: VehicleParameters, runs: Sequence[str], created: str,
                digests: dict[str, str], folder: Path) -> dict[str, Path]:
    """Write the effect file and the model file that uses it; returns the paths by kind, empty without a relation. A
    relation that depends on the time in the run is not written, because other drives cannot use it. User-defined
    effects of the model are copied, because a command accepts only one folder of effects."""
    relation = search.relation
    if relation is None or relation.candidate.quantity == "run_time":
        return {}
    effects = folder / "effects"
    effects.mkdir()
    file = effects / f"{effect_name(relation)}.py"
    file.write_text(effect_source(relation, runs, created), encoding="utf-8")
    for user_folder in {Path(find_source_file(e)).parent for e in relation.model.effects} - {EFFECTS_FOLDER}:
        for module in user_folder.glob("*.py"):
            if not (effects / module.name).exists():
                shutil.copyfile(module, effects / module.name)
    about = ModelProvenance(created[:10], data=digests, note=f"PROPOSAL of st discover: {_title_with_causes(relation)}")
    fitted = ModelFile.of(relation.model, vehicle, about, source="fitted together with the relation")
    active = {name: parts for name, parts in fitted.effects.items()
              if any(parts[p.name].value != p.null for e in relation.model.effects if e.name == name
                     for p in e.parameters if p.fit)}
    share = {"share": EffectValue(1.0, None, "st discover --propose")}
    model = replace(fitted, effects={**active, effect_name(relation): share})
    load_file(str(effects.absolute()), effect_name(relation))
    try:
        (folder / "proposed.yaml").write_text(model.to_yaml(), encoding="utf-8")
    finally:
        unload_folder(str(effects.absolute()))  # a later search in this process must not include it
    return {"effects": file, "proposed.yaml": folder / "proposed.yaml"}


def build_relation_document(search: RelationSearch) -> dict:
    """The entry `relation` of discovery.json (schema in docs/manual/discovery.md)."""
    relation = search.relation
    tried = [{"relation": name, "gain": gain, "p_value": p_value, "detection_limit": search.detection_limits.get(name)}
             for name, (gain, p_value) in search.tried.items()]
    if relation is None:
        return {"proposal": None, "why": search.reason, "tried": tried}
    c = relation.candidate
    return {"why": search.reason, "tried": tried, "proposal": {
        "place": c.term, "quantity": c.quantity, "by": c.factor, "unit": c.unit,
        "quantity_unit": QUANTITIES[c.quantity], "range": [c.low, c.high],
        "curve": {key: getattr(relation, key).tolist() for key in ("at", "value", "deviation", "density")},
        "gain": relation.gain, "p_value": relation.p_value, "position_5s": list(relation.position_5s),
        "runs": {name: list(pair) for name, pair in relation.runs.items()}, "others": dict(relation.others),
        "redundant": dict(relation.redundant), "next_drives": _drives_document(relation),
        "shares": {name: list(pair) for name, pair in relation.agreement.ratios.items()},
        "p_equal": relation.agreement.p_equal,
        "readings": [{"shape": f.shape, "text": f.text, "explained": f.retained, "causes": f.causes}
                     for f in relation.formulas]}}


def _drives_document(relation: Relation) -> dict:
    drives, separating = relation.next_drives, relation.next_drives.find_most_separating()
    precise = drives.find_most_precise(relation.deviation)
    return {"sparse": [list(between) for between in drives.sparse],
            "most_separating": {"manoeuvre": separating[0].manoeuvre.name, "from": separating[1]} if separating
            else None,
            "most_precise": precise.manoeuvre.name if precise else None,
            "current_separation": dict(drives.current_separation), "options": [
                {"manoeuvre": o.manoeuvre.name, "speed": o.manoeuvre.speed, "lateral": o.manoeuvre.lateral,
                 "duration": o.manoeuvre.duration, "times": REPETITIONS, "largest_deviation": float(o.deviation.max()),
                 "separation": dict(o.separation), "seconds_in_sparse": list(o.seconds)} for o in drives.options]}
