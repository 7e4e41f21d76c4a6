"""The command st identify: values and a vehicle file from tables of a known car; invalid tables in one line."""

import json
from dataclasses import replace

import pytest
from command_line import st
from drives import weave, write_drive
from experiment_tables import write_tables
from st_core.vehicle import VehicleParameters
from support import LEAF, ROOT

KEYS = {"value", "unit", "standard_uncertainty", "interval95", "method", "runs", "verdict"}
EXPERIMENTS = {"scales": "scales", "cg-height": "cg_height", "steering-ratio": "steering_ratio", "tyre": "flat_plank"}


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """The four tables in sequence, each with the vehicle file of the previous one."""
    base = tmp_path_factory.mktemp("identify")
    car = VehicleParameters.from_yaml(LEAF.read_text())
    files = write_tables(car, base / "tables", seed=2)
    vehicle, results = LEAF, {}
    for experiment, name in EXPERIMENTS.items():
        results[experiment] = st("identify", experiment, files[name], "--vehicle", vehicle, "--output",
                                 base / experiment)
        assert results[experiment].exit_code == 0, results[experiment].output
        vehicle = base / experiment / "vehicle.yaml"
    return base, car, files, results


def read(base, experiment):
    return json.loads((base / experiment / "identification.json").read_text())


@pytest.mark.slow
def test_every_experiment_writes_its_parameters_in_the_schema(chain):
    base = chain[0]
    assert set(read(base, "scales")) == {"mass", "cg_to_front_axle"}
    assert set(read(base, "cg-height")) == {"cg_height"} and set(read(base, "steering-ratio")) == {"steering_ratio"}
    assert len(read(base, "tyre")) == 16
    for experiment in EXPERIMENTS:
        for entry in read(base, experiment).values():
            assert set(entry) == KEYS
            assert entry["interval95"][0] <= entry["value"] <= entry["interval95"][1]
        details = json.loads((base / experiment / "details.json").read_text())
        assert details["vehicle"]["hash"] and next(iter(details["files"].values()))
        assert all(set(one["parameters"]) <= set(read(base, experiment)) for one in details["experiments"])


@pytest.mark.slow
def test_vehicle_file_accumulates_values_with_their_provenance(chain):
    base, car, _, _ = chain
    found = VehicleParameters.from_yaml((base / "tyre" / "vehicle.yaml").read_text())
    assert found.mass == read(base, "scales")["mass"]["value"] != car.mass
    assert found.steering_ratio == read(base, "steering-ratio")["steering_ratio"]["value"]
    assert found.tyre_rear.p_dy1 == read(base, "tyre")["tyre_rear.p_dy1"]["value"]
    assert found.yaw_inertia == car.yaw_inertia and "yaw_inertia" not in found.provenance
    note = found.provenance["mass"]
    assert note.uncertainty == read(base, "scales")["mass"]["standard_uncertainty"]
    assert note.method.startswith("four wheel scales") and note.data == "scales.csv:1, scales.csv:2, scales.csv:3"
    assert len(note.date) == 10
    written = (base / "tyre" / "vehicle.yaml").read_text()
    assert all(line in written for line in LEAF.read_text().splitlines() if line.startswith("#"))


@pytest.mark.slow
def test_evaluate_accepts_the_identified_vehicle(chain, tmp_path):
    drive = write_drive(tmp_path / "weave.csv", weave(8.0))
    result = st("evaluate", drive, "--vehicle", chain[0] / "tyre" / "vehicle.yaml", "--model", "kinematic",
                "--figures", "", "--output", tmp_path / "out")
    assert result.exit_code == 0, result.output
    vehicle = json.loads((tmp_path / "out" / "evaluation.json").read_text())["vehicle"]
    assert vehicle["hash"] == VehicleParameters.from_yaml((chain[0] / "tyre" / "vehicle.yaml").read_text()).hash


@pytest.mark.slow
def test_terminal_figures_and_page_are_written(chain):
    base, _, _, results = chain
    words = " ".join(results["scales"].output.split())
    assert "mass: The car weighs 1589.2 kg" in words and "identified" in words
    for experiment, names in {"scales": ["scales"], "cg-height": ["cg-height"], "steering-ratio": ["steering-ratio"],
                        "tyre": ["tyre-front", "tyre-rear"]}.items():
        page = (base / experiment / "report.html").read_text()
        assert "http" not in page.replace("http-equiv", "").replace("http://www.w3.org", "") and "<svg" in page
        for name in names:
            assert (base / experiment / f"{name}.png").stat().st_size > 10_000
            assert (base / experiment / f"{name}.pdf").is_file()


@pytest.mark.slow
def test_value_that_contradicts_the_file_is_reported(chain, tmp_path):
    base, car, _, _ = chain
    heavy = write_tables(replace(car, mass=1650.0), tmp_path / "tables", seed=3)
    result = st("identify", "scales", heavy["scales"], "--vehicle", base / "tyre" / "vehicle.yaml",
                "--output", tmp_path / "out")
    assert "contradicts 1589.2 kg" in result.output and "times the combined uncertainty" in result.output


