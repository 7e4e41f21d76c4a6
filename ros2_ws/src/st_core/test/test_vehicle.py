"""Vehicle files: values, derived values, round trip, and errors that name file, key and limit."""

import math
import re
from dataclasses import replace

import pytest
import yaml
from st_core.errors import ConfigurationError
from st_core.vehicle import OPTIONAL_QUANTITIES, TYRE_QUANTITIES, VEHICLE_QUANTITIES, Provenance, VehicleParameters
from support import GOLDEN_DATA, ROOT

LEAF = (ROOT / "config" / "vehicle" / "leaf.yaml").read_text()


def edit_line(key: str, old: str, new: str) -> str:
    """The Leaf's file with `old` replaced in the line of `key`."""
    lines = LEAF.splitlines()
    row = next(i for i, line in enumerate(lines) if line.strip().startswith(f"{key}:"))
    assert old in lines[row]
    lines[row] = lines[row].replace(old, new)
    return "\n".join(lines)


def test_leaf_contains_the_values_of_the_paper_in_si(leaf):
    assert (leaf.mass, leaf.yaw_inertia, leaf.cg_height) == (1590.0, 2925.0, 0.443)
    assert (leaf.cg_to_front_axle, leaf.cg_to_rear_axle) == pytest.approx((1.176, 1.524))
    assert leaf.cg_to_ins_x == -0.398
    assert leaf.steering_wheel_offset == pytest.approx(math.radians(-2.7))
    assert (leaf.tyre_front.p_ky1, leaf.tyre_rear.p_ky1) == (-20.0, -23.7)
    assert leaf.static_tyre_load_front + leaf.static_tyre_load_rear == pytest.approx(1590.0 * 9.81 / 2.0)
    assert leaf.sources["mass"].startswith("paper")


def test_steering_formula_and_its_sign(leaf):
    # measured = true + offset: a measured angle equal to the offset is straight ahead.
    assert leaf.road_wheel_angle(math.radians(-2.7)) == pytest.approx(0.0, abs=1e-15)
    assert leaf.road_wheel_angle(math.radians(-2.7 + 17.3)) == pytest.approx(math.radians(1.0))
    assert leaf.steering_wheel_angle(leaf.road_wheel_angle(0.7)) == pytest.approx(0.7)


def test_genesis_contains_the_published_values():
    car = VehicleParameters.from_yaml((ROOT / "config" / "vehicle" / "hyundai_genesis.yaml").read_text())
    published = yaml.safe_load((GOLDEN_DATA / "genesis_published.yaml").read_text())
    values = {"m": car.mass, "Iz": car.yaw_inertia, "lf": car.cg_to_front_axle, "lr": car.cg_to_rear_axle,
            "Cf": car.cornering_stiffness_front, "Cr": car.cornering_stiffness_rear,
            "steering_ratio": car.steering_ratio, "ref_ahead_of_rear_axle": car.cg_to_rear_axle + car.cg_to_ins_x}
    assert values == pytest.approx(published, rel=1e-12)
    assumed = [key for key, source in car.sources.items() if source.startswith("assumed")]
    assert {"cg_height", "minimum_slip_speed", "cg_to_ins_x", "tyre_front.p_cy1"} <= set(assumed)


def test_lambda_ky_can_be_specified(leaf):
    text = LEAF.replace("tyre_front:\n", 'tyre_front:\n  lambda_ky: {value: 0.5, unit: "1", source: "test"}\n')
    explicit = VehicleParameters.from_yaml(text)
    assert explicit.tyre_front.lambda_ky == 0.5
    assert explicit.tyre_rear.lambda_ky == leaf.tyre_rear.lambda_ky


def test_file_round_trip(car):
    reloaded = VehicleParameters.from_yaml(car.to_yaml())
    assert reloaded == car and reloaded.hash == car.hash
    assert dict(reloaded.sources)["mass"] == car.sources["mass"]


def test_hash_depends_on_every_value_but_not_on_text(leaf):
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


