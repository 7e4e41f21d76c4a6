"""The vehicle file that st discover corrects: it predicts as the model found does, and the rest is unchanged."""

from dataclasses import replace
from pathlib import Path

import pytest
from drives import weave, write_drive
from effect_values import values_of
from example_discovery import discovery
from experiment_tables import write_tables
from st_cli.cli import app
from st_core.augmented import augment
from st_core.discovery import DiscoverySettings
from st_core.effects import EFFECTS
from st_core.model_file import ModelFile
from st_core.prediction import PredictionSettings
from st_core.stability import slip_speed_needed
from st_core.vehicle import VehicleParameters, value_of
from st_offline.discovery.discovery_report import build_model_file
from st_offline.discovery.drives import Drive, Request, read_drive
from st_offline.discovery.report_text import recommend
from st_offline.discovery.vehicle_update import KEYS, edit_entries, fold_named_effects, update_vehicle
from st_recordings.car_skeleton import STABILITY_SPEEDS
from st_recordings.runs import ReadSettings, find_runs
from support import ROOT
from typer.testing import CliRunner

LEAF = ROOT / "config" / "vehicle" / "leaf.yaml"
TEXT = LEAF.read_text()
CAR = VehicleParameters.from_yaml(TEXT)
FOLDED = sorted(name for name, effect in EFFECTS.items() if effect.fold is not None)


@pytest.fixture(scope="module")
def driven(tmp_path_factory) -> Drive:
    """A drive whose steering wheel was recorded."""
    return recorded(tmp_path_factory.mktemp("drive"), 20.0)


def recorded(folder: Path, seconds: float) -> Drive:
    file = write_drive(folder / "weave.csv", weave(seconds))
    drive = read_drive(find_runs([file])[0], CAR, ReadSettings(), force=True)
    wheel = CAR.steering_wheel_angle(drive.log.road_wheel_angle)
    return replace(drive, log=replace(drive.log, steering_wheel_angle=wheel))


def request(drive: Drive, text: str = TEXT) -> Request:
    return Request("nonlinear", VehicleParameters.from_yaml(text), "leaf.yaml", text, DiscoverySettings(),
                   drives=[drive])


def corrected(drive: Drive, *effects: tuple[str, dict], text: str = TEXT):
    found = discovery([drive.log], [(name, values, 0.5) for name, values in effects], 1.0)
    return found, fold_named_effects(found, request(drive, text))


def test_file_that_predicts_worse_by_itself_is_not_written(driven):
    """The drive is of the car as in its file, without the halved mass."""
    found, folded = corrected(driven, ("mass", {"factor": 1.5}))
    assert folded.text and folded.error[1] > folded.error[0]
    written = update_vehicle(found, request(driven))
    assert not written.text and written.vehicle == CAR and written.model.values["mass"]["factor"] == 1.5
    assert written.error == folded.error


def test_file_that_improves_the_mean_but_one_drive_not_is_not_written(tmp_path):
    long = recorded(tmp_path, 90.0)
    _, folded = corrected(long, ("mass", {"factor": 1.5}))
    assert folded.worse == (long.log.name,)
    assert not replace(folded, error=(1.0, 0.5)).improves and replace(folded, error=(1.0, 0.5), worse=()).improves


def test_stiffer_tyres_raise_the_slip_speed_their_models_need(driven):
    _, one = corrected(driven, ("tyre_stiffness", {"factor": 2.0}))
    assert one.vehicle.minimum_slip_speed > CAR.minimum_slip_speed
    needed = slip_speed_needed(("linear", "nonlinear"), one.vehicle, STABILITY_SPEEDS, PredictionSettings().step)
    assert needed == one.vehicle.minimum_slip_speed


