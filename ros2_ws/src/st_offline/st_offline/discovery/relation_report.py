"""Reports a proposed relation in the terminal, on the page and in discovery.json, and writes it as an effect file."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from st_core.discovery import Discovery
from st_core.discovery.next_manoeuvre import REPETITIONS
from st_core.effects import Effect, find_source_file, get_effect, load_file, unload_folder
from st_core.model_file import EffectValue, ModelFile, ModelProvenance
from st_core.regression import Z95
from st_core.relations import Candidate, Relation, RelationSearch
from st_core.relations.candidates import ALL_TERMS, FILTERED_QUANTITIES, ODD, QUANTITIES
from st_core.relations.next_drive import INDEPENDENT_OF_MANOEUVRE, Option
from st_core.vehicle import VehicleParameters

from ..pages import Table
from . import quantities, report_text
from .vehicle_update import find_changed_entries

MIN_REPORTED_RATIO = 1.25  # smallest reported ratio of a run's held-out error with the relation to that without
SIGNIFICANCE_LEVEL = 0.01  # of the test that the relation has the same size in all runs
REPEAT_ELSEWHERE = ("repeat the drive twice, once from a different starting point and once in the opposite direction, "
                    "and add these runs: only then can the effects of place, heading and time in the run be separated")
EFFECTS_FOLDER = Path(find_source_file(Effect)).parent
SLOTS = {"front_steer": "front axle", "rear_steer": "rear axle", "front_force": "front axle", "rear_force": "rear axle",
         "front_grip": "front axle", "rear_grip": "rear axle", "both_grip": "both axles", "yaw_moment": "body",
         "side_force": "body", "sensor_yaw_rate": "yaw rate", "sensor_acceleration_y": "acceleration",
         "sensor_velocity_y": "velocity", "sensor_heading": "heading"}
MAP_QUANTITIES = ("north", "east", "position_x", "position_y")  # relative to the map, not the car
EFFECT_FILE = '''"""PROPOSAL, not an established effect: {title}.

