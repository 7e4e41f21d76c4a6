"""A proposed relation as an effect file and in the report of st discover."""

import math
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
from st_core.relations.candidates import ALL_TERMS, NO_PARITY, ODD, ODD_QUANTITIES, RELATIONS
from st_core.relations.next_drive import NextDrives, Option
from st_core.vehicle import VehicleParameters
from st_offline.discovery import quantities
from st_offline.discovery.discover_command import print_result
from st_offline.discovery.figures import draw_relation
from st_offline.discovery.relation_report import (
    RelationReport,
    build_relation_document,
    describe_next_drives,
    make_effect_code,
    name_effect,
    report_relation,
    write_files,
)
from st_offline.evaluation.drawing import FigureOutput
from support import LEAF

CAR = VehicleParameters.from_yaml(LEAF.read_text())
RANGE = {"slip_front": 0.1, "slip_rear": 0.1, "steering": 0.3, "acceleration_y": 6.0, "acceleration_x": 4.0,
         "speed": 20.0, "yaw_rate": 0.6, "steering_rate": 0.5, "lagging_steering": 0.3, "lean": 6.0, "north": 1.0,
         "east": 1.0, "position_x": 50.0, "position_y": 50.0, "run_time": 60.0}
CANDIDATES = [(place, quantity, ODD if quantity in ODD_QUANTITIES else NO_PARITY, by)
              for place, quantity, by in RELATIONS if quantity != "run_time"]


def make_relation(place: str, quantity: str, parity: float, by: str = "") -> Relation:
    high = RANGE[quantity]
    c = Candidate(place, quantity, parity, 2.0 if quantity == "speed" else -high, high, by)
    heights = np.linspace(-1.0, 2.0, 8)
    at = np.linspace(c.low, c.high, 41)
    return Relation(c, heights, at, heights @ c.compute_splines(at), 0.01 + 0.0 * at, 0.0 * at + 1 / 41, 0.1, 0.001,
                    (0.8, 0.5), {"lap": (0.8, 0.5)}, augment("nonlinear", {"mass": {"factor": 1.1}}),
                    {"side_force(speed)": 0.9},
                    (Formula("linear", "y = 2 u", 0.97, "a cause"),), redundant={"mass": 0.004})


registry = pytest.fixture(restored)
LAP = replace(drive(CAR, 10.0, lambda time: 0.05 * np.sin(time), seconds=5.0), name="lap")
DISCOVERY = discovery([LAP], [("mass", {"factor": 1.2}, 0.8)], 1.0)


def format_report(search: RelationSearch) -> str:
    return "\n".join(line for _, lines in report_relation(search, DISCOVERY, CAR, "out").groups for line in lines)


@pytest.mark.parametrize(("place", "quantity", "parity", "by"), CANDIDATES,
                         ids=[f"{p}-{q}-{b}" for p, q, _, b in CANDIDATES])
def test_effect_file_has_the_effect_of_the_fitted_curve(tmp_path, registry, place, quantity, parity, by):
    relation = make_relation(place, quantity, parity, by)
    (tmp_path / f"{name_effect(relation)}.py").write_text(make_effect_code(relation, ["lap"], "2026-01-01T00:00:00"))
    assert load_folder(str(tmp_path)) == (name_effect(relation),)
    written = augment("nonlinear", {name_effect(relation): {"share": 1.0}})
    heights = {f"c{k}": h for k, h in enumerate(relation.coefficients)}
    fitted = augment("nonlinear", {relation.candidate.effect: heights | relation.candidate.constants})
    state, readings = (0.0, 0.0, 12.0, -0.2, 0.1, 0.3), Measured(1.0, 2.0, 0.1, 12.0, 0.1, 0.3, 0.5, 3.6)
    changes = []
    for model in (MODELS["nonlinear"], written, fitted):
        p = model.parameters(CAR)
        w = model.inputs(0.05, 0.7, p)
        start = model.start_state(state, w, p)
        rates = model.rhs((*start[:6], *(0.5 * s for s in start[6:])), w, p)[:6]
        measured = model.observe(readings) if hasattr(model, "observe") else readings
        changes.append(np.array([*rates, *measured[:8]]))
    plain, by_file, by_curve = changes
    assert np.abs(by_curve - plain).max() > 1e-6
    assert by_file - plain == pytest.approx(by_curve - plain, rel=1e-4, abs=1e-5 * np.abs(by_curve - plain).max())