def test_a_model_that_is_stiffer_than_the_car_raises_the_slip_speed_of_the_file(driven):
    found = discovery([driven.log], [("steering_ratio", {"factor": 0.92}, 0.5)], 1.0)
    best = augment("nonlinear", {"steering_ratio": {"factor": 0.92}, "yaw_inertia": {"factor": 0.5}})
    one = fold_named_effects(replace(found, model=best, minor=found.effects), request(driven))
    assert one.vehicle.minimum_slip_speed > CAR.minimum_slip_speed and one.vehicle.yaw_inertia == CAR.yaw_inertia
    step = PredictionSettings().step
    assert slip_speed_needed((one.model,), one.vehicle, STABILITY_SPEEDS, step) == one.vehicle.minimum_slip_speed
    assert one.vehicle.sources["minimum_slip_speed"] == "stable with steps of 50 ms; before 3.0"
    assert f"for steering ratio; minimum_slip_speed 3 → {one.vehicle.minimum_slip_speed:.4g} m/s" in "".join(
        recommend(found, one))


def test_without_a_new_file_the_slip_speed_of_the_model_is_advised(driven):
    found = discovery([driven.log], [("mass", {"factor": 1.5}, 0.5)], 1.0)
    found = replace(found, model=augment("nonlinear", {"mass": {"factor": 1.5}, "yaw_inertia": {"factor": 0.4}}))
    one = update_vehicle(found, request(driven))
    assert not one.text and one.required_slip_speed > CAR.minimum_slip_speed
    assert f"minimum_slip_speed = {one.required_slip_speed:g} m/s" in "".join(recommend(found, one))
    mild = augment("nonlinear", {"mass": {"factor": 1.5}})
    assert update_vehicle(replace(found, model=mild), request(driven)).required_slip_speed == 0.0


def test_effective_corrections_stay_in_the_model_and_are_marked(driven):
    """The best model predicts the same with the updated file, which has the values with a physical meaning."""
    found = discovery([driven.log], [("mass", {"factor": 1.1}, 0.5)], 1.0)
    named, best = (augment("nonlinear", {"mass": {"factor": mass}, "friction": {"factor": friction}})
                   for mass, friction in ((1.1, 1.0), (1.2, 0.9)))
    found = replace(found, model=best, named=named, effective=found.effects)
    one = fold_named_effects(found, request(driven))
    assert one.vehicle.mass == pytest.approx(1.1 * CAR.mass) and one.model.values["friction"]["factor"] == 0.9
    assert one.model.values["mass"]["factor"] == pytest.approx(1.2 / 1.1)
    text = build_model_file(found, request(driven), one).to_yaml()
    assert text.count("effective: true") == 2
    assert ModelFile.from_yaml(text).effects["friction"]["factor"].effective


@pytest.mark.parametrize("name", FOLDED)
def test_the_file_holds_what_its_effect_would_do(driven, name):
    values = values_of(name, 0.8)
    found, one = corrected(driven, (name, values))
    assert one.folded == (name,) and not one.not_folded
    expected = EFFECTS[name].fold(CAR, EFFECTS[name].Theta(**values, constants=()))
    for key in KEYS:
        assert value_of(one.vehicle, key) == pytest.approx(value_of(expected, key), rel=1e-5, abs=1e-9), key
    for low, high in ((change[2], change[3]) for change in one.changes.values()):
        assert low <= high
    assert build_model_file(found, request(driven), one) is None


def test_only_the_lines_of_its_keys_change(driven):
    _, one = corrected(driven, ("steering_ratio", {"factor": 0.9}), ("mass", {"factor": 1.1}))
    lines = TEXT.splitlines()
    gone, new = set(lines) - set(one.text.splitlines()), [n for n in one.text.splitlines() if n not in lines]
    assert {line.partition(":")[0] for line in gone} == {"mass", "steering_ratio"}
    # The file leaves lambda_ky to be derived from the load; the effect keeps the tyre, so it is written there.
    assert [line.partition(":")[0] for line in new] == ["mass", "steering_ratio", "  lambda_ky", "  lambda_ky"]
    note = one.vehicle.provenance["steering_ratio"]
    assert note.uncertainty == pytest.approx(0.02 * 0.1 * 17.3 / 1.96, rel=0.02)
    assert note.method == "st discover" and note.data == "weave" and len(note.date) == 10
    source = one.vehicle.sources["steering_ratio"]
    assert source.startswith("st discover, 20") and "95 % interval 15.5" in source and source.endswith("before 17.3")


