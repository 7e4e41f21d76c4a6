"""Position jumps are found and counted; no prediction or score crosses them; noise and hard driving are not jumps."""

import math

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.evaluation import Evaluator
from st_core.measurement_history import MeasurementHistory
from st_core.prediction import PredictionSettings, Predictor, Skip, Start
from st_core.types import InsSample

MS = 1_000_000
T0 = 1_700_000_000_000_000_000
RADIUS, SPEED, ANGLE = 30.0, 8.0, 0.09
SIZES = (0.5, 6.4, 640.0)  # [m]: RTK restored, receiver without RTK, another place


def circle(ms, error=0.0, noise=(0.0, 0.0)):
    """A left turn at constant speed; error: of the position, to the north-east [m]."""
    turn = SPEED / RADIUS * 0.001 * ms
    x, y = RADIUS * math.sin(turn), RADIUS * (1.0 - math.cos(turn))
    error /= math.sqrt(2.0)
    return InsSample(T0 + round(ms * MS), x + error + noise[0], y + error + noise[1], turn, SPEED, 0.0, SPEED / RADIUS)


def drive(target, until, jump_at=math.inf, size=0.0, since=0, period=10):
    """INS every `period` ms, steering every 10 ms, 3 ms later."""
    for ms in range(since, until, period):
        target.add_ins(circle(ms, size if ms >= jump_at else 0.0))
        target.add_steering(T0 + (ms + 3) * MS, ANGLE)


def history():
    return MeasurementHistory(10.0, 0.1, 5.0)


@pytest.mark.parametrize("period", [4, 10, 50])
@pytest.mark.parametrize("size", SIZES)
def test_jump_is_found_at_its_time_and_nothing_is_interpolated_across_it(size, period):
    live = history()
    drive(live, 2000, 1000, size, period=period)
    assert (live.jump_count, live.last_jump.time_ns) == (1, T0 + 1000 * MS)
    assert live.last_jump.size == pytest.approx(size, abs=0.05)
    inside = T0 + 1000 * MS - 1
    assert live.ins_at(inside) is None
    assert np.isnan(live.ins.sample(np.array([inside]))).all()
    assert live.ins.newest_known_time(inside) == T0 + (1000 - period) * MS
    assert live.ins.describe_unknown(inside) == f"position jumps by {live.last_jump.size:.2f} m"
    assert live.ins_at(live.last_jump.time_ns) is not None


def test_jump_away_and_back_counts_as_two():
    live = history()
    for ms in range(0, 2000, 10):
        live.add_ins(circle(ms, 6.4 if 800 <= ms < 1200 else 0.0))
    assert (live.jump_count, live.last_jump.time_ns) == (2, T0 + 1200 * MS)


def test_jump_across_a_gap_is_found():
    live = history()
    drive(live, 1000)
    drive(live, 2000, 0, 640.0, since=1500)
    assert (live.jump_count, live.last_jump.time_ns) == (1, T0 + 1500 * MS)


@pytest.mark.parametrize("speed", [0.0, 5.0, 40.0])
def test_hard_driving_is_not_a_jump(speed):
    """Accelerations up to 1 g in any direction, sampling intervals of 4 to 500 ms."""
    draw = np.random.default_rng(1)
    live, x, y, v_x, yaw, t = history(), 0.0, 0.0, speed, 0.0, 0
    for _ in range(300):
        live.add_ins(InsSample(T0 + t * MS, x, y, yaw, v_x, 0.0, 0.0))
        interval = int(draw.choice([4, 10, 100, 500]))
        acceleration, rate = draw.uniform(-9.81, 9.81), draw.uniform(-9.81, 9.81) / max(v_x, 5.0)
        for _ in range(interval):
            x, y = x + 0.001 * v_x * math.cos(yaw), y + 0.001 * v_x * math.sin(yaw)
            v_x, yaw = max(0.0, v_x + 0.001 * acceleration), yaw + 0.001 * rate
        t += interval
    assert live.jump_count == 0


@pytest.mark.parametrize("deviation", [0.02, 0.2, 0.5])
def test_noise_is_not_a_jump_and_a_jump_is_found_in_noise(deviation):
    """RTK: 0.02 m; a receiver without RTK may scatter by decimetres between samples."""
    draw = np.random.default_rng(2)
    live = history()
    for ms in range(0, 4000, 10):
        live.add_ins(circle(ms, 6.4 if ms >= 3000 else 0.0, draw.normal(0.0, deviation, 2)))
    assert (live.jump_count, live.last_jump.time_ns) == (1, T0 + 3000 * MS)


def test_jumps_do_not_depend_on_the_order_of_arrival():
    samples = [circle(ms, 6.4 if ms >= 500 else 0.0) for ms in range(0, 1000, 10)]
    ordered, mixed = history(), history()
    for one in samples:
        ordered.add_ins(one)
    for k in range(0, len(samples), 2):
        mixed.add_ins(samples[k + 1])
        mixed.add_ins(samples[k])
    assert mixed.jump_count == ordered.jump_count == 1
    assert mixed.ins.breaks == ordered.ins.breaks


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("model", ["linear", augment("linear", ["speed_scale"])], ids=["plain", "with sensors"])
def test_no_prediction_starts_before_a_known_jump(leaf, model, size):
    predictor = Predictor(leaf, [model])
    drive(predictor, 1000)
    predictor.add_ins(circle(1000, size))
    start = predictor.find_start(T0 + 1005 * MS)  # the newest steering is of 993 ms
    assert isinstance(start, Skip) and start.kind == "stale"
    assert "position jumps by" in start.reason
    predictor.add_steering(T0 + 1003 * MS, ANGLE)
    start = predictor.find_start(T0 + 1006 * MS)
    assert isinstance(start, Start) and start.time_ns == T0 + 1000 * MS
    assert np.isfinite(predictor.run(start, predictor.models[0]).states).all()


@pytest.mark.parametrize("size", SIZES)
def test_scores_across_a_jump_are_incomplete_with_the_reason(leaf, size):
    settings = PredictionSettings(horizon=1.0)
    predictor, evaluator = Predictor(leaf, ["linear"], settings), Evaluator(leaf, settings)
    for begin in range(0, 4000, 100):
        for one in (predictor, evaluator):
            drive(one, begin + 100, 2000, size, since=begin)
        start = predictor.find_start(T0 + (begin + 100) * MS)
        if isinstance(start, Start):
            trajectory = predictor.run(start, "linear")
            evaluator.add_prediction("linear", start.time_ns, trajectory)
    scores = evaluator.poll()
    jump_ns = T0 + 2000 * MS
    across = [s for s in scores if s.start_ns < jump_ns <= s.start_ns + 1_000_000_000]
    assert len(across) >= 18 and not any(s.complete for s in across)
    for score in across:
        after = (jump_ns - score.start_ns) * 1e-9
        assert score.incomplete_reason.startswith("INS: position jumps by ")
        assert score.incomplete_reason.endswith(f" m at {after:.3f} s of the horizon")
        assert np.isfinite(score.lateral[score.horizon < after]).all()
        assert np.isnan(score.lateral[score.horizon > after]).all()
    others = [s for s in scores if s not in across]
    assert others and all(s.complete for s in others)