def test_relation_of_drives_without_positions_has_no_position_error():
    relation = make_relation("sensor_yaw_rate", "acceleration_y", ODD)
    relation = replace(relation, position_5s=(math.nan, math.nan), runs={})
    search = RelationSearch(relation, "it reduces the residual", {})
    report = report_relation(search, DISCOVERY, CAR, "out")
    figure = draw_relation(relation, FigureOutput(None, ()))
    assert "nan" not in str(report) + figure.title + make_effect_code(relation, ["lap"], "2026-01-01T00:00:00")


@pytest.mark.slow
@pytest.mark.parametrize(("place", "quantity", "parity", "by"), [
    ("front_steer", "lagging_steering", -1.0, ""), ("front_steer", "speed", 0.0, "steering_rate"),
    ("both_grip", "position_y", 0.0, ""), ("side_force", "north", 0.0, ""),
    ("sensor_yaw_rate", "acceleration_y", -1.0, "")])
def test_effect_file_meets_the_requirements_on_an_effect(tmp_path, registry, place, quantity, parity, by):
    relation = make_relation(place, quantity, parity, by)
    gentle = replace(relation, coefficients=0.3 * relation.coefficients)
    (tmp_path / f"{name_effect(relation)}.py").write_text(make_effect_code(gentle, ["lap"], "2026-01-01T00:00:00"))
    load_folder(str(tmp_path))
    assert not any(check_effect(EFFECTS[name_effect(relation)], CAR).values())


def test_curve_is_drawn_in_engineering_units():
    assert set(quantities.TERM_NAMES) == set(ALL_TERMS)
    assert [quantities.get_curve_unit(unit)[1] for unit in ("rad", "1", "m/s^2", "rad per rad/s")] == [
        "°", "%", "m/s²", "rad per rad/s"]
    assert quantities.get_curve_unit("1")[0] == 100.0 and quantities.get_curve_unit("rad")[0] == pytest.approx(57.2958)
    drawn = draw_relation(make_relation("front_grip", "speed", NO_PARITY), FigureOutput(None, ()))
    assert "0.800 m without it, 0.500 m with it" in drawn.title and "y in 1, u in m/s" in drawn.caption
    pushed = draw_relation(make_relation("yaw_moment", "acceleration_x", NO_PARITY), FigureOutput(None, ()))
    assert "y in rad/s², u in m/s². " in pushed.caption


def test_variation_between_runs_is_reported_and_relation_of_time_writes_no_file(tmp_path, registry):
    agreement = Agreement({"lap": (1.2, 0.1), "other": (0.1, 0.1), "third": (0.9, 0.5)}, 1e-6, 0.0)
    relation = replace(make_relation("both_grip", "run_time", 0.0), agreement=agreement)
    search = RelationSearch(relation, "it reduces the errors by 10 %", {})
    lines = format_report(search)
    sizes = "lap 1.2 ± 0.2, other 0.1 ± 0.2, third 0.9 ± 1.0"
    assert f"less than half the overall size in other (relative size by run, 95 %: {sizes})" in lines
    assert "no effect file is written" in lines and "once from a different starting point" in lines
    assert write_files(search, CAR, ["lap"], "2026-01-01", {}, tmp_path) == {} and not list(tmp_path.iterdir())