Fitted by st discover to {count} drives, {created}: {runs}.
For {quantity} from {range}; constant beyond. {meaning}
{errors}p = {p_value:.2g}, corrected for multiple testing.
{formulas}
Keep it, rename it, or delete it.
"""

from st_core.effects import Effect, {base}, fix_curve, register


@register
class {cls}(Effect):
    physics = "{physics}"
    excited_by = "{quantity} from {range}"
    kind, slot = "{kind}", "{slot}"
    order = 90{states}
    parameters = fix_curve(  # coefficients of the curve, its range, and weights; see {base}
        {base}, odd={odd},
        {values})
{hooks}
'''
Groups = list[tuple[str, list[str]]]  # (heading, sentences)


@dataclass(frozen=True)
class RelationReport:
    """Report of a search for a relation. headline: the proposal in one line, "" without a proposal."""

    groups: Groups
    tables: Sequence[Table] = ()
    headline: str = ""


def report_relation(search: RelationSearch, discovery: Discovery, vehicle: VehicleParameters,
                    folder: str) -> RelationReport:
    """Report of a search for a relation. folder: folder of the results, for the commands in the report."""
    relation = search.relation
    terms = ", ".join(quantities.TERM_NAMES[name] for name in search.find_unexamined_terms())
    not_excluded: Groups = [("not excluded", [f"a relation for a term that these drives do not excite enough: {terms}"]
                             )] if terms else []
    if relation is None:
        reason = search.reason
        for name in sorted(search.statistics, key=len, reverse=True):  # a name may be a prefix of a longer one
            reason = reason.replace(name, quantities.spell_out(name))
        return RelationReport([("proposal", [f"none: {reason}"]), *not_excluded])
    runs = ", ".join(f"{name} ({before:.2f} → {after:.2f} m)" for name, (before, after) in relation.runs.items()
                     if after >= MIN_REPORTED_RATIO * before)
    worse = f"LARGER ERRORS, by 25 % or more, in {runs}"
    causes = relation.formulas[0].causes if relation.formulas else ""
    title = quantities.describe_relation(relation)
    proposal = [f"{f'{worse}. ' if runs else ''}{title}. This is not an established effect: try "
                "it, then keep or delete it",
                *([f"textbook causes: {causes}. These drives do not determine which one applies"] if causes else [])]
    errors = relation.describe_errors("; {:.2f} m → {:.2f} m (held-out)")
    headline = f"PROPOSAL, not established: {title}{errors}{f'; {worse}' if runs else ''}"
    groups: Groups = [("proposal", proposal), ("effect size", _describe_size(relation, discovery, search.reason)),
                      ("formula", _describe_formulas(relation, vehicle)),
                      ("uncertainty of the curve", _describe_uncertainty(relation)),
                      ("alternatives", _list_alternatives(relation)), ("next drive", describe_next_drives(relation)),
                      *not_excluded, ("files", _describe_files(relation, discovery.model is not None, folder))]
    tables = [_make_error_table(relation, discovery)] if relation.runs else []
    tables += _make_value_tables(relation, discovery, vehicle)
    return RelationReport([(heading, lines) for heading, lines in groups if lines], tables, headline)


def _describe_size(relation: Relation, discovery: Discovery, reason: str) -> list[str]:
    noise = f"; noise level {discovery.errors['position_5s'].floor:.3f} m" if "position_5s" in discovery.errors else ""
    errors = "held-out mean position error after 5 s: {:.3f} m without the relation, {:.3f} m with it"
    return [relation.describe_errors(errors) + noise, reason] if relation.runs else [reason]


def _describe_formulas(relation: Relation, vehicle: VehicleParameters) -> list[str]:
    c = relation.candidate
    lines = [f"{'or ' if k else ''}{f.text.replace('^2', '²').replace('^3', '³')} ({f.shape}; keeps "
             f"{100 * f.retained_fraction:.0f} % of the curve's held-out gain when simulated in its place)"
             for k, f in enumerate(relation.formulas)]
    lines = lines or ["no simple formula keeps 90 % of the curve's held-out gain when simulated in its place"]
    return [*lines, f"y: {quantities.make_axis_label(c)}, {c.unit.replace('^2', '²')}; u: "
            f"{quantities.QUANTITY_NAMES[c.quantity]}{quantities.SIGNS.get(c.quantity, '')}, "
            f"{QUANTITIES[c.quantity].replace('^2', '²')}",
            *filter(None, [quantities.explain_unit(c, vehicle)])]


def _describe_uncertainty(relation: Relation) -> list[str]:
    """Sentences on the range of the drives, the widest interval, ranges with few samples and variation between runs."""
    c, widest = relation.candidate, int(relation.deviation.argmax())
    (y_scale, unit), (x_scale, x_unit) = map(quantities.get_curve_unit, (c.unit, QUANTITIES[c.quantity]))
    lines = [f"range of the drives: {quantities.QUANTITY_NAMES[c.quantity]} from {x_scale * c.low:.3g} to "
             f"{x_scale * c.high:.3g} {x_unit}; the curve is constant beyond this range",
             f"widest interval at {x_scale * relation.points[widest]:.3g} {x_unit}: "
             f"{y_scale * relation.value[widest]:.2g} ± {y_scale * Z95 * relation.deviation[widest]:.2g} {unit} (95 %)"]
    if relation.next_drives.sparse_ranges:
        mirrored = ", on both sides" if c.parity == ODD else ""
        ranges = ", ".join(f"{x_scale * low:.2g} to {x_scale * high:.2g} {x_unit}"
                           for low, high in relation.next_drives.sparse_ranges)
        lines.append(f"few samples: {ranges}{mirrored}. The curve is interpolated there, and its interval assumes "
                     "that it is as smooth as elsewhere: drive several seconds in this range, in left and right turns")
    weak = [name for name, (ratio, deviation) in relation.agreement.ratios.items() if ratio + Z95 * deviation < 0.5]
    if weak and relation.agreement.p_equal < SIGNIFICANCE_LEVEL:
        sizes = ", ".join(f"{name} {ratio:.1f} ± {Z95 * deviation:.1f}" for name, (ratio, deviation) in
                          relation.agreement.ratios.items())
        lines.append(f"varies between runs: less than half the overall size in {', '.join(weak)} (relative size by "
                     f"run, 95 %: {sizes})")
    return lines


def _list_alternatives(relation: Relation) -> list[str]:
    lines = []
    if relation.alternatives:
        names = "; ".join(f"{quantities.spell_out(name)} ({cosine:.2f})"
                          for name, cosine in relation.alternatives.items())
        lines.append(f"these drives do not separate it from: {names}. In brackets: cosine similarity of the two "
                     "effects on the predictions (1: identical, 0: unrelated)")
    for name, increase in relation.redundant.items():
        lines.append(f"{quantities.to_words(name)} is reported above, but is redundant given this relation (residual "
                     f"without the effect: {100 * increase:+.1f} %): it may have been fitted in place of the relation")
    return lines


def _describe_files(relation: Relation, has_model: bool, folder: str) -> list[str]:
    """Sentences on the files and their use. has_model: whether there are also files without the relation."""
    if relation.candidate.quantity == "run_time":
        return ["no effect file is written: a relation that depends on time in the run does not apply to other drives"]
    lines = [f"with the relation: the original vehicle file, proposed.yaml and effects/{name_effect(relation)}.py. To "
             f"predict, run st evaluate, st demo or st export with --model {folder}/proposed.yaml --effects "
             f"{folder}/effects; to search for further effects: st discover --base {folder}/proposed.yaml "
             f"--effects {folder}/effects; to test the file: st effects check "
             f"{folder}/effects/{name_effect(relation)}.py"]
    if has_model:
        lines += ["without the relation: vehicle.yaml and model.yaml, if they were written",
                  "do not combine proposed.yaml with vehicle.yaml (the commands reject this): proposed.yaml already "
                  "contains the corrections of the vehicle file, which would be applied twice"]
    return lines


def _make_error_table(relation: Relation, discovery: Discovery) -> Table:
    start = {}
    if discovery.steps and "position_5s" in discovery.errors:  # otherwise the steps contain channel errors
        start = {name: before for name, (before, _) in discovery.steps[0].runs.items()}
        start["all windows"] = discovery.steps[0].position_5s.base
    errors = sorted(relation.runs.items(), key=lambda item: item[1][1] - item[1][0])
    rows = [(name, f"{start[name]:.3f}" if name in start else "-", f"{before:.3f}", f"{after:.3f}",
             f"{after - before:+.3f} ({100.0 * (after / max(before, 1e-9) - 1.0):+.0f} %)".replace("-", "−"))
            for name, (before, after) in (*errors, ("all windows", relation.position_5s))]
    return Table("Held-out mean position error after 5 s, by run, m",
                 "Each run is predicted with values fitted to other data. Sorted by the change; + means a larger "
                 "error.",
                 ("run", discovery.start, "without the relation", "with the relation", "change"), rows)


def _make_value_tables(relation: Relation, discovery: Discovery, vehicle: VehicleParameters) -> list[Table]:
    """Table of the effects fitted without and with the relation; none without effects."""
    if discovery.model is None:
        return []
    rows = []
    for effect in relation.model.effects:
        original, refitted = discovery.model.values.get(effect.name), relation.model.values[effect.name]
        fitted = [p for p in effect.parameters if p.fit]
        if original is None or all(refitted[p.name] == p.null == original[p.name] for p in fitted):
            continue
        cells = [quantities.to_words(effect.name)]
        for values in (original, refitted):
            texts = (quantities.format_fitted(effect.name, {p.name: values[p.name] for p in fitted}),
                     report_text.format_changes(find_changed_entries(vehicle, effect, values)))
            cells.append("; ".join(filter(None, texts)))
        rows.append(tuple(cells))
    return [Table("Values without and with the relation",
                  "Two fits to the same drives. The values without the relation are those of vehicle.yaml and "
                  "model.yaml; the values with it are for proposed.yaml only, and differ because the relation explains "
                  "part of the errors. A factor and the vehicle-file entry listed after it are two forms of one "
                  "correction.",
                  ("quantity", "without the relation", "with the relation"), rows)] if rows else []


def describe_next_drives(relation: Relation) -> list[str]:
    """Recommended manoeuvres that separate the relation from its alternatives or narrow its interval."""
    c, drives = relation.candidate, relation.next_drives
    if c.quantity in INDEPENDENT_OF_MANOEUVRE:
        return [REPEAT_ELSEWHERE]
    lines = []
    separating, precise = drives.find_most_separating(), drives.find_most_precise(relation.deviation)
    if separating is not None:
        option, alternative = separating
        ratio = option.separation[alternative] / max(drives.current_separation[alternative], 1e-9)
        lines.append(f"to separate it from {quantities.spell_out(alternative)}: {_describe_manoeuvre(option)}. Their "
                     f"separation is then {ratio:.1f} times as large")
    elif drives.current_separation:
        lines.append("no manoeuvre of the catalogue separates it much better from its alternatives: look for "
                     "the cause on the car itself")
    if len(drives.current_separation) < len(relation.alternatives):
        lines.append(f"to separate it from effects of place, heading or time: {REPEAT_ELSEWHERE}")
    if precise is not None:
        y_scale, unit = quantities.get_curve_unit(c.unit)
        lines.append(f"for a narrower interval: {_describe_manoeuvre(precise)}. The widest 95 % interval shrinks from "
                     f"± {y_scale * Z95 * relation.deviation.max():.2g} to ± "
                     f"{y_scale * Z95 * precise.deviation.max():.2g} {unit}")
    return lines


def _describe_manoeuvre(option: Option) -> str:
    manoeuvre = option.manoeuvre
    return (f"{manoeuvre.name}, {REPETITIONS} times {manoeuvre.duration:.0f} s "
            f"({manoeuvre.description.replace('^2', '²')}, from {manoeuvre.speed:.1f} m/s)")


def name_effect(relation: Relation) -> str:
    """Name of the effect, with a number if the model already has a relation for the same term."""
    name = f"proposed_{relation.candidate.term}"
    existing = sum(e.name == name or e.name.startswith(f"{name}_") for e in relation.model.effects)
    return f"{name}_{existing + 1}" if existing else name


def _describe_with_causes(relation: Relation) -> str:
    causes = relation.formulas[0].causes if relation.formulas else ""
    return quantities.describe_relation(relation) + (f" (textbook causes: {causes})" if causes else "")


def make_effect_code(relation: Relation, runs: Sequence[str], created: str) -> str:
    """Source code of the effect file: the constants of the fitted curve, and the hooks through which it acts."""
    c = relation.candidate
    kind = get_effect(c.effect)
    meaning = ALL_TERMS[c.term][1] + (f", for each {QUANTITIES[c.factor]} of {quantities.QUANTITY_NAMES[c.factor]}"
                                      if c.factor else "")
    values = {**{f"c{k}": float(f"{height:.6g}") for k, height in enumerate(relation.coefficients)}, **c.constants}
    formulas = "\n".join(f"Formula {k}: {f.text} ({f.shape}, keeps {100 * f.retained_fraction:.0f} % of the curve's "
                         "held-out gain)" for k, f in enumerate(relation.formulas, 1))
    formulas = formulas or "No simple formula can replace the curve."
    return EFFECT_FILE.format(
        title=_describe_with_causes(relation), count=len(runs), runs=", ".join(runs), created=created,
        quantity=quantities.QUANTITY_NAMES[c.quantity],
        range=f"{c.low:.3g} to {c.high:.3g} {QUANTITIES[c.quantity]}".removesuffix(" 1"),
        meaning=f"y [{c.unit}]: {meaning}.",
        errors=relation.describe_errors("Held-out position error after 5 s: {:.2f} -> {:.2f} m; "),
        p_value=relation.p_value, formulas=formulas, base=kind.__name__, odd=c.is_one_sided,
        cls="".join(word.title() for word in name_effect(relation).split("_")),
        physics=f"y = curve of the {quantities.QUANTITY_NAMES[c.quantity]}: {meaning}",
        kind="environment" if c.quantity in MAP_QUANTITIES else "sensors" if c.is_sensor_error else "physics",
        slot=SLOTS[c.term], states="".join(
            f'\n    extra_states = ("lagging",)\n    extra_units = ("{QUANTITIES[FILTERED_QUANTITIES[q][0]]}",)'
            for q in (c.quantity, c.factor) if q in FILTERED_QUANTITIES),
        values=",\n        ".join(f"{name}={value!r}" for name, value in values.items()),
        hooks="\n".join(f"    {hook} = staticmethod({kind.__name__}.{hook})" for hook in _list_hooks(c)))


def _list_hooks(c: Candidate) -> tuple[str, ...]:
    """Names of the effect's hooks through which a relation acts."""
    if c.is_sensor_error:
        return "observe", "correct"
    if c.term.endswith("_steer"):
        return ("slip_angles", "start", "rates") if get_effect(c.effect).extra_states else ("slip_angles",)
    return ("acceleration",) if SLOTS[c.term] == "body" else ("constants", "axle_forces")


