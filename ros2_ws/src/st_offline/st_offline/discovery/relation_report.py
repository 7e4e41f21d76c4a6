"""Reports a proposed relation: a headline for the terminal, sentences and tables for the page."""

from collections.abc import Sequence
from dataclasses import dataclass

from st_core.discovery import Discovery
from st_core.discovery.next_manoeuvre import REPETITIONS
from st_core.regression import Z95
from st_core.relations import Relation, RelationSearch
from st_core.relations.candidates import ODD, QUANTITIES
from st_core.relations.next_drive import INDEPENDENT_OF_MANOEUVRE, Option
from st_core.vehicle import VehicleParameters

from ..pages import Table
from . import quantities, report_text
from .figures import curve_unit
from .relation_files import effect_name, full_title
from .vehicle_update import changed_keys

SIGNIFICANCE_LEVEL = 0.01  # of the test that the relation has the same size in all runs
REPEAT_ELSEWHERE = ("repeat the drive twice, once from another starting point and once in the opposite direction, and "
                    "add these runs: only then can the effects of place, heading and time in the run be separated")
Groups = list[tuple[str, list[str]]]  # (heading, sentences)


@dataclass(frozen=True)
class RelationReport:
    """Report of a search for a relation. headline: the proposal in one line, "" without a proposal."""

    groups: Groups
    tables: Sequence[Table] = ()
    headline: str = ""


def report_relation(search: RelationSearch, discovery: Discovery, vehicle: VehicleParameters,
                    folder: str) -> RelationReport:
    """Report of a search for a relation. folder: folder of the results, named in the commands of the report."""
    relation = search.relation
    terms = ", ".join(quantities.TERM_NAMES[name] for name in search.find_unexamined_terms())
    not_excluded: Groups = [("not excluded", [f"a relation for a term that these drives do not excite enough: {terms}"]
                             )] if terms else []
    if relation is None:
        why = search.reason
        for name in sorted(search.tried, key=len, reverse=True):  # a name may begin with another
            why = why.replace(name, quantities.spell_out(name))
        return RelationReport([("proposal", [f"none: {why}"]), *not_excluded])
    without, with_it = relation.position_5s
    runs = ", ".join(f"{name} ({before:.2f} → {after:.2f} m)"
                     for name, (before, after) in relation.find_worse_runs().items())
    worse = f"ERRORS LARGER by 25 % or more in {runs}"
    causes = relation.formulas[0].causes if relation.formulas else ""
    proposal = [f"{f'{worse}. ' if runs else ''}{full_title(relation)}. A proposal is not established: try it, then "
                "keep or delete it",
                *([f"textbook causes: {causes}. These drives do not determine which one applies"] if causes else [])]
    headline = (f"PROPOSAL, not established: {full_title(relation)}; {without:.2f} m → {with_it:.2f} m (held-out)"
                f"{f'; {worse}' if runs else ''}")
    groups: Groups = [("proposal", proposal), ("effect size", _effect_size(relation, discovery, search.reason)),
                      ("formula", _formula(relation, vehicle)), ("uncertainty of the curve", _uncertainty(relation)),
                      ("alternatives", _alternatives(relation)), ("next drive", describe_next_drives(relation)),
                      *not_excluded, ("files", _files(relation, discovery.model is not None, folder))]
    tables = [_errors_by_run(relation, discovery), *_values_with_and_without(relation, discovery, vehicle)]
    return RelationReport([(heading, lines) for heading, lines in groups if lines], tables, headline)


def _effect_size(relation: Relation, discovery: Discovery, why: str) -> list[str]:
    without, with_it = relation.position_5s
    worse = [name for name, (before, after) in relation.runs.items() if after >= before]
    exceptions = f"; not smaller in {', '.join(worse)}" if worse else ""
    noise = f"; noise floor {discovery.errors['position_5s'].floor:.3f} m" if "position_5s" in discovery.errors else ""
    return [f"held-out mean position error after 5 s: {without:.3f} m without the relation, {with_it:.3f} m with "
            f"it{noise}", why,
            f"smaller errors in {len(relation.runs) - len(worse)} of {len(relation.runs)} runs{exceptions}"]


