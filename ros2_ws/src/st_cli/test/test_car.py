"""The folder of a car, the options that override parts of it, and the commands st car new and st car check."""

import errno
import os
import re
import shutil

import pytest
import yaml
from canedge_bridge.signals import load_table
from command_line import st
from st_cli import cli
from st_cli.cli import app
from st_cli.verbs._options import LEAF, ReadOptions, report_default_car
from st_core.vehicle import VehicleParameters
from st_recordings.car import list_cars, load_car
from st_recordings.car_skeleton import find_problems, list_remarks, write_skeleton
from st_recordings.paths import config
from st_recordings.runs.errors import RunError
from typer.main import get_command


@pytest.fixture
def car_folder(tmp_path):
    car = tmp_path / "mycar"
    car.mkdir()
    for name in ("vehicle.yaml", "can.dbc", "signals.yaml"):
        (car / name).write_bytes((config("car/leaf") / name).read_bytes())
    (car / "car.yaml").write_text("steering_sign: -1\nsteering_latency: 0.03\n")
    return car


def test_car_folder_defines_how_recordings_are_read(car_folder):
    vehicle, read = ReadOptions(car=str(car_folder)).resolve()
    assert vehicle == car_folder / "vehicle.yaml"
    assert (read.dbc, read.signals) == (car_folder / "can.dbc", car_folder / "signals.yaml")
    assert (read.steering_sign, read.steering_latency) == (-1, 0.03)


def test_options_override_parts_of_the_car(car_folder, tmp_path):
    other = tmp_path / "other.yaml"
    options = ReadOptions(car=str(car_folder), vehicle=other, signals=other, steering_sign=1, steering_latency=0.0,
                          offset=1.5)
    vehicle, read = options.resolve()
    assert vehicle == other and read.signals == other and read.dbc == car_folder / "can.dbc"
    assert (read.steering_sign, read.steering_latency, read.offset) == (1, 0.0, 1.5)


def test_options_without_a_car_have_neutral_defaults():
    vehicle, read = ReadOptions(steering_sign=-1).resolve()
    assert vehicle is None and read.dbc is None
    assert (read.steering_sign, read.steering_latency) == (-1, 0.0)


def test_use_of_the_default_leaf_is_reported(capsys):
    report_default_car("discover", None, LEAF)
    message = capsys.readouterr().err
    assert "no car was given" in message and "hyundai_genesis" in message and message.count("\n") == 1
    report_default_car("discover", None, config("car/hyundai_genesis/vehicle.yaml"))
    report_default_car("discover", LEAF, LEAF)  # named by the user
    assert not capsys.readouterr().err


@pytest.mark.parametrize(("text", "message"), [
    ("steering_sign: 2\n", "neither 1 nor -1"), ("steering_latency: 3\n", "from 0 to 1 s"),
    ("steering_latency: true\n", "from 0 to 1 s"), ("mass: 1500\n", "mass: unknown"), ("- 1\n", "not a YAML mapping"),
    ("steering_sign: [\n", "not valid YAML"), ("steering_sign: true\n", "neither 1 nor -1"),
    ("steering_sign: 1\nsteering_sign: -1\n", "given twice")])
def test_invalid_car_yaml_is_rejected(car_folder, text, message):
    (car_folder / "car.yaml").write_text(text)
    with pytest.raises(RunError, match=message) as error:
        load_car(str(car_folder))
    assert str(car_folder / "car.yaml") in str(error.value)


def test_unknown_car_is_rejected_with_a_list_of_known_cars(tmp_path):
    with pytest.raises(RunError, match=r"does not exist.*hyundai_genesis, leaf"):
        load_car("unknown_car")
    with pytest.raises(RunError, match=r"contains no vehicle\.yaml.*hyundai_genesis, leaf"):
        load_car(str(tmp_path))


def test_file_instead_of_a_car_folder_is_rejected(car_folder):
    with pytest.raises(RunError, match=f"this is a file; a car is a folder; give --car {car_folder}, or --vehicle"):
        load_car(str(car_folder / "vehicle.yaml"))
    with pytest.raises(RunError, match="this is a file; a car is a folder; give --vehicle"):
        load_car(str(config("vehicle/leaf.yaml")))


@pytest.mark.parametrize("name", ["calibrate", "check", "discover", "evaluate", "identify", "import", "live"])
def test_steering_options_are_identical_in_all_verbs(name):
    commands = get_command(app).commands
    options, reference = ({p.opts[0]: p for p in commands[verb].params} for verb in (name, "evaluate"))
    for option in ("--car", "--vehicle", "--dbc", "--signals", "--steering-sign", "--steering-latency"):
        ours, theirs = options[option], reference[option]
        assert (ours.help, ours.default) == (theirs.help, None), option
    result = st(name, *([] if name == "live" else [LEAF]), "--steering-sign", "2")
    assert result.exit_code == 2 and "2 is neither 1 nor -1" in result.output