def test_written_files_and_report_describe_the_proposal(tmp_path, registry):
    relation = make_relation("rear_steer", "acceleration_y", -1.0)
    search = RelationSearch(relation, "it reduces the errors by 10 %", {"rear_steer(acceleration_y)": (0.1, 0.001)})
    files = write_files(search, CAR, ["lap"], "2026-01-01T00:00:00", {"lap": "0" * 64}, tmp_path)
    load_folder(str(files["effects"].parent))
    text = files["effects"].read_text()
    assert text.startswith('"""PROPOSAL') and "m/s^2" in text and "y = 2 u" in text and "lap" in text
    file = ModelFile.from_yaml(files["proposed.yaml"].read_text())
    assert set(file.effects) == {"mass", "proposed_rear_steer"} and "PROPOSAL" in file.provenance.note
    lines = format_report(search)
    assert "without the relation, 0.500 m with it; noise level 0.060 m" in lines
    assert "do not separate it from: additional side force on the body as a function of the speed (0.90)" in lines
    assert "mass is reported above, but is redundant given this relation (residual without the effect: +" in lines
    assert "widest interval at -6 m/s²: " in lines and "± 1.1 ° (95 %)" in lines
    assert "y = 2 u (linear; keeps 97 % of" in lines and "textbook causes: a cause. These" in lines
    assert "u: lateral acceleration (forward speed times yaw rate; positive to the left), m/s²" in lines
    assert "physics = \"y = curve of the lateral acceleration: additional steer angle of the rear wheels" in text
    content = build_relation_document(search)
    assert content["proposal"]["term"] == "rear_steer" and len(content["proposal"]["curve"]["points"]) == 41


def test_next_proposal_includes_the_effects_it_requires(tmp_path, registry):
    """A second relation at the same place, in addition to the first, loads from its own folder alone."""
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    second.mkdir()
    relation = make_relation("yaw_moment", "acceleration_x", NO_PARITY)
    write_files(RelationSearch(relation, "", {}), CAR, ["lap"], "2026-01-01T00:00:00", {}, first)
    load_folder(str(first / "effects"))
    found = ModelFile.from_yaml((first / "proposed.yaml").read_text()).model()
    after = replace(make_relation("yaw_moment", "speed", NO_PARITY), model=found)
    write_files(RelationSearch(after, "", {}), CAR, ["lap"], "2026-01-01T00:00:00", {}, second)
    code = ("import sys; from st_core.effects import load_folder; from st_core.model_file import ModelFile; "
            "load_folder(sys.argv[1] + '/effects'); "
            "print(*ModelFile.from_yaml(open(sys.argv[1] + '/proposed.yaml').read()).model().values)")
    process = subprocess.run([sys.executable, "-c", code, str(second)], capture_output=True, text=True, check=True)
    assert set(process.stdout.split()) == {"mass", "proposed_yaw_moment", "proposed_yaw_moment_2"}


def test_relation_is_searched_if_a_large_residual_remains():
    found = discovery([LAP], (), 1.0)
    explained, residual = replace(found, outcome="none", signature=()), ("errors are 4.0 times the noise",)
    assert not needs_search(explained)
    assert needs_search(replace(explained, outcome="unknown"))
    assert needs_search(replace(explained, outcome="named", signature=residual))


def test_reason_is_reported_without_a_proposal(tmp_path):
    search = RelationSearch(None, "no relation is significant", {})
    assert write_files(search, CAR, [], "", {}, tmp_path) == {} and not list(tmp_path.iterdir())
    groups = [("proposal", ["none: no relation is significant"])]
    assert report_relation(search, DISCOVERY, CAR, "out") == RelationReport(groups)
    search = RelationSearch(None, "the curve of side_force(speed) runs into its bound",
                            {"side_force(speed)": (0.1, 0.2)})
    reason = "the curve of additional side force on the body as a function of the speed runs into its bound"
    assert f"none: {reason}" in format_report(search)
    assert build_relation_document(search)["proposal"] is None


