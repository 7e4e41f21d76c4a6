"""A proposed law as an effect file: it loads, does what the curve does, and says where it comes from."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from driven import drive
from effect_registry import restored
from example_discovery import discovery
from st_core.augmented import augment
from st_core.contract import check_effect
from st_core.discovery.evidence import Agreement
from st_core.effects import EFFECTS, Measured, load_folder
from st_core.manoeuvres import CATALOGUE
from st_core.model_file import ModelFile
from st_core.models import MODELS
from st_core.relations import Candidate, Formula, Relation, RelationSearch, needs_search
from st_core.relations.candidates import ADMISSIBLE, NEITHER, PAIRS
from st_core.relations.next_drive import NextDrives, Option
from st_core.vehicle import VehicleParameters
from st_offline.discovery import quantities
from st_offline.discovery.figures import curve_unit, draw_relation
from st_offline.discovery.relation_files import build_relation_document, effect_name, effect_source, write_files
from st_offline.discovery.relation_report import (
    RelationReport,
    describe_next_drives,
    report_relation,
)
from st_offline.evaluation.drawing import FigureOutput
from support import ROOT

CAR = VehicleParameters.from_yaml((ROOT / "config" / "vehicle" / "leaf.yaml").read_text())
RANGE = {"slip_front": 0.1, "slip_rear": 0.1, "steering": 0.3, "acceleration_y": 6.0, "acceleration_x": 4.0,
         "speed": 20.0, "yaw_rate": 0.6, "steering_rate": 0.5, "lagging_steering": 0.3, "lean": 6.0, "north": 1.0,
         "east": 1.0, "position_x": 50.0, "position_y": 50.0, "run_time": 60.0}
EVERY = [(place, quantity, parity, "") for place, quantities in ADMISSIBLE.items() for quantity, parity in quantities
         if quantity != "run_time"] + [(place, quantity, NEITHER, by) for place, quantity, by in PAIRS]


def proposal(place: str, quantity: str, parity: float, by: str = "") -> Relation:
    high = RANGE[quantity]
    c = Candidate(place, quantity, parity, 2.0 if quantity == "speed" else -high, high, by)
    heights = np.linspace(-1.0, 2.0, 8)
    at = np.linspace(c.low, c.high, 41)
    return Relation(c, heights, at, heights @ c.compute_splines(at), 0.01 + 0.0 * at, 0.0 * at + 1 / 41, 0.1, 0.001,
                    (0.8, 0.5), {"lap": (0.8, 0.5)}, augment("nonlinear", {"mass": {"factor": 1.1}}),
                    {"side_force over speed": 0.9},
                    (Formula("linear", "y = 2 u", 0.97, "a cause"),), redundant={"mass": 0.004})


registry = pytest.fixture(restored)
LAP = replace(drive(CAR, 10.0, lambda time: 0.05 * np.sin(time), seconds=5.0), name="lap")
ANSWER = discovery([LAP], [("mass", {"factor": 1.2}, 0.8)], 1.0)


def text_of(said: RelationSearch) -> str:
    return "\n".join(line for _, lines in report_relation(said, ANSWER, CAR, "out").groups for line in lines)


@pytest.mark.parametrize(("place", "quantity", "parity", "by"), EVERY, ids=[f"{p}-{q}-{b}" for p, q, _, b in EVERY])
def test_the_file_does_what_the_curve_does(tmp_path, registry, place, quantity, parity, by):
    one = proposal(place, quantity, parity, by)
    (tmp_path / "law.py").write_text(effect_source(one, ["lap"], "2026-01-01T00:00:00"))
    assert load_folder(str(tmp_path)) == (effect_name(one),)
    written = augment("nonlinear", {effect_name(one): {"share": 1.0}})
    heights = {f"c{k}": h for k, h in enumerate(one.coefficients)}
    fitted = augment("nonlinear", {one.candidate.effect: heights | one.candidate.constants})
    state, readings = (0.0, 0.0, 12.0, -0.2, 0.1, 0.3), Measured(1.0, 2.0, 0.1, 12.0, 0.1, 0.3, 0.5, 3.6)
    changes = []
    for model in (MODELS["nonlinear"], written, fitted):
        p = model.parameters(CAR)
        w = model.inputs(0.05, 0.7, p)
        start = model.start_state(state, w, p)
        rates = model.rhs((*start[:6], *(0.5 * s for s in start[6:])), w, p)[:6]
        seen = model.observe(readings) if hasattr(model, "observe") else readings
        changes.append(np.array([*rates, *seen[:8]]))
    plain, by_file, by_curve = changes
    assert np.abs(by_curve - plain).max() > 1e-6
    assert by_file - plain == pytest.approx(by_curve - plain, rel=0.05, abs=0.02 * np.abs(by_curve - plain).max())


@pytest.mark.parametrize(("place", "quantity", "parity", "by"), [
    ("front_steer", "lagging_steering", -1.0, ""), ("front_steer", "speed", 0.0, "steering_rate"),
    ("both_grip", "position_y", 0.0, ""), ("front_steer", "speed", 0.0, ""), ("side_force", "north", 0.0, ""),
    ("sensor_yaw_rate", "acceleration_y", -1.0, "")])
def test_the_file_meets_the_requirements_on_an_effect(tmp_path, registry, place, quantity, parity, by):
    one = proposal(place, quantity, parity, by)
    gentle = replace(one, coefficients=0.3 * one.coefficients)
    (tmp_path / "law.py").write_text(effect_source(gentle, ["lap"], "2026-01-01T00:00:00"))
    load_folder(str(tmp_path))
    assert not any(check_effect(EFFECTS[effect_name(one)], CAR).values())


def test_the_curve_is_drawn_in_the_units_of_an_engineer():
    assert set(quantities.TERM_NAMES) == set(ADMISSIBLE)
    assert [curve_unit(unit)[1] for unit in ("rad", "1", "m/s^2", "rad per rad/s")] == [
        "°", "%", "m/s²", "rad per rad/s"]
    assert curve_unit("1")[0] == 100.0 and curve_unit("rad")[0] == pytest.approx(57.2958)
    drawn = draw_relation(proposal("front_grip", "speed", NEITHER), FigureOutput(None, ()))
    assert "0.800 m without it, 0.500 m with it" in drawn.title and "y in 1, u in m/s" in drawn.caption
    pushed = draw_relation(proposal("yaw_moment", "acceleration_x", NEITHER), FigureOutput(None, ()))
    assert "y in rad/s², u in m/s². " in pushed.caption


def test_what_comes_and_goes_is_told_and_a_law_of_time_is_no_file(tmp_path, registry):
    shares = Agreement({"lap": (1.2, 0.1), "other": (0.1, 0.1), "third": (0.9, 0.5)}, 1e-6, 0.0)
    one = replace(proposal("both_grip", "run_time", 0.0), shares=shares)
    said = RelationSearch(one, "it takes away 10 %", {})
    lines = text_of(said)
    sizes = "lap 1.2 ± 0.2, other 0.1 ± 0.2, third 0.9 ± 1.0"
    assert f"nearly absent in other (relative size by run, 95 %: {sizes})" in lines
    assert "no effect file is written" in lines and "once from another starting point" in lines
    assert write_files(said, CAR, ["lap"], "2026-01-01", {}, tmp_path) == {} and not list(tmp_path.iterdir())


def test_what_is_written_says_what_it_is(tmp_path, registry):
    one = proposal("rear_steer", "acceleration_y", -1.0)
    said = RelationSearch(one, "it takes away 10 %", {"rear_steer over acceleration_y": (0.1, 0.001)})
    files = write_files(said, CAR, ["lap"], "2026-01-01T00:00:00", {"lap": "0" * 64}, tmp_path)
    load_folder(str(files["effects"].parent))
    text = files["effects"].read_text()
    assert text.startswith('"""PROPOSAL') and "m/s^2" in text and "y = 2 u" in text and "lap" in text
    file = ModelFile.from_yaml(files["proposed.yaml"].read_text())
    assert set(file.effects) == {"mass", "proposed_rear_steer"} and "PROPOSAL" in file.provenance.note
    lines = text_of(said)
    assert "without the relation, 0.500 m with it; noise floor 0.060 m" in lines
    assert "do not separate it from: side force on the body as a function of the speed (0.90)" in lines
    assert "mass is named above, but is redundant with this relation (without it, the residual increases" in lines
    assert "1 of 1 runs" in lines
    assert "widest interval at -6 m/s²: " in lines and "± 1.1 ° (95 %)" in lines
    assert "y = 2 u (linear; keeps 97% of" in lines and "textbook causes: a cause. These" in lines
    assert "u: lateral acceleration (left +), m/s²" in lines
    content = build_relation_document(said)
    assert content["proposal"]["place"] == "rear_steer" and len(content["proposal"]["curve"]["at"]) == 41