def test_the_unit_of_the_file_stays(driven):
    _, one = corrected(driven, ("steering_offset", {"angle": 0.005}))
    line = next(line for line in one.text.splitlines() if line.startswith("steering_wheel_offset"))
    assert 'unit: "deg"' in line
    assert one.vehicle.steering_wheel_offset == pytest.approx(CAR.steering_wheel_offset - 0.005 * 17.3, abs=1e-6)


def test_blocks_and_comments_of_the_user_stay(driven):
    line = next(line for line in TEXT.splitlines(True) if line.startswith("mass"))
    block = "mass:  # weighed\n  value: 1590.0  # by me\n  unit: kg\n  source: scales\n# the next one is a guess\n"
    text = TEXT.replace(line, block)
    _, one = corrected(driven, ("mass", {"factor": 1.1}), text=text)
    assert one.vehicle.mass == pytest.approx(1749.0) and "# weighed" in one.text
    assert "# the next one is a guess\nyaw_inertia" in one.text


def test_a_key_the_file_leaves_out_is_put_in():
    text = edit_entries(TEXT, {
        "tyre_front.lambda_muy": lambda unit, factor: f'{{value: 0.8, unit: "{unit}", source: "x"}}'})
    found = VehicleParameters.from_yaml(text)
    assert found.tyre_front.lambda_muy == 0.8 and replace(found, tyre_front=CAR.tyre_front) == CAR


def test_effects_that_a_file_cannot_express_are_a_model_of_the_corrected_car(driven, tmp_path):
    found, one = corrected(driven, ("steering_ratio", {"factor": 0.9}), ("yaw_rate_bias", {"bias": 0.004}))
    file = build_model_file(found, request(driven), one)
    assert set(file.effects) == {"yaw_rate_bias"} and file.vehicle_hash == one.vehicle.hash != CAR.hash
    assert file.effects["yaw_rate_bias"]["bias"].interval == pytest.approx((0.00392, 0.00408))
    assert ModelFile.from_yaml(file.to_yaml()).model().values["yaw_rate_bias"]["bias"] == 0.004
    # Whoever evaluates with the model file alone gets the car it is for.
    (tmp_path / "model.yaml").write_text(file.to_yaml())
    drive = write_drive(tmp_path / "weave.csv", weave(8.0))
    result = CliRunner().invoke(app, ["evaluate", str(drive), "--model", str(tmp_path / "model.yaml"), "--figures", "",
                                      "--output", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output


def test_recordings_of_the_road_wheels_keep_the_ratio_in_the_model(driven):
    """The ratio of a vehicle file does not affect them, so the model must."""
    bare = replace(driven, log=replace(driven.log, steering_wheel_angle=None))
    found, one = corrected(bare, ("steering_ratio", {"factor": 0.9}))
    assert not one.folded and one.text == "" and one.vehicle.hash == CAR.hash
    assert one.not_folded["steering_ratio"]["steering_ratio"] == pytest.approx((17.3, 15.57))
    assert set(build_model_file(found, request(bare), one).effects) == {"steering_ratio"}


def test_what_does_not_commute_stays_in_the_model(driven):
    """Play is measured after the ratio of the file: with another ratio the same play is another effect."""
    _, one = corrected(driven, ("steering_backlash", {"play": 0.02}), ("steering_ratio", {"factor": 0.6}))
    assert set(one.not_folded) == {"steering_ratio"} and not one.folded


def test_identify_starts_from_the_corrected_file_and_reports_contradictions(driven, tmp_path):
    _, one = corrected(driven, ("mass", {"factor": 1.1}), ("yaw_inertia", {"factor": 1.2}))
    (tmp_path / "vehicle.yaml").write_text(one.text)
    words = ["identify", "scales", write_tables(CAR, tmp_path / "tables", seed=2)["scales"], "--vehicle",
             tmp_path / "vehicle.yaml", "--output", tmp_path / "out"]
    result = CliRunner().invoke(app, [*map(str, words)], env={"COLUMNS": "200"})
    assert result.exit_code == 0 and "(st discover, 20" in result.output, result.output
    after = VehicleParameters.from_yaml((tmp_path / "out" / "vehicle.yaml").read_text())
    assert after.mass != one.vehicle.mass and after.yaw_inertia == one.vehicle.yaw_inertia
    assert after.provenance["yaw_inertia"] == one.vehicle.provenance["yaw_inertia"]
