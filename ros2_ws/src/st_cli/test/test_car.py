"""A car in one folder, and the options that replace a part of it."""

import re
import shutil

import pytest
from canedge_bridge.signals import load_table
from st_cli.cli import app
from st_cli.verbs._options import LEAF, ReadOptions, report_default_car
from st_core.vehicle import VehicleParameters
from st_recordings.car import list_cars, load_car
from st_recordings.car_skeleton import MEASUREMENT_HINTS, find_problems, list_remarks, write_skeleton
from st_recordings.paths import config
from st_recordings.runs.errors import RunError
from typer.main import get_command
from typer.testing import CliRunner


@pytest.fixture
def folder(tmp_path):
    car = tmp_path / "mycar"
    car.mkdir()
    for name in ("vehicle.yaml", "can.dbc", "signals.yaml"):
        (car / name).write_bytes((config("car/leaf") / name).read_bytes())
    (car / "car.yaml").write_text("steering_sign: -1\nsteering_latency: 0.03\n")
    return car


@pytest.mark.parametrize("name", list_cars())
def test_every_car_of_the_configuration_can_be_read(name):
    car = load_car(name)
    assert VehicleParameters.from_yaml(car.vehicle.read_text(), str(car.vehicle)).mass > 0
    if car.dbc.exists():
        assert load_table(car.dbc, car.signals).messages


def test_a_car_defines_how_its_recordings_are_read(folder):
    vehicle, read = ReadOptions(car=str(folder)).resolve()
    assert vehicle == folder / "vehicle.yaml"
    assert (read.dbc, read.signals) == (folder / "can.dbc", folder / "signals.yaml")
    assert (read.steering_sign, read.steering_latency) == (-1, 0.03)


def test_options_replace_a_part_of_the_car(folder, tmp_path):
    other = tmp_path / "other.yaml"
    vehicle, read = ReadOptions(car=str(folder), vehicle=other, signals=other, steering_sign=1, steering_latency=0.0,
                                offset=1.5).resolve()
    assert vehicle == other and read.signals == other and read.dbc == folder / "can.dbc"
    assert (read.steering_sign, read.steering_latency, read.offset) == (1, 0.0, 1.5)


def test_without_a_car_options_stand_alone():
    vehicle, read = ReadOptions(steering_sign=-1).resolve()
    assert vehicle is None and read.dbc is None
    assert (read.steering_sign, read.steering_latency) == (-1, 0.0)


def test_the_default_leaf_is_reported(capsys):
    report_default_car("discover", None, LEAF)
    message = capsys.readouterr().err
    assert "no car was named" in message and "hyundai_genesis" in message and message.count("\n") == 1
    report_default_car("discover", None, config("car/hyundai_genesis/vehicle.yaml"))
    report_default_car("discover", LEAF, LEAF)  # named by the user
    assert not capsys.readouterr().err


@pytest.mark.parametrize(("text", "message"), [
    ("steering_sign: 2\n", "neither 1 nor -1"), ("steering_latency: 3\n", "from 0 to 1 s"),
    ("steering_latency: true\n", "from 0 to 1 s"), ("mass: 1500\n", "mass: unknown"), ("- 1\n", "not a YAML mapping"),
    ("steering_sign: [\n", "not valid YAML"), ("steering_sign: true\n", "neither 1 nor -1"),
    ("steering_sign: 1\nsteering_sign: -1\n", "given twice")])
def test_an_invalid_car_is_refused(folder, text, message):
    (folder / "car.yaml").write_text(text)
    with pytest.raises(RunError, match=message) as error:
        load_car(str(folder))
    assert str(folder / "car.yaml") in str(error.value)


def test_a_car_nobody_knows_is_refused_with_those_that_are_known():
    with pytest.raises(RunError, match=r"contains no vehicle\.yaml.*hyundai_genesis, leaf"):
        load_car("unknown_car")


def test_a_file_in_place_of_the_folder_of_a_car(folder):
    with pytest.raises(RunError, match=f"this is a file; a car is a folder; give --car {folder}, or --vehicle"):
        load_car(str(folder / "vehicle.yaml"))


