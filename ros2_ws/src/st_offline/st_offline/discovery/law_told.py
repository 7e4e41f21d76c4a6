"""What is said of a law beyond the library: sentences, tables and commands, alike in the terminal and on the page."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass

from st_core.discovery import Discovery
from st_core.proposals import Proposal, Proposals
from st_core.proposals.places import ODD, QUANTITIES
from st_core.vehicle import VehicleParameters

from . import law_words, next_drive_words, quantities, report_text
from .law_figure import shown
from .law_file import law_in_words, name_of
from .law_tables import Table, by_run, values_beside

DIFFER = 0.01  # chance below which runs do not show the same law
SQUARES = str.maketrans({"^": None, "2": "²"})
Groups = list[tuple[str, list[str]]]


@dataclass(frozen=True)
class Told:
    """groups: (question, sentences). commands: (what for, command), to be copied as they are. headline: the proposal in
    a line, "" without one."""

    groups: Groups
    tables: Sequence[Table] = ()
    commands: Sequence[tuple[str, str]] = ()
    headline: str = ""


@dataclass(frozen=True)
class Start:
    """How the discovery was started. runs, options: words of the command line; options say whose the recordings are.
    vehicle: the part of them that every verb takes. folder: of the results."""

    runs: Sequence[str]
    options: Sequence[str]
    vehicle: Sequence[str]
    folder: str


def told(found: Proposals, answer: Discovery, vehicle: VehicleParameters, start: Start) -> Told:
    one = found.proposal
    unseen = ", ".join(law_words.PLACES[name] for name in found.unseen())
    less: Groups = [("not excluded", [f"a law of these; the drives could not show it: {unseen}"])] if unseen else []
    if one is None:
        return Told([("proposal", [f"none: {law_words.in_words(found.why, found.tried)}"]), *less])
    groups: Groups = [("proposal", _proposal(one)), ("worth", _worth(one, answer, found.why)),
                      ("formula", _formula(one, vehicle)), ("how sure is the curve", _sure(one)),
                      ("or instead", _doubts(one)), ("next drive for it", next_drive_words.sentences(one)), *less,
                      ("files", _files(one, answer.model is not None))]
    filled = [(question, lines) for question, lines in groups if lines]
    tables = [by_run(one, answer), *values_beside(one, answer, vehicle)]
    return Told(filled, tables, _commands(one, start), _headline(one))


def _headline(one: Proposal) -> str:
    without, with_it = one.position_5s
    return f"PROPOSAL, no finding yet: {law_in_words(one)}; {without:.2f} m → {with_it:.2f} m (held-out)"


def _proposal(one: Proposal) -> list[str]:
    causes = one.readings[0].causes if one.readings else ""
    return [f"{law_in_words(one)}. A proposal is no finding yet: try it, then keep or delete it",
            *([f"in textbooks it is caused by: {causes}. These drives do not show the cause"] if causes else [])]


def _worth(one: Proposal, answer: Discovery, why: str) -> list[str]:
    without, with_it = one.position_5s
    worse = [name for name, (before, after) in one.runs.items() if after >= before]
    but = f", not in {', '.join(worse)}" if worse else ""
    noise = f"; noise alone leaves {answer.gap['position_5s'].floor:.3f} m" if "position_5s" in answer.gap else ""
    return [f"mean position error after 5 s, on driving it was not fitted to: {without:.3f} m with what is stated "
            f"above, {with_it:.3f} m with the law as well{noise}", why,
            f"it helps in {len(one.runs) - len(worse)} of {len(one.runs)} runs{but}"]


def _formula(one: Proposal, vehicle: VehicleParameters) -> list[str]:
    c = one.candidate
    lines = [f"{'or ' if k else ''}{r.text.replace('^2', '²').replace('^3', '³')} "
             f"({law_words.SHAPES.get(r.shape, r.shape)}; has {r.explained:.0%} of the effect of the curve)"
             for k, r in enumerate(one.readings)] or ["no simple formula fits the curve"]
    return [*lines, f"y: {law_words.axis(c)}, {c.unit.translate(SQUARES)}; u: {law_words.quantity(c)}"
            f"{law_words.SIGNS.get(c.quantity, '')}, {QUANTITIES[c.quantity].translate(SQUARES)}",
            *filter(None, [law_words.in_newtons(c, vehicle)])]


def _sure(one: Proposal) -> list[str]:
    """The curve where it is least sure, and what was hardly driven."""
    c, least = one.candidate, int(one.deviation.argmax())
    (up, unit), (across, across_unit) = shown(c.unit), shown(QUANTITIES[c.quantity])
    lines = [f"driven: {law_words.quantity(c)} from {across * c.low:.3g} to {across * c.high:.3g} {across_unit}; "
             "beyond, the curve stays as it is at the end",
             f"least sure at {across * one.at[least]:.3g} {across_unit}: {up * one.value[least]:.2g} ± "
             f"{up * report_text.SURE * one.deviation[least]:.2g} {unit} (95 %)"]
    if one.drives.thin:
        mirrored = ", to either side" if c.parity == ODD else ""
        lines.append(f"hardly driven: {next_drive_words.ranges(one, one.drives.thin)}{mirrored}. There the curve is a "
                     "smooth bridge, and its interval holds only if the true law is as smooth")
    absent = one.shares.absent() if one.shares.differ < DIFFER else []
    if absent:
        told_of = ", ".join(f"{name} {share:.1f} ± {report_text.SURE * deviation:.1f}" for name, (share, deviation) in
                            one.shares.by_run.items())
        lines.append(f"it comes and goes: hardly there in {', '.join(absent)} (share of it by run, 95 %: {told_of})")
    return lines


def _doubts(one: Proposal) -> list[str]:
    """What else it may be."""
    lines = []
    if one.others:
        names = "; ".join(f"{law_words.named(name)} ({cosine:.2f})" for name, cosine in one.others.items())
        lines.append(f"these drives do not tell it from: {names}. In brackets, how alike the changes of the two are: "
                     "1 the same, 0 nothing in common")
    for name, share in one.needless.items():
        lines.append(f"{quantities.plain(name)} is stated above, but with this law it has little left to do (without "
                     f"it {share:.1%} of the size of the errors comes back): it may have stood in for this law")
    return lines


def _files(one: Proposal, corrected: bool) -> list[str]:
    """corrected: whether there is an answer without the law, too."""
    if one.candidate.quantity == "run_time":
        return ["no effect file is written, because the time in a run says nothing of a future drive"]
    lines = [f"predict with the law: the vehicle file that was given, proposed.yaml and effects/{name_of(one)}.py"]
    if corrected:
        lines += ["predict without the law: vehicle.yaml and model.yaml",
                  "never proposed.yaml with vehicle.yaml: it holds the corrections of the vehicle file itself, fitted "
                  "anew beside the law, and they would count twice; it is refused"]
    return lines


def _commands(one: Proposal, start: Start) -> list[tuple[str, str]]:
    if one.candidate.quantity == "run_time":
        return []
    folder = start.folder
    model = [f"{folder}/proposed.yaml", "--effects", f"{folder}/effects"]
    listed = [
        ("test the file", ["effects", "check", f"{folder}/effects/{name_of(one)}.py", *start.vehicle]),
        ("predict drives with it",
         ["evaluate", *start.runs, *start.options, "--model", "nonlinear", "--model", *model]),
        ("for a controller, once another drive has confirmed it", ["export", *model, *start.vehicle]),
        ("search for more", ["discover", *start.runs, *start.options, "--base", *model]),
        *(("see a next drive", ["demo", "--scenario", name]) for name in next_drive_words.named(one))]
    return [(what, shlex.join(["./st", *command])) for what, command in listed] + [
        ("delete it", shlex.join(["rm", f"{folder}/effects/{name_of(one)}.py", f"{folder}/proposed.yaml"]))]
