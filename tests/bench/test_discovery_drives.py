"""The drives of the cases hold what the truth says: fitted, the true effects come out; nothing else is left."""

from dataclasses import replace

import numpy as np
import pytest

from bench.discovery.baselines import paramsd
from bench.discovery.cases import ELSEWHERE, cases_of
from bench.discovery.drives import IDENTIFIED, drives_of, settings_of
from bench.discovery.edits import EDITS
from bench.discovery.judge import there
from bench.discovery.oracle import Judge, Oracle, Point, everything

# Compiling the cars takes some seconds.
pytestmark = pytest.mark.slow


def case_of(block, test):
    return next(c for c in cases_of("development", block) if test(c))


def found_in(case):
    drives = drives_of(case)
    start = {n: drives.truth[n] for n in there(case) - set(case.hidden) if n in drives.truth}
    return drives, Oracle(drives.suspect, drives.vehicle, there(case), start, settings_of(case))


def test_what_is_hidden_comes_out_of_the_fit():
    case = case_of("A", lambda c: c.hidden == ("heading_misalignment",) and c.car.plant == "leaf" and c.with_vy)
    drives, oracle = found_in(case)
    # The heading of the INS wanders by 0.0008 rad.
    value = oracle.best.model.values["heading_misalignment"]["angle"]
    assert value == pytest.approx(drives.truth["heading_misalignment"]["angle"], abs=8e-4)
    judge = Judge(drives.held_out, drives.vehicle, settings_of(case))
    judge.sized_by(oracle.best)
    assert judge.loss(oracle.without(case.hidden)) > 1.1 * judge.loss(oracle.best)
    assert judge.position(oracle.only(())) > 2.0 * judge.position(oracle.best)


def test_the_same_for_a_multi_body_car():
    case = case_of("B", lambda c: {"steering_ratio", "steering_offset"} <= set(c.hidden) and c.car.plant != "leaf")
    drives, oracle = found_in(case)
    ratio, offset = (oracle.best.model.values[n][p] for n, p in (("steering_ratio", "factor"),
                                                                 ("steering_offset", "angle")))
    assert ratio == pytest.approx(drives.truth["steering_ratio"]["factor"], abs=0.02)
    assert offset == pytest.approx(drives.truth["steering_offset"]["angle"], abs=5e-4)


def test_inputs_re_simulated_with_the_base_leave_noise_only():
    for index in (0, 2):
        case = cases_of("development", "C", 3)[index]
        assert case.kind == "base"
        drives = drives_of(case)
        judge = Judge(drives.held_out, drives.vehicle, settings_of(case))
        assert judge.position(Point(everything(), 0.0)) < 0.1
        assert all(20.0 < log.duration < 60.0 for log in drives.suspect)


def test_an_identified_file_is_better_than_the_one_it_began_from():
    case = cases_of("development", "C", 2)[1]
    assert case.kind == "identified" and "front_stiffness" in IDENTIFIED
    own = replace(case, file=case.settings)
    positions = []
    for one in (case, own):
        drives = drives_of(one)
        positions.append(Judge(drives.held_out, drives.vehicle, settings_of(one)).position(Point(everything(), 0.07)))
    assert positions[0] < 0.8 * positions[1]


def test_drives_repeat_and_hide_what_is_not_measured():
    case = case_of("A", lambda c: not c.with_vy)
    first, again = drives_of(case), drives_of(case)
    np.testing.assert_array_equal(first.suspect[0].x, again.suspect[0].x)
    assert not first.suspect[0].velocity_y.any() and first.held_out[0].velocity_y.any()
    assert not first.reference


def test_cases_of_one_car_share_their_reference():
    cases = cases_of("development", "D", 2)
    first, again = (drives_of(c) for c in cases)
    assert len(first.reference) == 3
    assert first.reference is again.reference


def test_the_slope_is_at_one_of_two_sites():
    case = case_of("E", lambda c: c.elsewhere is not None)
    drives = drives_of(case)
    away = [log.x.mean() > ELSEWHERE / 2 for log in drives.suspect]
    assert away == [False, True, False]
    assert case.settings["hillside_slope"] and not case.elsewhere["hillside_slope"]


def test_paramsd_learns_the_ratio_of_a_car_that_is_linear():
    """Gentle: the yaw rate of the base model with the angle scaled, so nothing but the ratio is wrong."""
    case = cases_of("development", "C", 1)[0]
    drives = drives_of(case)
    scaled = [EDITS["steering scaled"].column(log, 0.1) for log in drives.suspect]
    plain, learnt = (paramsd(logs, drives.vehicle)["steering_ratio"]["factor"] for logs in (drives.suspect, scaled))
    assert learnt / plain == pytest.approx(1.1, abs=0.02)
