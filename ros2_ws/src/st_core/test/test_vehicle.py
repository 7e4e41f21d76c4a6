"""Vehicle files: what is read, what is derived, and that every mistake names file, key and limit."""

import math
import re
from dataclasses import replace

import pytest
import yaml
from st_core.errors import ConfigurationError
from st_core.provenance import Provenance
from st_core.vehicle import OPTIONAL_QUANTITIES, TYRE_QUANTITIES, VEHICLE_QUANTITIES, VehicleParameters
from support import KEPT, ROOT

LEAF = (ROOT / "config" / "vehicle" / "leaf.yaml").read_text()


def changed(key: str, old: str, new: str) -> str:
    """The Leaf's file with `old` replaced in the line of `key`."""
    lines = LEAF.splitlines()
    place = next(i for i, line in enumerate(lines) if line.strip().startswith(f"{key}:"))
    assert old in lines[place]
    lines[place] = lines[place].replace(old, new)
    return "\n".join(lines)


def test_leaf_holds_the_papers_numbers_in_si(leaf):
    assert (leaf.mass, leaf.yaw_inertia, leaf.cg_height) == (1590.0, 2925.0, 0.443)
    assert (leaf.cg_to_front_axle, leaf.cg_to_rear_axle) == pytest.approx((1.176, 1.524))
    assert leaf.cg_to_ins_x == -0.398
    assert leaf.steering_wheel_offset == pytest.approx(math.radians(-2.7))
    assert (leaf.tyre_front.p_ky1, leaf.tyre_rear.p_ky1) == (-20.0, -23.7)
    assert leaf.static_tyre_load_front + leaf.static_tyre_load_rear == pytest.approx(1590.0 * 9.81 / 2.0)
    assert leaf.sources["mass"].startswith("paper")


def test_steering_formula_and_its_sign(leaf):
    # measured = true + offset: with the sensor at its offset the wheels point straight ahead.
    assert leaf.road_wheel_angle(math.radians(-2.7)) == pytest.approx(0.0, abs=1e-15)
    assert leaf.road_wheel_angle(math.radians(-2.7 + 17.3)) == pytest.approx(math.radians(1.0))
    assert leaf.steering_wheel_angle(leaf.road_wheel_angle(0.7)) == pytest.approx(0.7)


def test_genesis_holds_the_published_numbers():
    car = VehicleParameters.from_yaml((ROOT / "config" / "vehicle" / "hyundai_genesis.yaml").read_text())
    published = yaml.safe_load((KEPT / "genesis_published.yaml").read_text())
    ours = {"m": car.mass, "Iz": car.yaw_inertia, "lf": car.cg_to_front_axle, "lr": car.cg_to_rear_axle,
            "Cf": car.cornering_stiffness_front, "Cr": car.cornering_stiffness_rear,
            "steering_ratio": car.steering_ratio, "ref_ahead_of_rear_axle": car.cg_to_rear_axle + car.cg_to_ins_x}
    assert ours == pytest.approx(published, rel=1e-12)
    assumed = [key for key, source in car.sources.items() if source.startswith("assumed")]
    assert {"cg_height", "minimum_slip_speed", "cg_to_ins_x", "tyre_front.p_cy1"} <= set(assumed)


def test_lambda_ky_can_be_given(leaf):
    text = LEAF.replace("tyre_front:\n", 'tyre_front:\n  lambda_ky: {value: 0.5, unit: "1", source: "test"}\n')
    given = VehicleParameters.from_yaml(text)
    assert given.tyre_front.lambda_ky == 0.5
    assert given.tyre_rear.lambda_ky == leaf.tyre_rear.lambda_ky


def test_saved_file_reads_back_to_the_same_car(car):
    again = VehicleParameters.from_yaml(car.to_yaml())
    assert again == car and again.hash == car.hash
    assert dict(again.sources)["mass"] == car.sources["mass"]


def test_hash_depends_on_every_value_and_on_no_text(leaf):
    assert re.fullmatch("[0-9a-f]{64}", leaf.hash)
    assert replace(leaf, name="other", sources={}).hash == leaf.hash
    hashes = {leaf.hash}
    for key in VEHICLE_QUANTITIES:
        value = getattr(leaf, key)
        hashes.add(replace(leaf, **{key: value * 0.9999 if value else 1e-6}).hash)
    for name in ("tyre_front", "tyre_rear"):
        tyre = getattr(leaf, name)
        for key in TYRE_QUANTITIES:
            value = getattr(tyre, key)
            hashes.add(replace(leaf, **{name: tyre._replace(**{key: value * 0.9999 if value else 1e-6})}).hash)
    assert len(hashes) == 1 + len(VEHICLE_QUANTITIES) + 2 * len(TYRE_QUANTITIES)


def test_what_only_effects_need_may_be_left_out(leaf):
    text = "".join(line for line in LEAF.splitlines(keepends=True) if line.partition(":")[0] not in OPTIONAL_QUANTITIES)
    short = VehicleParameters.from_yaml(text)
    assert short == leaf and short.hash == leaf.hash  # the Leaf is as usual
    assert VehicleParameters.from_yaml(short.to_yaml()).hash == leaf.hash
    driven = VehicleParameters.from_yaml(text + 'drive_front: {value: 0, unit: "1", source: "rear-wheel drive"}\n')
    assert driven.drive_front == 0.0 and driven.hash != leaf.hash


def test_the_genesis_is_driven_by_its_rear_wheels(car):
    assert car.drive_front == {"Nissan Leaf ZE0": 1.0, "Hyundai Genesis": 0.0}[car.name]


NOTES = 'uncertainty: 0.8, method: "four scales", data: "a.csv", date: 2026-05-01'
NOTED = changed("mass", "unit: kg,", f"unit: kg, {NOTES},")


