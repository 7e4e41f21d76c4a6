"""A proposed law as an effect file a person can read, run and delete, and as sentences."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from st_core.effects import load_folder
from st_core.effects._law import PLACES
from st_core.model_file import Estimate, ModelFile, Provenance
from st_core.proposals import Proposal, Proposals
from st_core.proposals.places import QUANTITIES
from st_core.vehicle import VehicleParameters

KNOTS = 21  # straight lines between; the curve has eight numbers, so that nothing is lost
SLOT = {"front_steer": "front axle", "rear_steer": "rear axle", "front_force": "front axle", "rear_force": "rear axle",
        "front_grip": "front axle", "rear_grip": "rear axle", "yaw_moment": "body", "side_force": "body",
        "sensor_yaw_rate": "yaw rate", "sensor_acceleration_y": "acceleration", "sensor_velocity_y": "velocity",
        "sensor_heading": "heading"}
OF_MOTION = {"steering": "at.road_wheel_angle", "acceleration_y": "at.velocity_x * at.yaw_rate",
             "acceleration_x": "at.velocity_x_dot", "speed": "at.velocity_x", "yaw_rate": "at.yaw_rate",
             "slip_front": "slip_front", "slip_rear": "slip_rear"}
OF_READINGS = {"acceleration_y": "measured.velocity_x * measured.yaw_rate", "speed": "measured.velocity_x",
               "yaw_rate": "measured.yaw_rate"}
FIELD = {"sensor_yaw_rate": "yaw_rate", "sensor_acceleration_y": "acceleration_y", "sensor_velocity_y": "velocity_y",
         "sensor_heading": "yaw"}
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
from st_core.ops import absolute, maximum, minimum

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
    order = 90
    parameters = (
        Parameter("share", "1", null=0.0, initial=1.0, bounds=(-3.0, 3.0), meaning="of the curve as it was fitted",
                  source="st discover --propose"{odd}),
    )
{body}
'''


def name_of(one: Proposal) -> str:
    return f"proposed_{one.candidate.place}"


def title(one: Proposal) -> str:
    c = one.candidate
    causes = f" ({one.readings[0].causes})" if one.readings and one.readings[0].causes else ""
    return f"{c.place.replace('_', ' ')} as a function of {c.quantity.replace('_', ' ')}{causes}"


def effect_file(one: Proposal, runs: Sequence[str], created: str) -> str:
    """The text of an effect file. Its law is the fitted curve to the width of a line."""
    c = one.candidate
    unit, meaning = PLACES[c.place]
    knots = np.linspace(c.low, c.high, KNOTS)
    heights = one.coefficients @ c.splines(knots)
    terms = "\n            + ".join(f"{h:.6g} * hat(t - {k}.0)" for k, h in enumerate(heights))
    read = "\n".join(f"Reading {k}: {r.text} ({r.shape}, explains {r.explained:.0%} of the curve)"
                     for k, r in enumerate(one.readings, 1)) or "No simple formula fits it."
    return FILE.format(
        title=title(one), count=len(runs), runs=", ".join(runs), created=created, low=c.low, high=c.high,
        step=(c.high - c.low) / (KNOTS - 1), quantity=c.quantity.replace("_", " "),
        quantity_unit=QUANTITIES[c.quantity],
        unit=unit, meaning=f"y [{unit}]: {meaning}.", before=one.position_5s[0], after=one.position_5s[1],
        chance=one.chance, readings=read, heights=terms, cls="".join(w.title() for w in name_of(one).split("_")),
        odd=", odd=True" if c.changes_sides else "", name=name_of(one),
        physics=f"y = curve of {c.quantity}: {meaning}", body=_body(one),
        kind="sensors" if c.place.startswith("sensor_") else "physics", slot=SLOT[c.place])


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
    y = f"theta.share * law({OF_MOTION[c.quantity]})"
    return f"{before}\n    @staticmethod\n    def {hook}:\n        {text.format(y=y)}"


def write(found: Proposals, vehicle: VehicleParameters, runs: Sequence[str], created: str, digests: dict[str, str],
          folder: Path) -> dict[str, Path]:
    """The effect file and the model file that uses it, by what they are; nothing without a proposal."""
    one = found.proposal
    if one is None:
        return {}
    effects = folder / "effects"
    effects.mkdir()
    file = effects / f"{name_of(one)}.py"
    file.write_text(effect_file(one, runs, created), encoding="utf-8")
    load_folder(str(effects.absolute()))
    about = Provenance(created[:10], data=digests, note=f"PROPOSAL of st discover: {title(one)}")
    plain = ModelFile.of(one.model, vehicle, about, source="fitted beside the proposal")
    active = {name: parts for name, parts in plain.effects.items()
              if any(parts[p.name].value != p.null for e in one.model.effects if e.name == name
                     for p in e.parameters if p.fit)}
    share = {"share": Estimate(1.0, None, "st discover --propose")}
    model = ModelFile(plain.base, {**active, name_of(one): share}, plain.vehicle, plain.vehicle_name,
                      plain.vehicle_hash, about)
    (folder / "proposed.yaml").write_text(model.to_yaml(), encoding="utf-8")
    return {"effects": file, "proposed.yaml": folder / "proposed.yaml"}


def document(found: Proposals | None) -> dict:
    """For discovery.json."""
    if found is None:
        return {}
    one = found.proposal
    tried = [{"law": name, "gain": gain, "chance": chance} for name, (gain, chance) in found.tried.items()]
    if one is None:
        return {"proposal": None, "why": found.why, "tried": tried}
    c = one.candidate
    return {"why": found.why, "tried": tried, "proposal": {
        "place": c.place, "quantity": c.quantity, "unit": PLACES[c.place][0], "quantity_unit": QUANTITIES[c.quantity],
        "range": [c.low, c.high], "curve": {"at": one.at.tolist(), "value": one.value.tolist(),
                                            "deviation": one.deviation.tolist(), "density": one.density.tolist()},
        "gain": one.gain, "chance": one.chance, "position_5s": list(one.position_5s),
        "runs": {name: list(pair) for name, pair in one.runs.items()}, "others": dict(one.others),
        "readings": [{"shape": r.shape, "text": r.text, "explained": r.explained, "causes": r.causes}
                     for r in one.readings]}}


def told(found: Proposals) -> list[str]:
    """Lines for terminal and page."""
    one = found.proposal
    if one is None:
        return [f"nothing is proposed: {found.why}"]
    unit, meaning = PLACES[one.candidate.place]
    lines = [f"PROPOSAL, for you to keep or delete: {title(one)}; {found.why}"]
    lines += [f"reads as {r.text} ({r.shape}; {r.explained:.0%} of the curve)" for r in one.readings]
    lines.append(f"y in {unit}, {meaning}; u is {one.candidate.quantity.replace('_', ' ')} in "
                 f"{QUANTITIES[one.candidate.quantity]}, {one.candidate.low:.3g} to {one.candidate.high:.3g}")
    if one.others:
        names = ", ".join(f"{name} (cosine {cosine:.2f})" for name, cosine in one.others.items())
        lines.append(f"as good on held-out driving: {names}")
    worse = [name for name, (before, after) in one.runs.items() if after > before]
    lines.append(f"it helps in {len(one.runs) - len(worse)} of {len(one.runs)} runs"
                 + (f", not in {', '.join(worse)}" if worse else ""))
    return lines