def test_the_next_answer_brings_the_effects_it_needs(tmp_path, registry):
    """A second law at the same place, on top of the first: another process loads it from its own folder alone."""
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    second.mkdir()
    one = proposal("yaw_moment", "acceleration_x", NEITHER)
    write_files(RelationSearch(one, "", {}), CAR, ["lap"], "2026-01-01T00:00:00", {}, first)
    load_folder(str(first / "effects"))
    found = ModelFile.from_yaml((first / "proposed.yaml").read_text()).model()
    after = replace(proposal("yaw_moment", "speed", NEITHER), model=found)
    write_files(RelationSearch(after, "", {}), CAR, ["lap"], "2026-01-01T00:00:00", {}, second)
    loads = ("import sys; from st_core.effects import load_folder; from st_core.model_file import ModelFile; "
             "load_folder(sys.argv[1] + '/effects'); "
             "print(*ModelFile.from_yaml(open(sys.argv[1] + '/proposed.yaml').read()).model().values)")
    done = subprocess.run([sys.executable, "-c", loads, str(second)], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == {"mass", "proposed_yaw_moment", "proposed_yaw_moment_2"}


def test_a_law_is_looked_for_where_much_is_left():
    found = discovery([LAP], (), 1.0)
    nothing, much = replace(found, outcome="none", signature=()), ("errors are 4.0 times the noise",)
    assert not needs_search(nothing)
    assert needs_search(replace(nothing, outcome="unknown"))
    assert needs_search(replace(nothing, outcome="named", signature=much))


def test_without_a_proposal_the_reason_is_told(tmp_path):
    said = RelationSearch(None, "no relation is significant", {})
    assert write_files(said, CAR, [], "", {}, tmp_path) == {} and not list(tmp_path.iterdir())
    groups = [("proposal", ["none: no relation is significant"])]
    assert report_relation(said, ANSWER, CAR, "out") == RelationReport(groups)
    said = RelationSearch(None, "the curve of side_force over speed runs into its bound",
                          {"side_force over speed": (0.1, 0.2)})
    assert "none: the curve of side force on the body as a function of the speed runs into its bound" in text_of(said)
    assert build_relation_document(said)["proposal"] is None


def test_the_error_of_every_run_and_both_sizes_of_a_value_are_tabled():
    found = RelationSearch(proposal("rear_steer", "acceleration_y", -1.0), "", {})
    by_run, values = report_relation(found, ANSWER, CAR, "out").tables
    assert by_run.rows == [("lap", "1.000", "0.800", "0.500", "−0.300 (−38 %)"),
                           ("all windows", "1.000", "0.800", "0.500", "−0.300 (−38 %)")]
    assert values.rows == [("mass", "× 1.20; mass 1590 → 1908 kg", "× 1.10; mass 1590 → 1749 kg")]


def test_the_files_are_named_with_the_options_that_take_them():
    lines = text_of(RelationSearch(proposal("rear_steer", "acceleration_y", -1.0), "", {}))
    assert "st export --model out/proposed.yaml --effects out/effects;" in lines
    assert "st effects check out/effects/proposed_rear_steer.py" in lines


def test_what_to_drive_next_is_said_with_what_it_brings():
    one = proposal("yaw_moment", "acceleration_x", NEITHER)
    brake, sweep = (next(m for m in CATALOGUE if m.name == name) for name in ("brake_in_turn", "sweep"))
    rival = "side_force over speed"
    drives = NextDrives([(-3.0, -2.0), (1.0, 1.5)], {rival: 1.0},
                        [Option(brake, 0.5 * one.deviation, {rival: 6.0}, (4.0, 0.0)),
                         Option(sweep, 0.8 * one.deviation, {rival: 1.5}, (0.0, 0.1))])
    one = replace(one, next_drives=drives)
    assert "y = 1 rad/s² corresponds to a moment of 2925 N m, with the yaw" in text_of(RelationSearch(one, "", {}))
    text = "\n".join(describe_next_drives(one))
    assert "from side force on the body as a function of the speed: brake_in_turn, 3 times" in text
    assert "separation is then 6.0 times as large" in text
    assert "for a narrower interval: brake_in_turn, 3 times" in text and "The widest 95 % interval shrinks" in text
    assert "from ± 0.02 to ± 0.0098 rad/s²" in text
    content = build_relation_document(RelationSearch(one, "", {}))["proposal"]["next_drives"]
    assert content["most_separating"] == {"manoeuvre": "brake_in_turn", "from": rival}
    assert content["most_precise"] == "brake_in_turn" and len(content["options"]) == 2
    weak = replace(one, next_drives=replace(drives, options=drives.options[1:]))
    assert "no manoeuvre of the catalogue separates it much better from" in "\n".join(describe_next_drives(weak))
    hardly = replace(one, next_drives=replace(drives, options=[Option(brake, 0.9 * one.deviation, {}, (0.0, 0.0))]))
    assert "for a narrower interval" not in "\n".join(describe_next_drives(hardly))
    without_options = replace(drives, current_separation={}, options=[])
    of_a_place = replace(one, others={"side_force over position_x": 0.9}, next_drives=without_options)
    text = "\n".join(describe_next_drives(of_a_place))
    assert "from effects of place, heading or time: repeat the drive twice" in text and "much better" not in text


def test_a_run_that_becomes_much_worse_is_in_the_first_line():
    one = replace(proposal("rear_steer", "acceleration_y", -1.0), runs={"lap": (0.8, 0.5), "rain": (0.20, 0.26)})
    report = report_relation(RelationSearch(one, "", {}), ANSWER, CAR, "out")
    assert "ERRORS LARGER by 25 % or more in rain (0.20 → 0.26 m)" in report.headline
    assert report.groups[0][1][0].startswith("ERRORS LARGER by 25 % or more in rain")
