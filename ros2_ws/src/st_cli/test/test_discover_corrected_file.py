"""The vehicle file that st discover updates: its predictions equal those of the model, other entries are unchanged."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import st
from drives import weave, write_drive
from effect_values import values_of
from example_discovery import discovery
from experiment_tables import write_tables
from st_core.augmented import augment
from st_core.discovery import DiscoverySettings
from st_core.effects import EFFECTS
from st_core.integrate import required_slip_speed
from st_core.model_file import ModelFile
from st_core.prediction import PredictionSettings
from st_core.vehicle import FILE_QUANTITIES, VehicleParameters, value_of
from st_offline.discovery.discover_command import build_model_file, write_results
from st_offline.discovery.drives import Drive, Request, read_drive
from st_offline.discovery.report_text import recommend
from st_offline.discovery.vehicle_update import edit_vehicle_text, fold_named_effects, update_vehicle
from st_recordings.car import STABILITY_SPEEDS
from st_recordings.runs import ReadSettings, find_runs
from support import LEAF

TEXT = LEAF.read_text()
CAR = VehicleParameters.from_yaml(TEXT)
FOLDED = sorted(name for name, effect in EFFECTS.items() if effect.fold is not None)


@pytest.fixture(scope="module")
def recorded_drive(tmp_path_factory) -> Drive:
    """A drive of 20 s with a recorded steering wheel angle."""
    return record_drive(tmp_path_factory.mktemp("drive"), 20.0)


def record_drive(folder: Path, seconds: float) -> Drive:
    file = write_drive(folder / "weave.csv", weave(seconds))
    drive = read_drive(find_runs([file])[0], CAR, ReadSettings(), force=True)
    wheel = CAR.steering_wheel_angle(drive.log.road_wheel_angle)
    return replace(drive, log=replace(drive.log, steering_wheel_angle=wheel))


def make_request(drive: Drive, text: str = TEXT) -> Request:
    return Request("nonlinear", VehicleParameters.from_yaml(text), "leaf.yaml", text, DiscoverySettings(),
                   drives=[drive])


def fold_effects(drive: Drive, *effects: tuple[str, dict], text: str = TEXT):
    found = discovery([drive.log], [(name, values, 0.5) for name, values in effects], 1.0)
    return found, fold_named_effects(found, make_request(drive, text))


def test_file_that_predicts_worse_is_not_written(recorded_drive):
    """The drive is of the car as in its file, so a mass 1.5 times as large increases the error."""
    found, folded = fold_effects(recorded_drive, ("mass", {"factor": 1.5}))
    assert folded.text and folded.error[1] > folded.error[0]
    written = update_vehicle(found, make_request(recorded_drive))
    assert not written.text and written.vehicle == CAR and written.model.values["mass"]["factor"] == 1.5
    assert written.error == folded.error
    (advice,) = [line for line in recommend(found, written) if "is not written" in line]
    assert "alone it would change" in advice and "on these drives" in advice  # one drive, so none is held out
    outside = replace(written, error=(0.0, math.inf), worse_drives=("weave",))
    assert "values fitted without weave are outside the limits" in "".join(recommend(found, outside))


@pytest.mark.parametrize(("interval", "is_written"), [((-0.2, -0.05), False), ((-0.2, 0.01), True)])
def test_model_that_increases_the_error_significantly_is_not_written(recorded_drive, tmp_path, interval, is_written):
    """As of a bus outside the model family; interval: 95 %, of the reduction of the held-out position error."""
    found, _ = fold_effects(recorded_drive, ("steering_delay", {"time": 0.1}))
    position = replace(found.errors["position_5s"], base=0.39, augmented=0.52, interval=interval)
    found = replace(found, errors={**found.errors, "position_5s": position}, minor=found.effects)
    request = make_request(recorded_drive)
    update = update_vehicle(found, request)
    files = write_results(found, request, update, tmp_path, None, {})
    assert ("model.yaml" in files) is (tmp_path / "model.yaml").exists() is is_written
    lines = [line for line in recommend(found, update) if "model.yaml" in line]
    assert lines == ["model.yaml is not written: with it, the position error after 5 s would increase significantly, "
                     "from 0.39 m to 0.52 m on held-out driving"] or is_written
    assert any(line.startswith("predict with model.yaml") for line in lines) is is_written


def test_file_that_improves_the_mean_but_worsens_a_drive_is_not_written(tmp_path):
    long = record_drive(tmp_path, 90.0)
    _, folded = fold_effects(long, ("mass", {"factor": 1.5}))
    assert folded.worse_drives == (long.log.name,)
    assert not replace(folded, error=(1.0, 0.5)).is_not_worse
    assert replace(folded, error=(1.0, 0.5), worse_drives=()).is_not_worse


def test_stiffer_tyres_raise_the_minimum_slip_speed(recorded_drive):
    _, update = fold_effects(recorded_drive, ("tyre_stiffness", {"factor": 2.0}))
    assert update.vehicle.minimum_slip_speed > CAR.minimum_slip_speed
    needed = required_slip_speed(("linear", "nonlinear"), update.vehicle, STABILITY_SPEEDS, PredictionSettings().step)
    assert needed == update.vehicle.minimum_slip_speed


def test_model_stiffer_than_the_car_raises_the_minimum_slip_speed_of_the_file(recorded_drive):
    found = discovery([recorded_drive.log], [("steering_ratio", {"factor": 0.92}, 0.5)], 1.0)
    best = augment("nonlinear", {"steering_ratio": {"factor": 0.92}, "yaw_inertia": {"factor": 0.5}})
    update = fold_named_effects(replace(found, model=best, minor=found.effects), make_request(recorded_drive))
    assert update.vehicle.minimum_slip_speed > CAR.minimum_slip_speed and update.vehicle.yaw_inertia == CAR.yaw_inertia
    needed = required_slip_speed((update.model,), update.vehicle, STABILITY_SPEEDS, PredictionSettings().step)
    assert needed == update.vehicle.minimum_slip_speed
    assert update.vehicle.sources["minimum_slip_speed"] == "stable with steps of 50 ms; previously 3.0 m/s"
    assert f"for steering ratio; minimum_slip_speed 3 → {update.vehicle.minimum_slip_speed:.4g} m/s" in "".join(
        recommend(found, update))


def test_minimum_slip_speed_is_advised_if_no_file_is_written(recorded_drive):
    found = discovery([recorded_drive.log], [("mass", {"factor": 1.5}, 0.5)], 1.0)
    found = replace(found, model=augment("nonlinear", {"mass": {"factor": 1.5}, "yaw_inertia": {"factor": 0.4}}))
    update = update_vehicle(found, make_request(recorded_drive))
    assert not update.text and update.required_slip_speed > CAR.minimum_slip_speed
    assert f"minimum_slip_speed = {update.required_slip_speed:g} m/s" in "".join(recommend(found, update))
    mild = augment("nonlinear", {"mass": {"factor": 1.5}})
    assert update_vehicle(replace(found, model=mild), make_request(recorded_drive)).required_slip_speed == 0.0


def test_effective_corrections_remain_in_the_model_and_are_marked(recorded_drive):
    """The best model predicts the same with the updated file, which has the values with a physical meaning."""
    found = discovery([recorded_drive.log], [("mass", {"factor": 1.1}, 0.5)], 1.0)
    named, best = (augment("nonlinear", {"mass": {"factor": mass}, "friction": {"factor": friction}})
                   for mass, friction in ((1.1, 1.0), (1.2, 0.9)))
    found = replace(found, model=best, named=named, effective=found.effects)
    update = fold_named_effects(found, make_request(recorded_drive))
    assert update.vehicle.mass == pytest.approx(1.1 * CAR.mass) and update.model.values["friction"]["factor"] == 0.9
    assert update.model.values["mass"]["factor"] == pytest.approx(1.2 / 1.1)
    text = build_model_file(found, make_request(recorded_drive), update).to_yaml()
    assert text.count("effective: true") == 2
    assert ModelFile.from_yaml(text).effects["friction"]["factor"].effective


@pytest.mark.slow
@pytest.mark.parametrize("name", FOLDED)
def test_updated_file_has_the_values_of_the_folded_effect(recorded_drive, name):
    values = values_of(name, 0.8)
    found, update = fold_effects(recorded_drive, (name, values))
    assert update.folded == (name,) and not update.not_folded
    expected = EFFECTS[name].fold(CAR, EFFECTS[name].Theta(**values, constants=()))
    for key in FILE_QUANTITIES:
        assert value_of(update.vehicle, key) == pytest.approx(value_of(expected, key), rel=1e-5, abs=1e-9), key
    assert all(low <= high for _, _, low, high in update.changes.values())
    assert build_model_file(found, make_request(recorded_drive), update) is None


def test_only_lines_of_the_changed_keys_are_edited(recorded_drive):
    _, update = fold_effects(recorded_drive, ("steering_ratio", {"factor": 0.9}), ("mass", {"factor": 1.1}))
    lines = TEXT.splitlines()
    removed, added = set(lines) - set(update.text.splitlines()), [n for n in update.text.splitlines() if n not in lines]
    assert {line.partition(":")[0] for line in removed} == {"mass", "steering_ratio"}
    # Without an entry lambda_ky follows from the load; the effect does not change the tyre, so its value is written.
    assert [line.partition(":")[0] for line in added] == ["mass", "steering_ratio", "  lambda_ky", "  lambda_ky"]
    note = update.vehicle.provenance["steering_ratio"]
    assert note.uncertainty == pytest.approx(0.02 * 0.1 * 17.3 / 1.96, rel=0.02)
    assert note.method == "st discover" and note.data == "weave" and len(note.date) == 10
    source = update.vehicle.sources["steering_ratio"]
    assert source.startswith("st discover, 20") and source.endswith("; previously 17.3")
    assert "95 % interval 15.5" in source


def test_unit_in_the_file_is_kept(recorded_drive):
    _, update = fold_effects(recorded_drive, ("steering_offset", {"angle": 0.005}))
    line = next(line for line in update.text.splitlines() if line.startswith("steering_wheel_offset"))
    assert 'unit: "deg"' in line
    assert update.vehicle.steering_wheel_offset == pytest.approx(CAR.steering_wheel_offset - 0.005 * 17.3, abs=1e-6)


def test_blocks_and_comments_of_the_user_are_kept(recorded_drive):
    line = next(line for line in TEXT.splitlines(True) if line.startswith("mass"))
    block = "mass:  # weighed\n  value: 1590.0  # by me\n  unit: kg\n  source: scales\n# the next one is a guess\n"
    text = TEXT.replace(line, block)
    _, update = fold_effects(recorded_drive, ("mass", {"factor": 1.1}), text=text)
    assert update.vehicle.mass == pytest.approx(1749.0) and "# weighed" in update.text
    assert "# the next one is a guess\nyaw_inertia" in update.text


def test_key_missing_in_the_file_is_added():
    assert "lambda_muy" not in TEXT
    text = edit_vehicle_text(TEXT, ["tyre_front.lambda_muy"], CAR.with_values({"tyre_front.lambda_muy": 0.8}))
    found = VehicleParameters.from_yaml(text)
    assert found.tyre_front.lambda_muy == 0.8 and replace(found, tyre_front=CAR.tyre_front) == CAR
    assert set(TEXT.splitlines()) < set(text.splitlines())


@pytest.mark.slow
def test_effects_without_a_key_are_written_as_model_of_the_corrected_car(recorded_drive, tmp_path):
    found, update = fold_effects(recorded_drive, ("steering_ratio", {"factor": 0.9}),
                                 ("yaw_rate_bias", {"bias": 0.004}))
    file = build_model_file(found, make_request(recorded_drive), update)
    assert set(file.effects) == {"yaw_rate_bias"} and file.vehicle_hash == update.vehicle.hash != CAR.hash
    assert file.effects["yaw_rate_bias"]["bias"].interval == pytest.approx((0.00392, 0.00408))
    assert ModelFile.from_yaml(file.to_yaml()).model().values["yaw_rate_bias"]["bias"] == 0.004
    # The model file alone is sufficient: it contains its car.
    (tmp_path / "model.yaml").write_text(file.to_yaml())
    drive = write_drive(tmp_path / "weave.csv", weave(8.0))
    result = st("evaluate", drive, "--model", tmp_path / "model.yaml", "--figures", "", "--output", tmp_path / "out")
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize("name", [n for n, e in EFFECTS.items() if not e.fold and not all(p.fit for p in e.parameters)])
def test_constants_at_their_neutral_values_are_not_in_the_model_file(recorded_drive, name):
    fitted = {p.name: p.initial for p in EFFECTS[name].parameters if p.fit}
    found, update = fold_effects(recorded_drive, (name, fitted))
    for result, is_effective in ((found, False), (replace(found, effects=(), named=None), True)):
        values = build_model_file(result, make_request(recorded_drive), update).effects[name]
        assert {key: e.value for key, e in values.items()} == fitted
        assert all(e.effective is is_effective for e in values.values())


def test_steering_ratio_remains_in_the_model_without_steering_wheel_angle(recorded_drive):
    """The steering ratio of a vehicle file does not affect recorded road wheel angles, so the model corrects it."""
    bare = replace(recorded_drive, log=replace(recorded_drive.log, steering_wheel_angle=None))
    found, update = fold_effects(bare, ("steering_ratio", {"factor": 0.9}))
    assert not update.folded and update.text == "" and update.vehicle.hash == CAR.hash
    assert update.not_folded["steering_ratio"]["steering_ratio"] == pytest.approx((17.3, 15.57))
    assert set(build_model_file(found, make_request(bare), update).effects) == {"steering_ratio"}


def test_effect_that_does_not_commute_remains_in_the_model(recorded_drive):
    """Steering play applies after the ratio of the file: with another ratio the same play is a different effect."""
    _, update = fold_effects(recorded_drive, ("steering_backlash", {"play": 0.02}), ("steering_ratio", {"factor": 0.6}))
    assert set(update.not_folded) == {"steering_ratio"} and not update.folded


def test_identify_starts_from_the_updated_file(recorded_drive, tmp_path):
    _, update = fold_effects(recorded_drive, ("mass", {"factor": 1.1}), ("yaw_inertia", {"factor": 1.2}))
    (tmp_path / "vehicle.yaml").write_text(update.text)
    table = write_tables(CAR, tmp_path / "tables", seed=2)["scales"]
    result = st("identify", "scales", table, "--vehicle", tmp_path / "vehicle.yaml", "--output", tmp_path / "out")
    assert result.exit_code == 0 and "(st discover, 20" in result.output, result.output
    identified = VehicleParameters.from_yaml((tmp_path / "out" / "vehicle.yaml").read_text())
    assert identified.mass != update.vehicle.mass and identified.yaw_inertia == update.vehicle.yaw_inertia
    assert identified.provenance["yaw_inertia"] == update.vehicle.provenance["yaw_inertia"]
