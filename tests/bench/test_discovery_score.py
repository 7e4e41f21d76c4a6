"""Arithmetic of the score, and the regression it is compared with."""

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.log import DriveLog
from st_core.readings import corrected_log

from bench.discovery.baselines import sparse
from bench.discovery.figures import matrix
from bench.discovery.oracle import stratum
from bench.discovery.real import INJECTED
from bench.discovery.score import closed, scores, shown, wilson


def record(kind="single", truth=("mass",), names=(("mass",),), outcome="named", **others):
    return {"kind": kind, "truth": list(truth), "names": [list(n) for n in names], "outcome": outcome, "with_vy": True,
            "shifted": False, "note": "", "not_testable": [], "detectability": 0.6, "base": 3.0, "found": 1.1,
            "oracle": 1.0, "index": 0, **others}


def row(document, name):
    return next(r for r in document["scores"] if r["name"] == name)


def test_wilson_interval_is_the_published_one():
    """Newcombe 1998, table I: 81/263 and 0/20."""
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(0, 0) == (0.0, 1.0)


def test_strata():
    assert [stratum(d) for d in (0.9, 0.4, 0.2, 0.05, -1.0)] == ["strong", "medium", "weak", "invisible", "invisible"]


def test_scores_of_a_handful_of_cases():
    records = [
        record(), record(names=[["mass", "friction"]], outcome="ambiguous"),
        record(names=[["friction"]], found=3.5), record(names=[], outcome="none", detectability=0.3, found=3.0),
        record(names=[["friction", "mass"]], outcome="ambiguous", settled=True),
        record(kind="healthy", truth=[], names=[], outcome="none", base=1.0, found=1.0),
        record(kind="untestable", truth=["drag"], names=[], outcome="none", not_testable=["drag"]),
        record(kind="untestable", truth=["friction"], names=[["friction"]], not_testable=["drag"]),
        record(kind="double", truth=["mass", "friction"], names=[["friction"], ["mass", "yaw_inertia"]],
               outcome="several"),
    ]
    document = scores(records)
    exact = row(document, "exact name, with v_y, strong")
    assert (exact["hits"], exact["of"]) == (2, 4)
    assert row(document, "one name stated and wrong")["hits"] == 1
    assert row(document, "truth in the reported set, strong")["hits"] == 3
    assert row(document, "mean set size, strong")["value"] == pytest.approx(1.5)
    assert row(document, "detection, medium")["hits"] == 0
    assert row(document, "untestable effect answered so")["hits"] == 1
    assert row(document, "two effects, exact pair")["hits"] == 1
    assert row(document, "suggested drive, once driven, settles it")["hits"] == 1
    assert row(document, "held-out made worse")["hits"] == 1
    assert closed(records[0]) == pytest.approx(0.95)
    assert shown(exact).startswith("50.0 % (2/4;")
    truths, columns, counts = matrix(records)
    assert counts.sum() == 5
    assert counts[truths.index("mass"), columns.index("none")] == 1


def test_sparse_regression_keeps_the_terms_that_are_there():
    draw = np.random.default_rng(0)
    library = draw.standard_normal((2000, 6))
    target = 0.8 * library[:, 1] - 0.4 * library[:, 4] + 0.05 * draw.standard_normal(2000)
    found = sparse(library, target)
    assert np.flatnonzero(found).tolist() == [1, 4]
    assert found[[1, 4]] == pytest.approx([0.8, -0.4], abs=0.01)
    assert not sparse(library, 0.02 * draw.standard_normal(2000)).any()


@pytest.mark.parametrize("name", INJECTED)
def test_what_is_put_into_a_recording_is_what_the_library_takes_out(name):
    """Corrected by the library's own effect, at the value put in, the recording is the original again."""
    time = 10_000_000 * np.arange(1500, dtype=np.int64)
    t = time * 1e-9
    rate = 0.2 * np.sin(t)
    log = DriveLog("drive", time, 9 * t, np.sin(t), 0.2 * (1 - np.cos(t)), 0 * t + 9, 0.1 * np.cos(t), rate, time,
                   0.05 * np.sin(t), None, 0 * t, 9 * rate)
    put_in, size = INJECTED[name]
    changed = put_in(log, 0.1 * size)
    value = 0.1 * size + (1.0 if name.endswith(("ratio", "scale")) else 0.0)
    parameter = {"steering_offset": "angle", "steering_ratio": "factor", "steering_delay": "time",
                 "yaw_rate_scale": "factor", "yaw_rate_bias": "bias", "speed_scale": "factor",
                 "lateral_acceleration_bias": "bias", "heading_misalignment": "angle", "sensor_lever_arm": "x"}[name]
    values = {parameter: value} if name != "sensor_lever_arm" else {"x": value, "y": 0.0}
    model = augment("nonlinear", {name: values})
    if name in ("steering_offset", "steering_ratio"):
        angle, _ = changed.road_wheel_angle, None
        wheels = angle + value if name == "steering_offset" else angle / value
        np.testing.assert_allclose(wheels, log.road_wheel_angle, atol=1e-12)
        return
    if name == "sensor_lever_arm":
        np.testing.assert_allclose(changed.velocity_y - value * changed.yaw_rate, log.velocity_y, atol=1e-12)
        np.testing.assert_allclose(changed.x - value * np.cos(changed.yaw), log.x, atol=1e-12)
        return
    back = corrected_log(model, changed)
    for field in ("x", "yaw", "velocity_x", "velocity_y", "yaw_rate", "acceleration_y", "steering_time_ns"):
        np.testing.assert_allclose(getattr(back, field), getattr(log, field), atol=1e-9, err_msg=field)
