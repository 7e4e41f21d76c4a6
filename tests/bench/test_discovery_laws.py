"""The blind test of proposals: laws do in the plants what they say, cases are fixed by their seed, scores by hand."""

from dataclasses import replace

import numpy as np
import pytest
from st_core.discovery.settings import DiscoverySettings
from st_core.relations.candidates import WHERE
from st_core.relations.formulas import ONE_SIDED, SHAPES

from bench.discovery import law_score as score
from bench.discovery import pushes
from bench.discovery.cars import healthy_car
from bench.discovery.hidden_laws import BY_NAME, LAWS, REMOVED
from bench.discovery.law_cases import COUNTS, EACH, cases_of, drives_of
from bench.discovery.law_command import in_turn
from bench.discovery.law_tables import as_markdown
from bench.discovery.plants import Order, driven, vehicle_of
from bench.discovery.pushes import Car, Law, push

CAR = Car(1.2, 1.5, 1.8, 120.0)
AT = {"car": CAR, "time": 0.0, "vx": 12.0, "r": 0.25, "ax": 1.0, "vy_dot": 0.1, "r_dot": 0.05}


def test_every_law_has_a_place_a_shape_and_five_cases():
    assert len(LAWS) == 12 and len(REMOVED) == 6 and COUNTS == {"L": 60, "M": 30, "N": 60}
    for hidden in BY_NAME.values():
        assert set(hidden.places) <= set(WHERE) and set(hidden.shapes) <= {*SHAPES, *ONE_SIDED}
    for block, pool in (("L", LAWS), ("M", REMOVED)):
        names = [case.hidden.name for case in cases_of("any", block)]
        assert {names.count(hidden.name) for hidden in pool} == {EACH}
    assert {c.hidden for c in cases_of("any", "N")} == {None}
    assert {c.car.plant for c in cases_of("any", "L")} >= {"leaf", "escort", "bmw_320i", "vanagon"}


def test_cases_follow_from_their_set_and_stay_what_they_are():
    one, again, other = (cases_of(name, "L")[4] for name in ("any", "any", "another"))
    assert one == again and one.seed == again.seed != other.seed
    assert [c.block for c in in_turn("any")[:5]].count("M") == 1


def test_an_effect_that_is_taken_out_does_not_take_part():
    case = cases_of("any", "M")[1]
    assert case.hidden.removed == "yaw_rate_scale" and "yaw_rate_scale" not in case.settings.effects
    assert cases_of("any", "L")[0].settings == DiscoverySettings(where=False)


@pytest.mark.parametrize(("kind", "size", "aside", "turning"), [
    (pushes.AIR_MOMENT, 0.001, 0.0, 0.144), (pushes.TORQUE_STEER, 0.05, 0.0, 0.05),
    (pushes.REAR_STEER, 0.001, 0.36, -1.5 * 0.36 / 1.8), (pushes.CAMBER, 0.1, -0.31, None),
    (pushes.NOTHING, 1.0, 0.0, 0.0)])
def test_a_push_is_the_law_it_says(kind, size, aside, turning):
    added = push(Law(kind, size), **AT)
    assert added[0] == pytest.approx(aside)
    assert turning is None or added[1] == pytest.approx(turning)


def test_lift_takes_from_the_front_axle_and_warm_tyres_have_all_they_had():
    front = (1.5 * 3.1 + 1.8 * 0.05) / 2.7
    aside, turning = push(Law(pushes.LIFT, 0.001), **AT)
    assert aside == pytest.approx(-0.144 * front) and turning == pytest.approx(1.2 * aside / 1.8)
    cold, warm = (push(Law(pushes.WARM_UP, 0.2), **{**AT, "time": t})[0] for t in (0.0, 100.0))
    assert cold == pytest.approx(-0.2 * 3.1) and abs(warm) < 0.01 * abs(cold)


