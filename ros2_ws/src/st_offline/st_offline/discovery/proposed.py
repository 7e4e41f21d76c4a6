"""A proposed law beside the results of a discovery: files, and the part of discovery.json."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from st_core.discovery.following import TIMES
from st_core.effects import Effect, load_file, source_file
from st_core.model_file import Estimate, ModelFile, Provenance
from st_core.proposals import Proposal, Proposals
from st_core.proposals.places import QUANTITIES
from st_core.vehicle import VehicleParameters

from .law_file import effect_file, name_of, title

LIBRARY = Path(source_file(Effect)).parent


def write(found: Proposals, vehicle: VehicleParameters, runs: Sequence[str], created: str, digests: dict[str, str],
          folder: Path) -> dict[str, Path]:
    """The effect file and the model file that uses it, by what they are; nothing without a proposal, and nothing for a
    law of the time in the run, which is not known of a drive to come. Effects of the user that the model has go along:
    one folder of effects is enough for every command."""
    one = found.proposal
    if one is None or one.candidate.quantity == "run_time":
        return {}
    effects = folder / "effects"
    effects.mkdir()
    file = effects / f"{name_of(one)}.py"
    file.write_text(effect_file(one, runs, created), encoding="utf-8")
    load_file(str(effects.absolute()), name_of(one))
    for folder_of_theirs in {Path(source_file(e)).parent for e in one.model.effects} - {LIBRARY}:
        for module in folder_of_theirs.glob("*.py"):
            if not (effects / module.name).exists():
                shutil.copyfile(module, effects / module.name)
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
        "needless": dict(one.needless), "next_drives": _drives(one),
        "shares": {name: list(pair) for name, pair in one.shares.by_run.items()}, "differ": one.shares.differ,
        "readings": [{"shape": r.shape, "text": r.text, "explained": r.explained, "causes": r.causes}
                     for r in one.readings]}}


def _drives(one: Proposal) -> dict:
    drives, apart = one.drives, one.drives.tells_apart()
    surest = drives.pins_down(one.deviation)
    return {"thin": [list(between) for between in drives.thin],
            "tells_apart": {"manoeuvre": apart[0].manoeuvre.name, "from": apart[1]} if apart else None,
            "pins_down": surest.manoeuvre.name if surest else None, "apart_now": dict(drives.now), "options": [
                {"manoeuvre": o.manoeuvre.name, "speed": o.manoeuvre.speed, "lateral": o.manoeuvre.lateral,
                 "duration": o.manoeuvre.duration, "times": TIMES, "largest_deviation": float(o.deviation.max()),
                 "apart": dict(o.apart), "seconds_in_thin": list(o.seconds)} for o in drives.options]}