def test_provenance_is_kept_and_changes_no_value(leaf):
    text = NOTED.replace('offset: {value: -2.7,', 'offset: {value: -2.7, uncertainty: 0.05,')
    noted = VehicleParameters.from_yaml(text)
    assert noted == leaf and noted.hash == leaf.hash
    assert noted.provenance["mass"] == Provenance(0.8, "four scales", "a.csv", "2026-05-01")
    assert noted.provenance["steering_wheel_offset"].uncertainty == pytest.approx(math.radians(0.05))  # SI
    again = VehicleParameters.from_yaml(noted.to_yaml())
    assert again.provenance == noted.provenance and set(again.provenance) == {"mass", "steering_wheel_offset"}


def test_a_derived_scale_follows_the_stiffness_of_a_saved_file(leaf):
    softer = leaf.to_yaml().replace("stiffness_front: {value: 70000.0", "stiffness_front: {value: 35000.0")
    assert VehicleParameters.from_yaml(softer).tyre_front.lambda_ky == pytest.approx(leaf.tyre_front.lambda_ky / 2)
    # A value that somebody set, whatever its source says, is written as it stands.
    own = replace(leaf, tyre_front=leaf.tyre_front._replace(lambda_ky=0.5))
    assert VehicleParameters.from_yaml(own.to_yaml()) == own


@pytest.mark.parametrize(("text", "expected"), [
    (NOTED.replace("uncertainty: 0.8", "uncertainty: -0.8"), "mass.uncertainty: -0.8 is not a standard deviation"),
    (NOTED.replace("uncertainty: 0.8", "uncertainty: .inf"), "mass.uncertainty: inf is not a standard deviation"),
    (NOTED.replace("uncertainty: 0.8", "uncertainty: small"), "mass.uncertainty: 'small' is not a number"),
    (NOTED.replace('method: "four scales"', "method: 4"), "mass.method: 4 is not a string"),
    (changed("mass", "mass:", "maas:"), "maas: unknown key, did you mean mass?"),
    (changed("p_cy1", "p_cy1:", "pcy1:"), "tyre_front.pcy1: unknown key, did you mean p_cy1?"),
    (LEAF + "colour: red\n", "colour: unknown key; known are name, mass"),
    (changed("mass", "mass:", "# mass:"), "mass: missing; add it"),
    (changed("p_ky4", "p_ky4:", "# p_ky4:"), "tyre_front.p_ky4: missing; add it"),
    (changed("name", "name:", "# name:"), "name: missing; add it"),
    (changed("name", "Nissan Leaf ZE0", "12"), "name: 12 is not a string"),
    (changed("mass", "unit: kg, ", ""), "mass: unit is missing; write `mass: {value: ..., unit: \"kg\""),
    (changed("mass", "unit: kg", "unit: t"), "mass: unit 't' is not kg; convert the value"),
    (changed("steering_wheel_offset", "unit: deg", "unit: grad"), "offset: unit 'grad' is not rad or deg"),
    (changed("mass", "1590.0", "15900000.0"), "mass: 1.59e+07 is outside 50 to 60000 kg; check value and unit"),
    (changed("mass", "1590.0", ".nan"), "mass: nan is outside 50 to 60000 kg"),
    (changed("mass", "1590.0", "heavy"), "mass: 'heavy' is not a number"),
    (changed("cornering_stiffness_front", "70000.0", "1221.7"),
     "cornering_stiffness_front: 1221.7 N/rad is 0.00738 times the stiffness of two tyres of tyre_front"),
    (changed("mass", "1590.0", "true"), "mass: True is not a number"),
    (changed("steering_wheel_offset", "-2.7", "-270.0"), "offset: -4.71239 is outside -3.14159 to 3.14159 rad"),
    (changed("p_ky1", "-20.0", "20.0"), "tyre_front.p_ky1: 20 is outside -200 to -1; check"),
    (changed("cg_to_front_axle", "1.176", "2.7"), "cg_to_front_axle: 2.7 m is not below wheelbase 2.7 m"),
    (changed("mass", '{value: 1590.0, unit: kg, source: "paper', '1590.0 # "'), "mass: 1590.0 has no unit and source"),
    (changed("mass", "source:", "origin:"), "mass.origin: unknown key"),
    (changed("mass", "paper, vehicle parameter table: four wheel scales, driver included", ""), "mass: source ''"),
    (LEAF + "wheelbase: {value: 2.0, unit: m, source: test}\n", "wheelbase: given twice"),
    (LEAF + "? [a, b]\n: 1\n", "['a', 'b']: a key must be a string"),
    (LEAF + "mass: {value: [\n", "not valid YAML, line"),
    (LEAF.replace("tyre_rear:\n", "tyre_rear: 3\nspare:\n"), "spare: unknown key"),
    (LEAF.partition("tyre_rear:")[0] + "tyre_rear: 3\n", "tyre_rear: not a mapping"),
    ("", "not a mapping of"),
    ("- mass\n", "not a mapping of"),
])
def test_mistakes_are_refused_in_one_line_with_file_and_key(text, expected):
    with pytest.raises(ConfigurationError) as caught:
        VehicleParameters.from_yaml(text, "config/vehicle/mine.yaml")
    message = str(caught.value)
    assert message.startswith("config/vehicle/mine.yaml: ")
    assert expected in message
    assert "\n" not in message


@pytest.mark.parametrize("key", VEHICLE_QUANTITIES)
def test_every_value_is_held_to_its_limits(leaf, key):
    quantity = VEHICLE_QUANTITIES[key]
    for value in (quantity.minimum - 1.0, quantity.maximum + 1.0, math.nan):
        with pytest.raises(ConfigurationError, match=key):
            replace(leaf, **{key: value})