def test_unused_speed_signals_of_the_dbc_are_remarked(car_folder):
    assert not any("vehicle_speed" in line for line in list_remarks(str(car_folder)))
    table = car_folder / "signals.yaml"
    head, _, rest = table.read_text().partition("  Leaf_WheelSpeedFront:")
    table.write_text(head + rest[rest.index("  # The INS on CAN"):])
    (line,) = [line for line in list_remarks(str(car_folder)) if "vehicle_speed" in line]
    assert "can.dbc has " in line and "Leaf_WheelSpeedFront.WheelSpeedFR" in line and "RT_" not in line


def test_unknown_unit_in_the_dbc_is_remarked(car_folder):
    dbc = car_folder / "can.dbc"
    dbc.write_text(re.sub(r'(SG_ SteeringWheelAngle .*)"deg"', r'\1"Grad"', dbc.read_text()))
    (line,) = [line for line in list_remarks(str(car_folder)) if "unknown unit" in line]
    assert "SteeringWheelAngle: can.dbc gives the unknown unit 'Grad'; the unit 'deg' of the table is used" in line


@pytest.mark.parametrize("name", ["align", "calibrate", "check", "discover", "effects", "evaluate", "export",
                                  "identify", "import", "live", "replay", "verify", "view"])
def test_verbs_that_need_a_car_accept_its_name(name):
    assert "--car" in {p.opts[0] for p in get_command(app).commands[name].params}