@pytest.mark.parametrize("plant", ["leaf", "escort"])
def test_both_plants_drive_the_law(plant):
    car = healthy_car(plant, (1, 2))
    vehicle = vehicle_of(plant, car.settings)
    order = Order("run", (5, 6), car.settings)
    plain = driven(plant, vehicle, order)
    same, pushed = (driven(plant, vehicle, replace(order, law=Law(kind, 0.001)))
                    for kind in (pushes.NOTHING, pushes.AIR_MOMENT))
    assert np.array_equal(plain.yaw_rate, same.yaw_rate)
    early = slice(0, 30)
    turned = np.gradient((pushed.yaw_rate - plain.yaw_rate)[early], 0.01)[:8].mean()
    # The multi-body car's axles are masses of their own, dragged along by springs.
    assert 0.4 < turned / (0.001 * float(plain.velocity_x[0]) ** 2) < 1.1


def test_what_is_put_into_the_recording():
    case = next(c for c in cases_of("any", "L") if c.hidden.name == "steering map with a kink")
    drives = drives_of(case)
    kinked, plain = drives.suspect[0], drives.healthy[0]
    large = np.abs(plain.road_wheel_angle) > 0.06
    assert large.any() and np.array_equal(kinked.yaw_rate, plain.yaw_rate)
    beyond = np.abs(plain.road_wheel_angle[large]) - 0.04
    assert np.abs(kinked.road_wheel_angle[large]) == pytest.approx(0.04 + beyond / (1 + 0.25 * case.scale))
    assert drives.vehicle.road_wheel_angle(kinked.steering_wheel_angle) == pytest.approx(kinked.road_wheel_angle)


def record(**changes) -> dict:
    law = {"place": "yaw_moment", "quantity": "speed", "by": "", "others": {"side_force over speed": 0.8},
           "chance": 0.001, "gain": 0.1, "shape": "square", "reads": "y = 0.1 + 0.001 u |u|", "promised": [0.5, 0.2]}
    return {"set": "any", "block": "L", "index": 7, "version": "1", "hidden": "aerodynamic yaw moment with v^2",
            "plant": "leaf", "scale": 1.0, "wrong": False, "seconds": [10.0, 5.0], "driven": 150.0,
            "outcome": "several", "wanted": True, "why": "", "law": law, "alone": ["steering_lag"], "kept": [],
            "position": {"base": 1.0, "found": 0.5, "proposed": 0.2, "oracle": 0.1},
            "baselines": {"plain": 0.5, "regression": 0.6, "process": 0.3, "regression_names": ["crosswind"],
                          "process_names": ["speed", "speed"]}} | changes


def test_scores_by_hand():
    right, missed = record(), record(index=19, law=None, alone=["rear_stiffness"], position={
        "base": 1.0, "found": 0.5, "proposed": 0.5, "oracle": 0.1})
    elsewhere = record(law={**right["law"], "place": "side_force", "others": {}})
    assert score.closed(right) == pytest.approx(0.75) and score.closed(missed) == 0.0
    assert score.slot_right(right) and not score.slot_right(elsewhere)
    in_a_set = {**right["law"], "place": "side_force", "others": {"yaw_moment over speed": 0.9}}
    assert score.slot_right(record(law=in_a_set))
    assert score.misnamed(right) == [] and score.misnamed(missed) == ["rear_stiffness"]  # a lag is in the virtual Leaf
    assert score.seconds(right) == pytest.approx(30.0)
    assert score.noticed(missed) and not score.noticed(record(law=None, wanted=False))
    unseen = record(law=None, wanted=False, plant="escort")
    measured = {name: value for name, value, *_ in score.scores([right, missed, elsewhere, unseen])}
    assert measured["noticed (said to be missing)"].startswith("3 of 4")
    assert measured["... by a proposal, or as the outcome *unknown*"].startswith("2 of 4")
    assert measured["... on the virtual Leaf, where nothing else is missing"].startswith("3 of 3")
    assert measured["right slot, or a set that holds it, of proposals"].startswith("1 of 2")


def test_the_page_shows_failures_as_they_are():
    nothing = record(block="N", index=0, hidden="nothing", position={"base": 0.1, "found": 0.1, "proposed": 0.1})
    del nothing["baselines"]
    page = as_markdown([record(), record(index=19, law=None, wanted=False, alone=["rear_stiffness"]), nothing])
    assert "1 of 60 N" in page and "Development" in page
    assert "a proposal where nothing is left" in page and "not noticed; stated alone: rear_stiffness" in page
    assert "u \\|u\\|" in page or "square" not in page