def write_files(search: RelationSearch, vehicle: VehicleParameters, runs: Sequence[str], created: str,
                digests: dict[str, str], folder: Path) -> dict[str, Path]:
    """Write the effect file and the model file that uses it; returns their paths by kind, empty for a relation that
    depends on the time in the run. User-defined effects of the model are copied: a command accepts one folder of
    effects."""
    relation = search.relation
    if relation is None or relation.candidate.quantity == "run_time":
        return {}
    effects = folder / "effects"
    effects.mkdir()
    file = effects / f"{name_effect(relation)}.py"
    file.write_text(make_effect_code(relation, runs, created), encoding="utf-8")
    for user_folder in {Path(find_source_file(e)).parent for e in relation.model.effects} - {EFFECTS_FOLDER}:
        for module in user_folder.glob("*.py"):
            if not (effects / module.name).exists():
                shutil.copyfile(module, effects / module.name)
    note = f"PROPOSAL of st discover: {_describe_with_causes(relation)}"
    provenance = ModelProvenance(created[:10], data=digests, note=note)
    fitted = ModelFile.from_model(relation.model.select_effects(relation.model.active_effects), vehicle, provenance,
                                  source="fitted together with the relation")
    scale = {"share": EffectValue(1.0, None, "st discover --propose")}
    model = replace(fitted, effects={**fitted.effects, name_effect(relation): scale})
    load_file(str(effects.absolute()), name_effect(relation))
    try:
        (folder / "proposed.yaml").write_text(model.to_yaml(), encoding="utf-8")
    finally:
        unload_folder(str(effects.absolute()))  # a later search in this process must not use it
    return {"effects": file, "proposed.yaml": folder / "proposed.yaml"}