@pytest.mark.parametrize("name", ["calibrate", "check", "discover", "evaluate", "identify", "import", "live"])
def test_every_verb_that_decodes_steering_means_the_same_by_the_same_options(name):
    commands = get_command(app).commands
    options, reference = ({p.opts[0]: p for p in commands[verb].params} for verb in (name, "evaluate"))
    for option in ("--car", "--vehicle", "--dbc", "--signals", "--steering-sign", "--steering-latency"):
        ours, theirs = options[option], reference[option]
        assert (ours.help, ours.default) == (theirs.help, None), option
    refused = CliRunner().invoke(app, [name, *([] if name == "live" else [str(LEAF)]), "--steering-sign", "2"])
    assert refused.exit_code == 2 and "2 is neither 1 nor -1" in refused.output


def test_a_speed_that_the_table_does_not_use_is_pointed_out(folder):
    assert not any("vehicle_speed" in line for line in list_remarks(str(folder)))
    table = folder / "signals.yaml"
    head, _, rest = table.read_text().partition("  Leaf_WheelSpeedFront:")
    table.write_text(head + rest[rest.index("  # The INS on CAN"):])
    (line,) = [line for line in list_remarks(str(folder)) if "vehicle_speed" in line]
    assert "can.dbc has " in line and "Leaf_WheelSpeedFront.WheelSpeedFR" in line and "RT_" not in line


def test_an_unknown_unit_of_the_dbc_is_pointed_out(folder):
    dbc = folder / "can.dbc"
    dbc.write_text(re.sub(r'(SG_ SteeringWheelAngle .*)"deg"', r'\1"Grad"', dbc.read_text()))
    (line,) = [line for line in list_remarks(str(folder)) if "unknown unit" in line]
    assert "SteeringWheelAngle: can.dbc gives the unknown unit 'Grad'; the unit 'deg' of the table is used" in line


@pytest.mark.parametrize("name", ["align", "calibrate", "check", "discover", "effects", "evaluate", "export",
                                  "identify", "import", "live", "replay", "verify", "view"])
def test_every_verb_that_needs_a_car_takes_it_by_name(name):
    assert "--car" in {p.opts[0] for p in get_command(app).commands[name].params}


