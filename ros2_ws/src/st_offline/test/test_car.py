"""A car in one folder, and the options that replace a part of it."""

import pytest
from canedge_bridge.signals import load_table
from st_core.vehicle import VehicleParameters
from st_offline.car import car_named, names
from st_offline.paths import config
from st_offline.runs.errors import RunError
from st_offline.verbs._options import LEAF, say_whose, whose


@pytest.fixture
def folder(tmp_path):
    car = tmp_path / "mycar"
    car.mkdir()
    for name in ("vehicle.yaml", "can.dbc", "signals.yaml"):
        (car / name).write_bytes((config("car/leaf") / name).read_bytes())
    (car / "car.yaml").write_text("steering_sign: -1\nsteering_latency: 0.03\n")
    return car


@pytest.mark.parametrize("name", names())
def test_every_car_of_the_configuration_can_be_read(name):
    car = car_named(name)
    assert VehicleParameters.from_yaml(car.vehicle.read_text(), str(car.vehicle)).mass > 0
    if car.dbc.exists():
        assert load_table(car.dbc, car.signals).messages


def test_a_car_says_how_its_recordings_are_read(folder):
    vehicle, read = whose(str(folder), None)
    assert vehicle == folder / "vehicle.yaml"
    assert (read.dbc, read.signals) == (folder / "can.dbc", folder / "signals.yaml")
    assert (read.steering_sign, read.steering_latency) == (-1, 0.03)


def test_options_replace_a_part_of_the_car(folder, tmp_path):
    other = tmp_path / "other.yaml"
    vehicle, read = whose(str(folder), other, None, other, 1, 0.0, offset=1.5)
    assert vehicle == other and read.signals == other and read.dbc == folder / "can.dbc"
    assert (read.steering_sign, read.steering_latency, read.offset) == (1, 0.0, 1.5)


def test_without_a_car_options_stand_alone():
    vehicle, read = whose(None, None, steering_sign=-1)
    assert vehicle is None and read.dbc is None
    assert (read.steering_sign, read.steering_latency) == (-1, 0.0)


def test_the_leaf_is_not_taken_without_a_word(capsys):
    say_whose("discover", LEAF)
    said = capsys.readouterr().err
    assert "no car was named" in said and "hyundai_genesis" in said and said.count("\n") == 1
    say_whose("discover", config("car/hyundai_genesis/vehicle.yaml"))
    assert not capsys.readouterr().err


@pytest.mark.parametrize(("text", "said"), [
    ("steering_sign: 2\n", "neither 1 nor -1"), ("steering_latency: 3\n", "not 0 to 1 s"),
    ("steering_latency: true\n", "not 0 to 1 s"), ("mass: 1500\n", "mass: unknown"), ("- 1\n", "not a table"),
    ("steering_sign: [\n", "not YAML")])
def test_a_car_that_says_nonsense_is_refused(folder, text, said):
    (folder / "car.yaml").write_text(text)
    with pytest.raises(RunError, match=said) as error:
        car_named(str(folder))
    assert str(folder / "car.yaml") in str(error.value)


def test_a_car_nobody_knows_is_refused_with_those_that_are_known():
    with pytest.raises(RunError, match=r"no vehicle\.yaml.*hyundai_genesis, leaf"):
        car_named("unknown_car")