def build_relation_document(search: RelationSearch) -> dict:
    """The entry `relation` of discovery.json (schema in docs/manual/discovery.md)."""
    relation = search.relation
    tried = [{"relation": name, "gain": gain, "p_value": p_value, "detection_limit": search.detection_limits.get(name)}
             for name, (gain, p_value) in search.statistics.items()]
    if relation is None:
        return {"proposal": None, "reason": search.reason, "tried": tried}
    c, drives = relation.candidate, relation.next_drives
    separating, precise = drives.find_most_separating(), drives.find_most_precise(relation.deviation)
    next_drives = {
        "sparse_ranges": drives.sparse_ranges,
        "most_separating": separating and {"manoeuvre": separating[0].manoeuvre.name, "rival": separating[1]},
        "most_precise": precise and precise.manoeuvre.name,
        "current_separation": drives.current_separation, "options": [
            {"manoeuvre": o.manoeuvre.name, "speed": o.manoeuvre.speed,
             "lateral_acceleration": o.manoeuvre.lateral_acceleration, "duration": o.manoeuvre.duration,
             "repetitions": REPETITIONS, "largest_deviation": o.deviation.max(), "separation": o.separation,
             "seconds_in_sparse_ranges": o.seconds} for o in drives.options]}
    return {"reason": search.reason, "tried": tried, "proposal": {
        "term": c.term, "quantity": c.quantity, "factor": c.factor, "unit": c.unit,
        "quantity_unit": QUANTITIES[c.quantity], "range": [c.low, c.high],
        "curve": {key: getattr(relation, key) for key in ("points", "value", "deviation", "density")},
        "gain": relation.gain, "p_value": relation.p_value, "position_5s": relation.position_5s, "runs": relation.runs,
        "rivals": relation.alternatives, "redundant": relation.redundant, "next_drives": next_drives,
        "size_ratios": relation.agreement.ratios, "p_equal": relation.agreement.p_equal, "formulas": relation.formulas}}