def _formula(relation: Relation, vehicle: VehicleParameters) -> list[str]:
    c = relation.candidate
    lines = [f"{'or ' if k else ''}{f.text.replace('^2', '²').replace('^3', '³')} ({f.shape}; keeps {f.retained:.0%} "
             "of the curve's held-out gain when simulated in its place)" for k, f in enumerate(relation.formulas)
             ] or ["no simple formula keeps 90 % of the curve's held-out gain when simulated in its place"]
    return [*lines, f"y: {quantities.axis_label(c)}, {c.unit.replace('^2', '²')}; u: "
            f"{quantities.QUANTITY_NAMES[c.quantity]}{quantities.SIGNS.get(c.quantity, '')}, "
            f"{QUANTITIES[c.quantity].replace('^2', '²')}",
            *filter(None, [quantities.explain_unit(c, vehicle)])]


def _uncertainty(relation: Relation) -> list[str]:
    """Sentences on the range of the quantity, the widest interval, sparse ranges and the variation between runs."""
    c, widest = relation.candidate, int(relation.deviation.argmax())
    (y_scale, unit), (x_scale, x_unit) = curve_unit(c.unit), curve_unit(QUANTITIES[c.quantity])
    lines = [f"driven: {quantities.QUANTITY_NAMES[c.quantity]} from {x_scale * c.low:.3g} to {x_scale * c.high:.3g} "
             f"{x_unit}; the curve is constant beyond this range",
             f"widest interval at {x_scale * relation.at[widest]:.3g} {x_unit}: {y_scale * relation.value[widest]:.2g} "
             f"± {y_scale * Z95 * relation.deviation[widest]:.2g} {unit} (95 %)"]
    if relation.next_drives.sparse:
        mirrored = ", to either side" if c.parity == ODD else ""
        ranges = ", ".join(f"{x_scale * low:.2g} to {x_scale * high:.2g} {x_unit}"
                           for low, high in relation.next_drives.sparse)
        lines.append(f"sparsely driven: {ranges}{mirrored}. There the curve is interpolated, and the interval assumes "
                     "the same smoothness: drive some seconds in this range, turning to both sides")
    weak = [name for name, (ratio, deviation) in relation.agreement.ratios.items()
              if ratio + Z95 * deviation < 0.5]
    if weak and relation.agreement.p_equal < SIGNIFICANCE_LEVEL:
        shares = ", ".join(f"{name} {share:.1f} ± {Z95 * deviation:.1f}" for name, (share, deviation) in
                           relation.agreement.ratios.items())
        lines.append(f"varies between runs: less than half as large in {', '.join(weak)} (relative size by run, "
                     f"95 %: {shares})")
    return lines


def _alternatives(relation: Relation) -> list[str]:
    lines = []
    if relation.others:
        names = "; ".join(f"{quantities.spell_out(name)} ({cosine:.2f})" for name, cosine in relation.others.items())
        lines.append(f"these drives do not separate it from: {names}. In brackets: cosine similarity of the two "
                     "effects on the predictions (1: identical, 0: unrelated)")
    for name, share in relation.redundant.items():
        lines.append(f"{quantities.to_words(name)} is named above, but is redundant with this relation (without it, "
                     f"the residual increases by {share:.1%}): it may have been fitted in place of the relation")
    return lines


def _files(relation: Relation, has_model: bool, folder: str) -> list[str]:
    """Sentences on the files and their use. has_model: whether the result without the relation also has files."""
    if relation.candidate.quantity == "run_time":
        return ["no effect file is written: a relation with the time in a run does not apply to other drives"]
    lines = [f"with the relation: the original vehicle file, proposed.yaml and effects/{effect_name(relation)}.py. To "
             f"predict, run st evaluate, st demo or st export with --model {folder}/proposed.yaml --effects "
             f"{folder}/effects; to search for further effects: st discover --base {folder}/proposed.yaml "
             f"--effects {folder}/effects; to test the file: st effects check "
             f"{folder}/effects/{effect_name(relation)}.py"]
    if has_model:
        lines += ["without the relation: vehicle.yaml and model.yaml, whichever was written",
                  "do not combine proposed.yaml with vehicle.yaml (the commands reject this): proposed.yaml already "
                  "contains the corrections of the vehicle file, which would be applied twice"]
    return lines