def test_terminal_reports_a_search_without_a_proposal(capsys):
    report = report_relation(RelationSearch(None, "no relation is significant", {}), DISCOVERY, CAR, "out")
    print_result(DISCOVERY, None, [], {}, False, report)
    assert "proposal: none: no relation is significant" in capsys.readouterr().out


def test_tables_list_errors_by_run_and_both_values_of_a_parameter():
    found = RelationSearch(make_relation("rear_steer", "acceleration_y", -1.0), "", {})
    by_run, values = report_relation(found, DISCOVERY, CAR, "out").tables
    assert by_run.rows == [("lap", "1.000", "0.800", "0.500", "−0.300 (−38 %)"),
                           ("all windows", "1.000", "0.800", "0.500", "−0.300 (−38 %)")]
    assert values.rows == [("mass", "× 1.20; mass 1590 → 1908 kg", "× 1.10; mass 1590 → 1749 kg")]


def test_files_are_listed_with_the_commands_that_use_them():
    lines = format_report(RelationSearch(make_relation("rear_steer", "acceleration_y", -1.0), "", {}))
    assert "st export with --model out/proposed.yaml --effects out/effects;" in lines
    assert "st effects check out/effects/proposed_rear_steer.py" in lines


def test_next_drives_are_recommended_with_their_gain():
    relation = make_relation("yaw_moment", "acceleration_x", NO_PARITY)
    brake, sweep = (next(m for m in CATALOGUE if m.name == name) for name in ("brake_in_turn", "sweep"))
    rival = "side_force(speed)"
    drives = NextDrives([(-3.0, -2.0), (1.0, 1.5)], {rival: 1.0},
                        [Option(brake, 0.5 * relation.deviation, {rival: 6.0}, (4.0, 0.0)),
                         Option(sweep, 0.8 * relation.deviation, {rival: 1.5}, (0.0, 0.1))])
    relation = replace(relation, next_drives=drives)
    text = format_report(RelationSearch(relation, "", {}))
    assert "y = 1 rad/s² corresponds to a moment of 2925 N m, with the yaw" in text
    text = "\n".join(describe_next_drives(relation))
    assert "from additional side force on the body as a function of the speed: brake_in_turn, 3 times" in text
    assert "separation is then 6.0 times as large" in text
    assert "for a narrower interval: brake_in_turn, 3 times" in text and "The widest 95 % interval shrinks" in text
    assert "from ± 0.02 to ± 0.0098 rad/s²" in text
    content = build_relation_document(RelationSearch(relation, "", {}))["proposal"]["next_drives"]
    assert content["most_separating"] == {"manoeuvre": "brake_in_turn", "rival": rival}
    assert content["most_precise"] == "brake_in_turn" and len(content["options"]) == 2
    weak = replace(relation, next_drives=replace(drives, options=drives.options[1:]))
    assert "no manoeuvre of the catalogue separates it much better from" in "\n".join(describe_next_drives(weak))
    option = Option(brake, 0.9 * relation.deviation, {}, (0.0, 0.0))
    imprecise = replace(relation, next_drives=replace(drives, options=[option]))
    assert "for a narrower interval" not in "\n".join(describe_next_drives(imprecise))
    without_options = replace(drives, current_separation={}, options=[])
    of_place = replace(relation, alternatives={"side_force(position_x)": 0.9}, next_drives=without_options)
    text = "\n".join(describe_next_drives(of_place))
    assert "from effects of place, heading or time: repeat the drive twice" in text and "much better" not in text


def test_run_with_much_larger_errors_is_in_the_first_line():
    runs = {"lap": (0.8, 0.5), "rain": (0.20, 0.26)}
    relation = replace(make_relation("rear_steer", "acceleration_y", -1.0), runs=runs)
    report = report_relation(RelationSearch(relation, "", {}), DISCOVERY, CAR, "out")
    assert "LARGER ERRORS, by 25 % or more, in rain (0.20 → 0.26 m)" in report.headline
    assert report.groups[0][1][0].startswith("LARGER ERRORS, by 25 % or more, in rain")
