"""Report of a proposed relation, for terminal and page: statements by question, tables, commands, next drives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from st_core.discovery import Discovery
from st_core.discovery.next_manoeuvre import REPETITIONS
from st_core.relations import Relation, RelationSearch
from st_core.relations.candidates import ODD, QUANTITIES
from st_core.relations.next_drive import INDEPENDENT_OF_MANOEUVRE, Option
from st_core.vehicle import VehicleParameters

from ..pages import Table
from . import quantities, report_text
from .figures import display_unit
from .relation_files import name_of, title_of
from .vehicle_update import changed_keys

P_DIFFERENT = 0.01  # the relation varies between runs if equal ratios in all runs have a p-value below this
SQUARES = str.maketrans({"^": None, "2": "²"})
ELSEWHERE = ("drive the same again, once beginning elsewhere on the course and once in the other direction, and add "
             "these runs: only then can the place, the course and the time in the run be separated")
Groups = list[tuple[str, list[str]]]


@dataclass(frozen=True)
class RelationReport:
    """groups: (question, sentences). headline: the proposal in a line, "" without one."""

    groups: Groups
    tables: Sequence[Table] = ()
    headline: str = ""


def relation_report(found: RelationSearch, discovery: Discovery, vehicle: VehicleParameters,
                    folder: str) -> RelationReport:
    """Report of a search for a relation. folder: of the results."""
    relation = found.relation
    terms = ", ".join(quantities.TERMS[name] for name in found.not_examined())
    excluded: Groups = [("not excluded", [f"a relation of these terms, which is not detectable in the drives: {terms}"]
                         )] if terms else []
    if relation is None:
        return RelationReport([("proposal", [f"none: {quantities.spell_out(found.why, found.tried)}"]), *excluded])
    without, with_it = relation.position_5s
    runs = ", ".join(f"{name} ({before:.2f} → {after:.2f} m)"
                     for name, (before, after) in relation.worse_runs().items())
    worse, causes = f"ERRORS LARGER by 25 % or more in {runs}", relation.formulas[0].causes if relation.formulas else ""
    proposal = [f"{f'{worse}. ' if runs else ''}{title_of(relation)}. A proposal is not established: try it, then keep "
                "or delete it", *([f"textbook causes: {causes}. These drives do not show the cause"] if causes else [])]
    headline = (f"PROPOSAL, not established: {title_of(relation)}; {without:.2f} m → {with_it:.2f} m (held-out)"
                f"{f'; {worse}' if runs else ''}")
    groups: Groups = [("proposal", proposal), ("effect size", _effect_size(relation, discovery, found.why)),
                      ("formula", _formula(relation, vehicle)), ("uncertainty of the curve", _uncertainty(relation)),
                      ("alternatives", _alternatives(relation)), ("next drive", next_drive_sentences(relation)),
                      *excluded, ("files", _files(relation, discovery.model is not None, folder))]
    filled = [(question, lines) for question, lines in groups if lines]
    tables = [_errors_by_run(relation, discovery), *_values_with_and_without(relation, discovery, vehicle)]
    return RelationReport(filled, tables, headline)


def _effect_size(relation: Relation, discovery: Discovery, why: str) -> list[str]:
    without, with_it = relation.position_5s
    worse = [name for name, (before, after) in relation.runs.items() if after >= before]
    exceptions = f", not in {', '.join(worse)}" if worse else ""
    noise = f"; noise floor {discovery.errors['position_5s'].floor:.3f} m" if "position_5s" in discovery.errors else ""
    return [f"held-out mean position error after 5 s: {without:.3f} m without the relation, {with_it:.3f} m with "
            f"it{noise}", why,
            f"smaller errors in {len(relation.runs) - len(worse)} of {len(relation.runs)} runs{exceptions}"]


def _formula(relation: Relation, vehicle: VehicleParameters) -> list[str]:
    c = relation.candidate
    lines = [f"{'or ' if k else ''}{r.text.replace('^2', '²').replace('^3', '³')} "
             f"({r.shape}; keeps {r.kept:.0%} of the curve's held-out gain when "
             "simulated in its place)" for k, r in enumerate(relation.formulas)
             ] or ["no simple formula keeps 90 % of the curve's held-out gain when simulated in its place"]
    return [*lines, f"y: {quantities.axis(c)}, {c.unit.translate(SQUARES)}; u: "
            f"{quantities.QUANTITIES[c.quantity]}{quantities.SIGNS.get(c.quantity, '')}, "
            f"{QUANTITIES[c.quantity].translate(SQUARES)}",
            *filter(None, [quantities.in_newtons(c, vehicle)])]


def _uncertainty(relation: Relation) -> list[str]:
    """Driven range, the widest interval, sparse ranges, variation between runs."""
    c, widest = relation.candidate, int(relation.deviation.argmax())
    (y_scale, unit), (x_scale, x_unit) = display_unit(c.unit), display_unit(QUANTITIES[c.quantity])
    lines = [f"driven: {quantities.QUANTITIES[c.quantity]} from {x_scale * c.low:.3g} to {x_scale * c.high:.3g} "
             f"{x_unit}; the curve is constant beyond",
             f"widest interval at {x_scale * relation.at[widest]:.3g} {x_unit}: {y_scale * relation.value[widest]:.2g} "
             f"± {y_scale * report_text.Z95 * relation.deviation[widest]:.2g} {unit} (95 %)"]
    if relation.drives.sparse:
        mirrored = ", to either side" if c.parity == ODD else ""
        lines.append(f"sparsely driven: {_ranges(relation, relation.drives.sparse)}{mirrored}. There the curve is "
                     "interpolated, and the interval assumes the same smoothness: drive some seconds there, "
                     "turning to both sides")
    absent = relation.shares.absent() if relation.shares.p_equal < P_DIFFERENT else []
    if absent:
        shares = ", ".join(f"{name} {share:.1f} ± {report_text.Z95 * deviation:.1f}" for name, (share, deviation) in
                           relation.shares.by_run.items())
        lines.append(f"varies between runs: nearly absent in {', '.join(absent)} (its size by run, 95 %: {shares})")
    return lines


def _alternatives(relation: Relation) -> list[str]:
    lines = []
    if relation.others:
        names = "; ".join(f"{quantities.written_out(name)} ({cosine:.2f})" for name, cosine in relation.others.items())
        lines.append(f"these drives do not separate it from: {names}. In brackets the cosine similarity of the two "
                     "effects on the predictions: 1 the same, 0 unrelated")
    for name, share in relation.redundant.items():
        lines.append(f"{quantities.plain(name)} is named above, but is redundant with this relation (without it "
                     f"{share:.1%} of the residual returns): it may only have represented the relation")
    return lines


def _files(relation: Relation, corrected: bool, folder: str) -> list[str]:
    """corrected: whether there are files of the result without the relation."""
    if relation.candidate.quantity == "run_time":
        return ["no effect file is written: a relation with the time in a run does not apply to other drives"]
    lines = [f"with the relation: the original vehicle file, proposed.yaml and effects/{name_of(relation)}.py. To "
             f"predict: --model {folder}/proposed.yaml --effects {folder}/effects of st evaluate, demo and export; "
             f"to search for further effects: --base {folder}/proposed.yaml --effects {folder}/effects of st discover; "
             f"to test the file: st effects check {folder}/effects/{name_of(relation)}.py"]
    if corrected:
        lines += ["without the relation: vehicle.yaml and model.yaml",
                  "do not combine proposed.yaml with vehicle.yaml (it is rejected): proposed.yaml itself contains the "
                  "corrections of the vehicle file, which would be applied twice"]
    return lines


def _errors_by_run(relation: Relation, discovery: Discovery) -> Table:
    first: Mapping[str, tuple[float, float]] = discovery.steps[0].runs if discovery.steps else {}
    start = discovery.steps[0].position_5s.base if discovery.steps else None
    errors = [(name, first[name][0] if name in first else None, *pair) for name, pair in sorted(
        relation.runs.items(), key=lambda item: item[1][1] - item[1][0])]
    rows = [(name, "-" if before is None else f"{before:.3f}", f"{without:.3f}", f"{with_it:.3f}",
             f"{with_it - without:+.3f} ({100.0 * (with_it / max(without, 1e-9) - 1.0):+.0f} %)".replace("-", "−"))
            for name, before, without, with_it in (*errors, ("all windows", start, *relation.position_5s))]
    return Table("Held-out mean position error after 5 s, by run, m",
                 "Every run is predicted with values fitted to other driving. Sorted by the change; + is a larger "
                 "error.",
                 ("run", discovery.start, "without the relation", "with the relation", "change"), rows)


def _values_with_and_without(relation: Relation, discovery: Discovery, vehicle: VehicleParameters) -> list[Table]:
    """Values of the effects fitted without and with the relation, each for its own files; empty without any."""
    if discovery.model is None:
        return []
    rows = []
    for effect in relation.model.effects:
        original, refitted = discovery.model.values.get(effect.name), relation.model.values[effect.name]
        free = [p for p in effect.parameters if p.fit]
        if original is None or all(refitted[p.name] == p.null == original[p.name] for p in free):
            continue
        cells = [quantities.plain(effect.name)]
        for values in (original, refitted):
            texts = (quantities.fitted(effect.name, {p.name: values[p.name] for p in free}),
                     report_text.format_changes(changed_keys(vehicle, effect, values)))
            cells.append("; ".join(filter(None, texts)))
        rows.append(tuple(cells))
    return [Table("Values without and with the relation",
                  "Two fits of the same car: with the relation, the values explain less of the errors. Without the "
                  "relation: the values above, for vehicle.yaml and model.yaml. With it: for proposed.yaml only. A "
                  "factor and the key after it are the same correction, starting from the value of the original "
                  "vehicle file.",
                  ("quantity", "without the relation", "with the relation"), rows)] if rows else []


def next_drive_sentences(relation: Relation) -> list[str]:
    """Manoeuvres that separate the relation from its alternatives, narrow its interval, and cover sparse ranges."""
    c, drives = relation.candidate, relation.drives
    if c.quantity in INDEPENDENT_OF_MANOEUVRE:
        return [ELSEWHERE]
    lines = []
    separating, precise = drives.most_separating(), drives.most_precise(relation.deviation)
    if separating is not None:
        option, rival = separating
        gain = option.separation[rival] / max(drives.current_separation[rival], 1e-9)
        lines.append(f"to separate it from {quantities.written_out(rival)}: {_manoeuvre(option)}. Their separation is "
                     f"then {gain:.1f} times as large")
    elif drives.current_separation:
        lines.append("no manoeuvre of the catalogue separates it much better from its alternatives: look for "
                     "the cause on the car itself")
    if len(drives.current_separation) < len(relation.others):
        lines.append(f"to separate it from effects of place, course or time: {ELSEWHERE}")
    if precise is not None:
        y_scale, unit = display_unit(c.unit)
        lines.append(f"for a narrower interval: {_manoeuvre(precise)}. The widest 95 % interval then falls from "
                     f"± {y_scale * report_text.Z95 * relation.deviation.max():.2g} to ± "
                     f"{y_scale * report_text.Z95 * precise.deviation.max():.2g} {unit}")
    return lines


def _ranges(relation: Relation, ranges: Sequence[tuple[float, float]]) -> str:
    x_scale, unit = display_unit(QUANTITIES[relation.candidate.quantity])
    return ", ".join(f"{x_scale * low:.2g} to {x_scale * high:.2g} {unit}" for low, high in ranges)


def _manoeuvre(option: Option) -> str:
    m = option.manoeuvre
    description = m.description.replace("^2", "²")
    return f"{m.name}, {REPETITIONS} times {m.duration:.0f} s ({description}, from {m.speed:.1f} m/s)"