@pytest.mark.parametrize("named", [[], ["--car", "hyundai_genesis"]])
def test_export_reports_the_default_leaf(tmp_path, named):
    pytest.importorskip("casadi")
    done = CliRunner().invoke(app, ["export", "linear", *named, "--output", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert ("no car was named: the Leaf's file" in done.stderr) == (not named)
    assert ("Leaf" in (tmp_path / "out" / "model.json").read_text()) == (not named)


def st_car(*words):
    return CliRunner().invoke(app, ["car", *map(str, words)])


@pytest.fixture
def new(tmp_path):
    assert st_car("new", tmp_path / "new").exit_code == 0
    return tmp_path / "new"


def fill_in(folder):
    """A completed folder: values of the Leaf, and its steering message."""
    file = folder / "vehicle.yaml"
    lines = {line.split(":")[0]: line for line in (config("car/leaf") / "vehicle.yaml").read_text().splitlines()}
    file.write_text("\n".join(lines[key] if "FILL_IN" in line and (key := line.split(":")[0]) in lines else line
                              for line in file.read_text().splitlines()))
    signals = folder / "signals.yaml"
    signals.write_text(signals.read_text().replace("FILL_IN_message", "MyCar_Steering").replace(
        "FILL_IN_signal", "SteerAngle"))
    dbc = folder / "can.dbc"
    # The example of the skeleton itself, without its comment signs.
    dbc.write_text(dbc.read_text().replace("// BO_", "BO_").replace("//  SG_", " SG_")
                   + (folder / "rt.dbc").read_text())


def test_a_new_car_fails_for_what_is_to_be_filled_in_and_nothing_else(new):
    done = st_car("check", new)
    message = done.stderr.splitlines()
    assert done.exit_code == 1 and len(message) == len(MEASUREMENT_HINTS) + 2
    assert all("filled in" in line and str(new) in line for line in message)
    for key in ("name", *MEASUREMENT_HINTS):
        assert sum(f"vehicle.yaml: {key}:" in line for line in message) == 1
    assert any("signals.yaml: messages: FILL_IN_message" in line for line in message)
    assert any(line.endswith("drive_front: not filled in, value and source; 0 to 1") for line in message)


def test_a_new_car_that_is_filled_in_can_be_used(new):
    fill_in(new)
    done = st_car("check", new)
    assert done.exit_code == 0 and not done.stderr, done.stderr
    car = load_car(str(new))
    table = load_table(car.dbc, car.signals)
    assert not table.absent and len(table.messages) == 9
    assert VehicleParameters.from_yaml(car.vehicle.read_text(), str(car.vehicle)).mass == 1590.0


@pytest.mark.parametrize(("name", "before", "after", "words"), [
    ("vehicle.yaml", "value: 1590.0", "value: 15.9", ["vehicle.yaml: mass: 15.9 is outside 50 to 60000 kg"]),
    ("vehicle.yaml", "minimum_slip_speed: {value: 3.0", "minimum_slip_speed: {value: 0.5",
     ["vehicle.yaml: minimum_slip_speed: 0.5 m/s is too low for integration steps of 50 ms", "m/s or more is stable"]),
    ("vehicle.yaml", "yaw_inertia: {value: 2925.0", "yaw_inertia: {value: 146.0", ["yaw_inertia, cornering_stiffness",
     "unstable at any minimum_slip_speed", "is one of them in another unit?"]),
    ("vehicle.yaml", "mass:", "masss:", ["vehicle.yaml: masss: unknown key"]),
    ("signals.yaml", "unit: deg, sign: 1, range", "unit: rad, sign: 1, range", ["signals.yaml", "SteerAngle.unit"]),
    ("signals.yaml", "sign: 1, range", "sign: 2, range", ["signals.yaml", "SteerAngle.sign"]),
    ("can.dbc", "MyCar_Steering", "OtherName", ["can.dbc: has no message MyCar_Steering"]),
    ("can.dbc", " SG_ SteerAngle : 0|16", ' SG_ Other : 8|8@1+ (1,0) [0|255] "" CAR\n SG_ SteerAngle : 0|16',
     ["can.dbc: MyCar_Steering: The signals", "are overlapping"]),
    ("car.yaml", "steering_sign: 1", "steering_sign: 0", ["car.yaml: steering_sign: 0 is neither 1 nor -1"]),
    ("car.yaml", "steering_latency: 0.0", "steering_latency: 30", ["car.yaml: steering_latency: 30", "from 0 to 1 s"]),
])
def test_each_fault_of_a_car_is_one_line_with_file_and_key(new, name, before, after, words):
    fill_in(new)
    text = (new / name).read_text()
    assert before in text
    (new / name).write_text(text.replace(before, after, 1))
    (message,) = find_problems(str(new))
    assert "\n" not in message and all(word in message for word in words), message


def test_faults_of_several_files_are_reported_together(new):
    fill_in(new)
    (new / "car.yaml").write_text("steering_sign: 0\n")
    (new / "can.dbc").unlink()
    message = find_problems(str(new))
    assert len(message) == 2 and "car.yaml" in message[0] and "can.dbc: the file does not exist" in message[1]


def test_a_table_without_steering_is_refused(new):
    fill_in(new)
    text = (new / "signals.yaml").read_text()
    (new / "signals.yaml").write_text(text[:text.index("  MyCar")] + text[text.index("  # The INS on CAN"):])
    assert "steering_wheel_angle" in find_problems(str(new))[0]


@pytest.mark.parametrize("name", list_cars())
def test_the_cars_of_the_configuration_are_good(name):
    assert find_problems(name) == []


def test_nothing_is_overwritten(new):
    done = st_car("new", new)
    assert done.exit_code == 2 and done.stderr.count("\n") == 1 and "nothing is overwritten" in done.stderr
    shutil.rmtree(new)
    assert st_car("check", new).exit_code == 2
    new.write_text("a file")
    with pytest.raises(RunError, match="exists already"):
        write_skeleton(new)


def test_check_prints_the_uncertainty_in_force_and_what_is_unusual(new):
    fill_in(new)
    done = st_car("check", new)
    assert "mass assumed +/- 3 % (" in done.stdout and "give `uncertainty` to change that" in done.stdout
    assert "cg_height +/- 0.1 m (from the file)" in done.stdout and "unusual" not in done.stdout
    file = new / "vehicle.yaml"
    file.write_text(file.read_text().replace("value: 2925.0, unit: kg m^2,",
                                             "value: 1500.0, unit: kg m^2, uncertainty: 100.0,").replace(
                                                 "minimum_slip_speed: {value: 3.0", "minimum_slip_speed: {value: 8.0"))
    done = st_car("check", new)
    assert done.exit_code == 0 and "yaw_inertia +/- 100 kg m^2 (from the file)" in done.stdout
    assert "yaw_inertia: k^2 / (l_f l_r) 0.526 is outside the range of road cars, 0.6 to 1.4" in done.stdout