@pytest.mark.slow
def test_lambda_requires_an_identified_cornering_stiffness(chain, tmp_path):
    base, _, files, _ = chain
    result = st("identify", "lambda", files["flat_plank"], "--vehicle", base / "tyre" / "vehicle.yaml",
                 "--output", tmp_path / "no")
    assert result.exit_code == 2
    assert "cornering_stiffness_front of the vehicle file has no uncertainty" in result.output
    text = (base / "tyre" / "vehicle.yaml").read_text()
    for axle, value in (("front", "70000.0"), ("rear", "106000.0")):
        text = text.replace(f"cornering_stiffness_{axle}: {{value: {value},",
                            f"cornering_stiffness_{axle}: {{value: {value}, uncertainty: 500.0,")
    (tmp_path / "car.yaml").write_text(text)
    result = st("identify", "lambda", files["flat_plank"], "--vehicle", tmp_path / "car.yaml", "--output",
                tmp_path / "out")
    assert result.exit_code == 0, result.output
    found = read(tmp_path, "out")
    for tyre, truth in (("tyre_front", 0.423), ("tyre_rear", 0.962)):
        low, high = found[f"{tyre}.lambda_ky"]["interval95"]
        assert low < truth < high and high - low < 0.1
    changed = VehicleParameters.from_yaml((tmp_path / "out" / "vehicle.yaml").read_text())
    assert changed.tyre_front.lambda_ky == found["tyre_front.lambda_ky"]["value"]


def test_error_without_files_names_the_experiment_only(tmp_path):
    result = st("identify", "lambda", "--vehicle", LEAF, "--output", tmp_path / "out")
    assert result.exit_code == 2 and "st identify lambda: cornering_stiffness_front" in " ".join(result.output.split())


def test_experiments_are_listed_without_an_argument():
    result = st("identify")
    assert result.exit_code == 0
    assert all(name in result.output for name in (*EXPERIMENTS, "lambda"))


INVALID_TABLES = {
    "missing wheel": ("scales", "front_left_kg,front_right_kg,rear_left_kg\n1,2,3\n", "has no column rear_right_kg"),
    "empty cell": ("scales", "front_left_kg,front_right_kg,rear_left_kg,rear_right_kg\n450,450,,350\n",
                   "row 1 has no rear_left"),
    "no unit": ("scales", "front_left,front_right_kg,rear_left_kg,rear_right_kg\n1,2,3,4\n",
                "column front_left has no permitted unit; name it front_left_kg"),
    "a word": ("scales", "front_left_kg,front_right_kg,rear_left_kg,rear_right_kg\n450,450,heavy,350\n",
               "row 1: rear_left_kg is 'heavy', not a number"),
    "infinite": ("scales", "front_left_kg,front_right_kg,rear_left_kg,rear_right_kg\n450,450,inf,350\n",
                 "give a finite number"),
    "header only": ("scales", "front_left_kg,front_right_kg,rear_left_kg,rear_right_kg\n", "has a header but no rows"),
    "short row": ("scales", "front_left_kg,front_right_kg,rear_left_kg,rear_right_kg\n450,450\n",
                  "row 1 has 2 cells, the header 4"),
    "twice": ("scales", "front_left_kg,front_left_kg,rear_left_kg,rear_right_kg\n1,2,3,4\n",
              "front_left occurs twice"),
    "degrees as radians": ("cg-height", "pitch_rad,rear_left_kg,rear_right_kg,front_radius_m,rear_radius_m\n"
                           "0,340,340,0.3,0.3\n5,345,345,0.3,0.3\n10,350,350,0.3,0.3\n", "limit 45 deg"),
    "no pitch": ("cg-height", "rear_left_kg,rear_right_kg\n340,340\n", "has no values of pitch_deg, and lacks"),
    "too few": ("steering-ratio", "steering_wheel_deg,left_wheel_deg,right_wheel_deg\n0,0,0\n90,5,5\n", "2 rows, at "
                                                                                                        "least 5"),
    "which tyre": ("tyre", "load_n,slip_angle_deg,lateral_force_n\n3300,1,500\n", "has no column tyre"),
    "spare tyre": ("tyre", "tyre,load_n,slip_angle_deg,lateral_force_n\nspare,3300,1,500\n", "tyre is 'spare' in "
                                                                                             "row 1"),
}


@pytest.mark.parametrize("name", INVALID_TABLES)
def test_invalid_tables_are_rejected_in_one_line(tmp_path, name):
    experiment, text, message = INVALID_TABLES[name]
    file = tmp_path / "[bold]table.csv"
    file.write_text(text)
    result = st("identify", experiment, file, "--vehicle", LEAF, "--output", tmp_path / "out")
    assert result.exit_code == 2
    assert message in result.output and str(file) in result.output and result.output.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_wrong_arguments_are_rejected(tmp_path):
    result = st("identify", "weight", tmp_path)
    assert result.exit_code == 2 and "unknown experiment 'weight'; use scales" in result.output
    result = st("identify", "scales", tmp_path / "none.csv", "--output", tmp_path / "out")
    assert result.exit_code == 2 and "the file does not exist" in result.output
    result = st("identify", "scales", "--output", tmp_path / "out")
    assert result.exit_code == 2 and "scales: " in result.output
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("x")
    result = st("identify", "scales", "x.csv", "--output", tmp_path / "full")
    assert result.exit_code == 2 and "is not empty" in result.output
    table = ROOT / "docs/examples/identification/scales.csv"
    result = st("identify", "scales", table, "--output", tmp_path / "full" / "mine.txt" / "out")
    assert result.exit_code == 2 and "cannot be created" in result.output and result.output.count("\n") == 1