@pytest.mark.parametrize("named", [[], ["--car", "hyundai_genesis"]])
def test_export_reports_use_of_the_default_leaf(tmp_path, named):
    pytest.importorskip("casadi")
    result = st("export", "linear", *named, "--output", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert ("no car was given: the Leaf's file" in result.stderr) == (not named)
    assert ("Leaf" in (tmp_path / "out" / "model.json").read_text()) == (not named)


@pytest.fixture
def skeleton(tmp_path):
    assert st("car", "new", tmp_path / "new").exit_code == 0
    return tmp_path / "new"


def fill_in(car_folder):
    """Fills the placeholders of a skeleton with values of the Leaf and an example steering message."""
    file = car_folder / "vehicle.yaml"
    lines = {line.split(":")[0]: line for line in (config("car/leaf") / "vehicle.yaml").read_text().splitlines()}
    file.write_text("\n".join(lines[key] if "FILL_IN" in line and (key := line.split(":")[0]) in lines else line
                              for line in file.read_text().splitlines()))
    signals = car_folder / "signals.yaml"
    signals.write_text(signals.read_text().replace("FILL_IN_message", "MyCar_Steering").replace(
        "FILL_IN_signal", "SteerAngle"))
    dbc = car_folder / "can.dbc"
    # The commented example of the skeleton itself.
    dbc.write_text(dbc.read_text().replace("// BO_", "BO_").replace("//  SG_", " SG_")
                   + (car_folder / "rt.dbc").read_text())


def test_check_of_a_new_skeleton_lists_exactly_the_values_to_fill_in(skeleton):
    result = st("car", "check", skeleton)
    messages = result.stderr.splitlines()
    required = re.findall(r"(?m)^(\w+): .*FILL_IN", (skeleton / "vehicle.yaml").read_text())
    assert result.exit_code == 1 and len(messages) == len(required) + 1
    assert all("filled in" in line and str(skeleton) in line for line in messages)
    assert {"name", "mass", "steering_ratio", "drive_front", "cornering_stiffness_rear"} < {*required}
    for key in required:
        assert sum(f"vehicle.yaml: {key}:" in line for line in messages) == 1
    assert any("signals.yaml: messages: FILL_IN_message" in line for line in messages)
    assert any(line.endswith("drive_front: not filled in (value and source; 0 to 1)") for line in messages)


def test_skeleton_has_the_ins_messages_and_the_other_quantities_of_the_leaf(skeleton):
    leaf = config("car/leaf")
    ins_rows = [(folder / "signals.yaml").read_text().partition("  # The INS on CAN")[2] for folder in (leaf, skeleton)]
    assert ins_rows[0] == ins_rows[1] != ""
    messages = [[part.strip() for part in re.split(r"\n(?=\S)", (folder / name).read_text())
                 if re.match(r"\n*BO_ \d+ RT_", part)] for folder, name in ((leaf, "can.dbc"), (skeleton, "rt.dbc"))]
    assert messages[0] == messages[1] != []
    vehicles = [yaml.safe_load((folder / "vehicle.yaml").read_text()) for folder in (leaf, skeleton)]
    assert [[*vehicle] for vehicle in vehicles] == [[*vehicles[0]]] * 2
    for key in ("cg_height", "minimum_slip_speed", "length", "track_width", "side_area"):
        assert vehicles[1][key]["value"] == vehicles[0][key]["value"]
    for tyre in ("tyre_front", "tyre_rear"):
        values = [{key: (entry["value"], entry["unit"]) for key, entry in v[tyre].items()} for v in vehicles]
        assert values[0] == values[1]


def test_completed_skeleton_passes_the_check_and_loads(skeleton):
    fill_in(skeleton)
    result = st("car", "check", skeleton)
    assert result.exit_code == 0 and not result.stderr, result.stderr
    car = load_car(skeleton)
    table = load_table(car.dbc, car.signals)
    assert not table.absent_messages and len(table.messages) == 9
    assert VehicleParameters.from_yaml(car.vehicle.read_text(), str(car.vehicle)).mass == 1590.0


@pytest.mark.parametrize(("name", "before", "after", "words"), [
    ("vehicle.yaml", "value: 1590.0", "value: 15.9",
     ["vehicle.yaml: mass: 15.9 kg does not fit a car with a wheelbase of 2.7 m"]),
    ("vehicle.yaml", "minimum_slip_speed: {value: 3.0", "minimum_slip_speed: {value: 0.5",
     ["vehicle.yaml: minimum_slip_speed: 0.5 m/s is too low for integration steps of 50 ms", "or more, or shorter"]),
    ("vehicle.yaml", "yaw_inertia: {value: 2925.0", "yaw_inertia: {value: 146.0", ["yaw_inertia, cornering_stiffness",
     "unstable at any minimum_slip_speed", "is one of them in a different unit?"]),
    ("vehicle.yaml", "mass:", "masss:", ["vehicle.yaml: masss: unknown key"]),
    ("signals.yaml", "unit: deg, sign: 1, range", "unit: rad, sign: 1, range", ["signals.yaml", "SteerAngle.unit"]),
    ("signals.yaml", "sign: 1, range", "sign: 2, range", ["signals.yaml", "SteerAngle.sign"]),
    ("can.dbc", "MyCar_Steering", "OtherName", ["can.dbc: has no message MyCar_Steering"]),
    ("can.dbc", " SG_ SteerAngle : 0|16", ' SG_ Other : 8|8@1+ (1,0) [0|255] "" CAR\n SG_ SteerAngle : 0|16',
     ["can.dbc: MyCar_Steering: The signals", "are overlapping"]),
    ("car.yaml", "steering_sign: 1", "steering_sign: 0", ["car.yaml: steering_sign: 0 is neither 1 nor -1"]),
    ("car.yaml", "steering_latency: 0.0", "steering_latency: 30", ["car.yaml: steering_latency: 30", "from 0 to 1 s"]),
])
def test_each_fault_is_one_line_with_file_and_key(skeleton, name, before, after, words):
    fill_in(skeleton)
    text = (skeleton / name).read_text()
    assert before in text
    (skeleton / name).write_text(text.replace(before, after, 1))
    (message,) = find_problems(str(skeleton))
    assert "\n" not in message and all(word in message for word in words), message


def test_faults_of_several_files_are_reported_together(skeleton):
    fill_in(skeleton)
    (skeleton / "car.yaml").write_text("steering_sign: 0\n")
    (skeleton / "can.dbc").unlink()
    first, second = find_problems(str(skeleton))
    assert "car.yaml" in first and "can.dbc: the file does not exist" in second


def test_signal_table_without_steering_is_rejected(skeleton):
    fill_in(skeleton)
    text = (skeleton / "signals.yaml").read_text()
    (skeleton / "signals.yaml").write_text(text[:text.index("  MyCar")] + text[text.index("  # The INS on CAN"):])
    assert "steering_wheel_angle" in find_problems(str(skeleton))[0]


@pytest.mark.parametrize("name", list_cars())
def test_cars_of_the_configuration_have_no_problems(name):
    assert find_problems(name) == []


def test_car_new_overwrites_nothing(skeleton):
    result = st("car", "new", skeleton)
    assert result.exit_code == 2 and result.stderr.count("\n") == 1 and "is not overwritten" in result.stderr
    shutil.rmtree(skeleton)
    assert st("car", "check", skeleton).exit_code == 2
    skeleton.write_text("a file")
    with pytest.raises(RunError, match="already exists"):
        write_skeleton(skeleton)


def test_car_check_prints_effective_uncertainties_and_unusual_values(skeleton):
    fill_in(skeleton)
    result = st("car", "check", skeleton)
    assert "mass assumed +/- 3 % (" in result.stdout and "`uncertainty` in the vehicle file" in result.stdout
    assert "cg_height +/- 0.1 m (from the file)" in result.stdout and "unusual" not in result.stdout
    file = skeleton / "vehicle.yaml"
    file.write_text(file.read_text().replace("value: 2925.0, unit: kg m^2,",
                                             "value: 1500.0, unit: kg m^2, uncertainty: 100.0,").replace(
                                                 "minimum_slip_speed: {value: 3.0", "minimum_slip_speed: {value: 8.0"))
    result = st("car", "check", skeleton)
    assert result.exit_code == 0 and "yaw_inertia +/- 100 kg m^2 (from the file)" in result.stdout
    assert ("yaw_inertia: dynamic index k^2 / (l_f l_r) 0.526 is outside the range of road cars, 0.6 to 1.4"
            in result.stdout)


@pytest.mark.parametrize(("number", "advice"), [
    (errno.ENOSPC, "No space left on device; free some space, or write to another file system"),
    (errno.EROFS, "Read-only file system; write to another file system")])
def test_failed_write_is_reported_with_its_cause(number, advice, monkeypatch, capsys):
    def fail(prog_name):
        raise OSError(number, os.strerror(number), "/out/bag")

    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 1 and capsys.readouterr().err == f"st: /out/bag: {advice}\n"
