"""A proposed law beside the results of a discovery: files, the part of discovery.json, sentences."""

from collections.abc import Sequence
from pathlib import Path

from st_core.effects import load_folder
from st_core.model_file import Estimate, ModelFile, Provenance
from st_core.proposals import Proposal, Proposals
from st_core.proposals.places import QUANTITIES
from st_core.vehicle import VehicleParameters

from . import law_words, words
from .law_figure import shown
from .law_file import effect_file, law_in_words, name_of, title

DIFFER = 0.01  # chance below which runs do not show the same law


def write(found: Proposals, vehicle: VehicleParameters, runs: Sequence[str], created: str, digests: dict[str, str],
          folder: Path) -> dict[str, Path]:
    """The effect file and the model file that uses it, by what they are; nothing without a proposal, and nothing for a
    law of the time in the run, which is not known of a drive to come."""
    one = found.proposal
    if one is None or one.candidate.quantity == "run_time":
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
    tried = [{"law": name, "gain": gain, "chance": chance, "visible": found.visible.get(name)}
             for name, (gain, chance) in found.tried.items()]
    if one is None:
        return {"proposal": None, "why": found.why, "tried": tried}
    c = one.candidate
    return {"why": found.why, "tried": tried, "proposal": {
        "place": c.place, "quantity": c.quantity, "by": c.by, "unit": c.unit, "quantity_unit": QUANTITIES[c.quantity],
        "range": [c.low, c.high], "curve": {"at": one.at.tolist(), "value": one.value.tolist(),
                                            "deviation": one.deviation.tolist(), "density": one.density.tolist()},
        "gain": one.gain, "chance": one.chance, "position_5s": list(one.position_5s),
        "runs": {name: list(pair) for name, pair in one.runs.items()}, "others": dict(one.others),
        "needless": dict(one.needless),
        "shares": {name: list(pair) for name, pair in one.shares.by_run.items()}, "differ": one.shares.differ,
        "readings": [{"shape": r.shape, "text": r.text, "explained": r.explained, "causes": r.causes}
                     for r in one.readings]}}


def told(found: Proposals) -> list[str]:
    """Lines for terminal and page."""
    one = found.proposal
    unseen = found.unseen()
    places = ", ".join(law_words.PLACES[name] for name in unseen)
    less = [f"these drives hardly show {places}: nothing is said of laws there"] if unseen else []
    if one is None:
        return [f"nothing is proposed: {found.why}", *less]
    return [*_what(one, found.why), *_doubts(one), *less]


def _what(one: Proposal, why: str) -> list[str]:
    """The law, what it is worth, and its curve as formulas."""
    c = one.candidate
    quantity, unit = law_words.quantity(c), QUANTITIES[c.quantity]
    without, with_it = one.position_5s
    lines = [f"PROPOSAL, not yet a finding: {law_in_words(one)}",
             f"position error after 5 s, on runs it was not fitted to: {without:.3f} m with what is stated above, "
             f"{with_it:.3f} m with the law as well; {why}"]
    causes = one.readings[0].causes if one.readings else ""
    if causes:
        lines.append(f"causes that textbooks name, which is no result of these drives: {causes}")
    lines += [f"{'or' if k else 'as a formula:'} {r.text} ({law_words.SHAPES.get(r.shape, r.shape)}; "
              f"{r.explained:.0%} of what the curve explains)"
              for k, r in enumerate(one.readings)]
    squares = str.maketrans({"^": None, "2": "²"})
    lines.append(f"y: {law_words.axis(c)} [{c.unit.translate(squares)}]; u: {quantity} [{unit.translate(squares)}], "
                 f"driven from {c.low:.3g} to {c.high:.3g}, the curve is constant beyond")
    least = int(one.deviation.argmax())
    (up, shown_up), (across, shown_across) = shown(c.unit), shown(unit)
    lines.append(f"least sure at {quantity} {across * one.at[least]:.3g} {shown_across}: {up * one.value[least]:.2g} ± "
                 f"{up * words.SURE * one.deviation[least]:.2g} {shown_up} (95 %); driving there would pin it down")
    return lines


def _doubts(one: Proposal) -> list[str]:
    """What else it may be, where it is not, and how to try it."""
    lines = []
    if one.others:
        names = "; ".join(f"{law_words.named(name)} ({cosine:.2f})" for name, cosine in one.others.items())
        lines.append(f"these drives do not tell it from: {names}. In brackets how alike what they change is: 1 the "
                     "same, 0 nothing in common")
    for name, share in one.needless.items():
        lines.append(f"{name} is stated above, but with this law it has little left to do (without it {share:.1%} of "
                     "the size of the errors comes back): it may have stood in for this law")
    absent = one.shares.absent() if one.shares.differ < DIFFER else []
    if absent:
        told_of = ", ".join(f"{name} {share:.1f} ± {words.SURE * deviation:.1f}" for name, (share, deviation) in
                            one.shares.by_run.items())
        lines.append(f"it comes and goes: hardly there in {', '.join(absent)} (share of it by run, 95 %: {told_of})")
    if one.candidate.quantity != "run_time":
        lines.append("to try it: st demo, st live or st evaluate with --model proposed.yaml, --effects effects and the "
                     "vehicle file that was given here, not vehicle.yaml: proposed.yaml holds what is stated above, "
                     "fitted anew beside the law. Keep its files or delete them")
    else:
        lines.append("no effect file is written: the time in the run is not known of a drive to come")
    worse = [name for name, (before, after) in one.runs.items() if after > before]
    lines.append(f"it helps in {len(one.runs) - len(worse)} of {len(one.runs)} runs"
                 + (f", not in {', '.join(worse)}" if worse else ""))
    return lines