def test_values_needed_only_by_effects_are_optional(leaf):
    text = "".join(line for line in LEAF.splitlines(keepends=True) if line.partition(":")[0] not in OPTIONAL_QUANTITIES)
    reduced = VehicleParameters.from_yaml(text)
    assert reduced == leaf and reduced.hash == leaf.hash  # the values of the Leaf are the defaults
    assert VehicleParameters.from_yaml(reduced.to_yaml()).hash == leaf.hash
    rear_drive = VehicleParameters.from_yaml(text + 'drive_front: {value: 0, unit: "1", source: "rear-wheel drive"}\n')
    assert rear_drive.drive_front == 0.0 and rear_drive.hash != leaf.hash


def test_drive_fraction_of_the_front_axle(car):
    assert car.drive_front == {"Nissan Leaf ZE0": 1.0, "Hyundai Genesis": 0.0}[car.name]


PROVENANCE_FIELDS = 'uncertainty: 0.8, method: "four scales", data: "a.csv", date: 2026-05-01'
ANNOTATED = edit_line("mass", "unit: kg,", f"unit: kg, {PROVENANCE_FIELDS},")


def test_provenance_is_kept_without_changing_values(leaf):
    text = ANNOTATED.replace('offset: {value: -2.7,', 'offset: {value: -2.7, uncertainty: 0.05,')
    annotated = VehicleParameters.from_yaml(text)
    assert annotated == leaf and annotated.hash == leaf.hash
    assert annotated.provenance["mass"] == Provenance(0.8, "four scales", "a.csv", "2026-05-01")
    assert annotated.provenance["steering_wheel_offset"].uncertainty == pytest.approx(math.radians(0.05))  # SI
    reloaded = VehicleParameters.from_yaml(annotated.to_yaml())
    assert reloaded.provenance == annotated.provenance and set(reloaded.provenance) == {"mass", "steering_wheel_offset"}


def test_derived_scale_follows_the_stiffness_in_a_saved_file(leaf):
    softer = leaf.to_yaml().replace("stiffness_front: {value: 70000.0", "stiffness_front: {value: 35000.0")
    assert VehicleParameters.from_yaml(softer).tyre_front.lambda_ky == pytest.approx(leaf.tyre_front.lambda_ky / 2)
    # An explicitly set scale is written unchanged, whatever its source.
    explicit = replace(leaf, tyre_front=leaf.tyre_front._replace(lambda_ky=0.5))
    assert VehicleParameters.from_yaml(explicit.to_yaml()) == explicit