def _errors_by_run(relation: Relation, discovery: Discovery) -> Table:
    start = {}
    if discovery.steps and "position_5s" in discovery.errors:  # otherwise the steps contain errors of another channel
        start = {name: before for name, (before, _) in discovery.steps[0].runs.items()}
        start["all windows"] = discovery.steps[0].position_5s.base
    errors = sorted(relation.runs.items(), key=lambda item: item[1][1] - item[1][0])
    rows = [(name, f"{start[name]:.3f}" if name in start else "-", f"{without:.3f}", f"{with_it:.3f}",
             f"{with_it - without:+.3f} ({100.0 * (with_it / max(without, 1e-9) - 1.0):+.0f} %)".replace("-", "−"))
            for name, (without, with_it) in (*errors, ("all windows", relation.position_5s))]
    return Table("Held-out mean position error after 5 s, by run, m",
                 "Each run is predicted with values fitted to other driving. Sorted by the change; + means a larger "
                 "error.",
                 ("run", discovery.start, "without the relation", "with the relation", "change"), rows)


def _values_with_and_without(relation: Relation, discovery: Discovery, vehicle: VehicleParameters) -> list[Table]:
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
                     report_text.format_changes(changed_keys(vehicle, effect, values)))
            cells.append("; ".join(filter(None, texts)))
        rows.append(tuple(cells))
    return [Table("Values without and with the relation",
                  "Two fits of the same car. The values without the relation are those of vehicle.yaml and model.yaml; "
                  "the values with it are for proposed.yaml only; they differ because the relation explains a part of "
                  "the errors. A factor and the entry of the vehicle file after it are the same correction of the "
                  "original value.",
                  ("quantity", "without the relation", "with the relation"), rows)] if rows else []


def describe_next_drives(relation: Relation) -> list[str]:
    """Recommended manoeuvres that separate the relation from its alternatives or narrow its interval."""
    c, drives = relation.candidate, relation.next_drives
    if c.quantity in INDEPENDENT_OF_MANOEUVRE:
        return [REPEAT_ELSEWHERE]
    lines = []
    separating, precise = drives.find_most_separating(), drives.find_most_precise(relation.deviation)
    if separating is not None:
        option, rival = separating
        ratio = option.separation[rival] / max(drives.current_separation[rival], 1e-9)
        lines.append(f"to separate it from {quantities.spell_out(rival)}: {_describe_manoeuvre(option)}. Their "
                     f"separation is then {ratio:.1f} times as large")
    elif drives.current_separation:
        lines.append("no manoeuvre of the catalogue separates it much better from its alternatives: look for "
                     "the cause on the car itself")
    if len(drives.current_separation) < len(relation.others):
        lines.append(f"to separate it from effects of place, heading or time: {REPEAT_ELSEWHERE}")
    if precise is not None:
        y_scale, unit = curve_unit(c.unit)
        lines.append(f"for a narrower interval: {_describe_manoeuvre(precise)}. The widest 95 % interval shrinks from "
                     f"± {y_scale * Z95 * relation.deviation.max():.2g} to ± "
                     f"{y_scale * Z95 * precise.deviation.max():.2g} {unit}")
    return lines


def _describe_manoeuvre(option: Option) -> str:
    manoeuvre = option.manoeuvre
    return (f"{manoeuvre.name}, {REPETITIONS} times {manoeuvre.duration:.0f} s "
            f"({manoeuvre.description.replace('^2', '²')}, from {manoeuvre.speed:.1f} m/s)")