@pytest.mark.parametrize(("text", "expected"), [
    (ANNOTATED.replace("uncertainty: 0.8", "uncertainty: -0.8"), "mass.uncertainty: -0.8 is not a standard deviation"),
    (ANNOTATED.replace("uncertainty: 0.8", "uncertainty: .inf"), "mass.uncertainty: inf is not a standard deviation"),
    (ANNOTATED.replace("uncertainty: 0.8", "uncertainty: small"), "mass.uncertainty: 'small' is not a number"),
    (ANNOTATED.replace('method: "four scales"', "method: 4"), "mass.method: 4 is not a string"),
    (edit_line("mass", "mass:", "maas:"), "maas: unknown key, did you mean mass?"),
    (edit_line("p_cy1", "p_cy1:", "pcy1:"), "tyre_front.pcy1: unknown key, did you mean p_cy1?"),
    (LEAF + "colour: red\n", "colour: unknown key; known: name, mass"),
    (edit_line("mass", "mass:", "# mass:"), "mass: missing; add it"),
    (edit_line("p_ky4", "p_ky4:", "# p_ky4:"), "tyre_front.p_ky4: missing; add it"),
    (edit_line("name", "name:", "# name:"), "name: missing; add it"),
    (edit_line("name", "Nissan Leaf ZE0", "12"), "name: 12 is not a string"),
    (edit_line("mass", "unit: kg, ", ""), "mass: unit is missing; write `mass: {value: ..., unit: \"kg\""),
    (edit_line("mass", "unit: kg", "unit: t"), "mass: unit 't' is not kg; convert the value"),
    (edit_line("steering_wheel_offset", "unit: deg", "unit: grad"), "offset: unit 'grad' is not rad or deg"),
    (edit_line("mass", "1590.0", "15900000.0"), "mass: 1.59e+07 is outside 1 to 60000 kg; check value and unit"),
    (edit_line("mass", "1590.0", ".nan"), "mass: nan is outside 1 to 60000 kg"),
    (edit_line("mass", "1590.0", "1.59"), "mass: 1.59 kg does not fit a car with a wheelbase of 2.7 m (limit 59 to"),
    (edit_line("yaw_inertia", "2925.0", "2.925"), "yaw_inertia: 2.925 kg m^2 does not fit a car with 1590 kg"),
    (edit_line("cornering_stiffness_rear", "106000.0", "106.0"), "cornering_stiffness_rear: 106 N/rad does not fit"),
    (edit_line("mass", "1590.0", "heavy"), "mass: 'heavy' is not a number"),
    (edit_line("cornering_stiffness_front", "70000.0", "1221.7"),
     "cornering_stiffness_front: 1221.7 N/rad is 0.00738 times the stiffness of two tyres of tyre_front"),
    (edit_line("mass", "1590.0", "true"), "mass: True is not a number"),
    (edit_line("steering_wheel_offset", "-2.7", "-270.0"), "offset: -4.71239 is outside -3.14159 to 3.14159 rad"),
    (edit_line("p_ky1", "-20.0", "20.0"), "tyre_front.p_ky1: 20 is outside -200 to -1; check"),
    (edit_line("cg_to_front_axle", "1.176", "2.7"), "cg_to_front_axle: 2.7 m is not below wheelbase 2.7 m"),
    (edit_line("mass", '{value: 1590.0, unit: kg, source: "paper', '1590.0 # "'),
     "mass: 1590.0 has no unit and source"),
    (edit_line("mass", "source:", "origin:"), "mass.origin: unknown key"),
    (edit_line("mass", "paper, vehicle parameter table: four wheel scales, driver included", ""), "mass: source ''"),
    (LEAF + "wheelbase: {value: 2.0, unit: m, source: test}\n", "wheelbase: given twice"),
    (LEAF + "? [a, b]\n: 1\n", "['a', 'b']: a key must be a string"),
    (LEAF + "mass: {value: [\n", "not valid YAML, line"),
    (LEAF.replace("tyre_rear:\n", "tyre_rear: 3\nspare:\n"), "spare: unknown key"),
    (LEAF.partition("tyre_rear:")[0] + "tyre_rear: 3\n", "tyre_rear: not a mapping"),
    ("", "not a mapping of"),
    ("- mass\n", "not a mapping of"),
])
def test_mistakes_are_reported_in_one_line_with_file_and_key(text, expected):
    with pytest.raises(ConfigurationError) as caught:
        VehicleParameters.from_yaml(text, "config/vehicle/mine.yaml")
    message = str(caught.value)
    assert message.startswith("config/vehicle/mine.yaml: ")
    assert expected in message
    assert "\n" not in message


@pytest.mark.parametrize("key", VEHICLE_QUANTITIES)
def test_every_value_is_checked_against_its_limits(leaf, key):
    quantity = VEHICLE_QUANTITIES[key]
    for value in (quantity.minimum - 1.0, quantity.maximum + 1.0, math.nan):
        with pytest.raises(ConfigurationError, match=key):
            replace(leaf, **{key: value})


def test_model_car_of_scale_1_to_10_is_read(leaf):
    tyres = {name: getattr(leaf, name)._replace(nominal_load=8.6) for name in ("tyre_front", "tyre_rear")}
    car = replace(leaf, mass=3.5, yaw_inertia=0.05, wheelbase=0.32, cg_to_front_axle=0.16, cg_height=0.05, length=0.5,
                  width=0.25, track_width=0.23, side_area=0.03, cg_to_ins_x=0.0, steering_ratio=1.0,
                  cornering_stiffness_front=70.0, cornering_stiffness_rear=80.0, **tyres)
    read = VehicleParameters.from_yaml(car.with_derived_scales().to_yaml())
    assert read.mass == 3.5 and read.speed_scale == pytest.approx(0.4) and leaf.speed_scale == 1.0
