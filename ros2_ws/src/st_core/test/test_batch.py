"""Batches over a log equal individual predictions and the live evaluator, for any starts, in bounded memory."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from batched import predict_log
from st_core import batch as batch_module
from st_core import integrate
from st_core.augmented import augment
from st_core.backends import get_backend, has_numba
from st_core.batch import LogBatch, plan_blocks
from st_core.errors import ConfigurationError
from st_core.evaluation import Evaluator
from st_core.integrate import StepTooLongWarning
from st_core.log import DriveLog, LogSignals
from st_core.models import MODELS
from st_core.prediction import PredictionSettings, predict
from st_core.readings import correct_log
from st_core.types import ControlInput, InputSequence, InsSample, Trajectory, VehicleState

T0, MS = 1_700_000_000_000_000_000, 1_000_000
BACKENDS = ["numpy", pytest.param("lanes", marks=pytest.mark.skipif(not has_numba(), reason="numba is not installed"))]


def drive(seconds=20.0, rate=100, mean_speed=8.0) -> DriveLog:
    """Weaving; INS and steering at separate jittered times, a gap in the INS at 12 s and in the steering at 15 s."""
    draw = np.random.default_rng(2)
    time = np.cumsum(draw.uniform(0.8, 1.2, int(seconds * rate)) / rate)
    steering = np.cumsum(draw.uniform(0.015, 0.025, int(seconds * 50)))
    time, steering = time[(time < 12.0) | (time > 12.3)], steering[(steering < 15.0) | (steering > 15.4)]
    speed, yaw_rate = mean_speed + 2.0 * np.sin(0.5 * time), 0.25 * np.sin(0.8 * time)
    dt = np.diff(time, prepend=0.0)
    yaw = np.cumsum(yaw_rate * dt)
    angle = 2.7 / 8.0 * 0.25 * np.sin(0.8 * steering)
    return DriveLog("weaving", T0 + np.round(time * 1e9).astype(np.int64), np.cumsum(speed * np.cos(yaw) * dt),
                    np.cumsum(speed * np.sin(yaw) * dt), yaw, speed, -0.1 * yaw_rate, yaw_rate,
                    T0 + np.round(steering * 1e9).astype(np.int64), angle)


@pytest.fixture(scope="module")
def log():
    return drive()


def regular_starts(first_ms, count, step_ms=100):
    return T0 + MS * (first_ms + step_ms * np.arange(count))


def predict_individually(model, car, log, start_ns, horizon, constant=False, step=0.05):
    """(points, 6) by `predict`, from inputs sampled for this start alone."""
    signals = LogSignals(correct_log(model, log), 0.1, 5.0)
    times = start_ns + np.round(np.arange(2 * round(horizon / step) + 1) * 0.5 * step * 1e9).astype(np.int64)
    angle, acceleration = signals.road_wheel_angle_at(times), signals.ins_at(times, "velocity_x_dot")[0]
    inputs = ControlInput(angle[0], acceleration[0]) if constant else InputSequence(angle, acceleration)
    state = VehicleState(*signals.states_at(times[:1], model.effective_vehicle(car))[0])
    return predict(model, car, state, inputs, horizon, step).states


STARTS = {
    "regular": regular_starts(500, 40),
    "with gaps": np.delete(regular_starts(500, 80), [3, 4, 5, 20, 50]),
    "in two parts": np.concatenate([regular_starts(500, 30), regular_starts(9037, 30)]),
    "irregular": T0 + np.array([500, 533, 534, 1700, 2001, 6789]) * MS + 123_457,
    "unsorted with duplicates": regular_starts(500, 10)[[4, 2, 2, 9, 0]],
    "single": regular_starts(700, 1),
    "beyond the log": regular_starts(-200, 5, 10_000),
    "none": regular_starts(500, 0),
}


@pytest.mark.parametrize("inputs", ["measured", "held"])
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("starts", STARTS.values(), ids=STARTS.keys())
def test_any_starts_equal_individual_predictions(leaf, log, backend, inputs, starts):
    for name in ("linear", "nonlinear"):
        paths = predict_log(name, leaf, log, starts, 2.0, inputs=inputs, backend=backend)
        assert paths.shape == (len(starts), 41, 6)
        for start, states in zip(starts.tolist(), paths, strict=True):
            expected = predict_individually(MODELS[name], leaf, log, start, 2.0, inputs == "held")
            np.testing.assert_allclose(states, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_only_requested_points_are_returned(leaf, log, backend):
    starts = regular_starts(500, 30)
    whole = predict_log("nonlinear", leaf, log, starts, 3.0, backend=backend)
    some = predict_log("nonlinear", leaf, log, starts, 3.0, points=(0.5, 1.0, 3.0), backend=backend)
    np.testing.assert_array_equal(some, whole[:, [10, 20, 60]])


@pytest.mark.parametrize("backend", BACKENDS)
def test_hindsight_errors_equal_those_of_the_live_evaluator(leaf, log, backend):
    settings = PredictionSettings(horizon=2.0)
    evaluator = Evaluator(leaf, settings)
    for row in zip(log.ins_time_ns.tolist(), *(getattr(log, n).tolist() for n in InsSample._fields[1:]), strict=True):
        evaluator.add_ins(InsSample(*row))
    for row in zip(log.steering_time_ns.tolist(), log.road_wheel_angle.tolist(), strict=True):
        evaluator.add_steering(*row)
    starts = np.concatenate([regular_starts(600, 120), T0 + np.array([1_234_567_891, 7_000_000_007])])
    batch = LogBatch(log, starts, 2.0, backend=backend)
    states = batch.signals.states_at(starts, leaf)
    for name in MODELS:
        for start, state in zip(starts.tolist(), states, strict=True):
            evaluator.add_prediction(name, start, Trajectory(0.05, np.vstack([state, np.zeros((40, 6))])))
    scores = {(s.model, s.start_ns): s for s in evaluator.flush() if s.mode == "hindsight"}
    complete = 0
    for name in MODELS:
        errors = batch.errors(name, leaf)
        for start, error in zip(starts.tolist(), errors, strict=True):
            score = scores[name, start]
            live = np.stack([score.longitudinal, score.lateral, score.yaw], axis=-1)
            np.testing.assert_allclose(error, live, rtol=0.0, atol=1e-9)
            complete += score.complete
    assert 200 < complete < len(scores)  # some are incomplete because of the gaps


@pytest.mark.parametrize("backend", BACKENDS)
def test_model_with_extra_states_equals_individual_predictions(leaf, log, backend):
    """Effects on vehicle, steering and sensors: test_effects_logs.py."""
    model, starts = augment("linear", ["tyre_relaxation"]), regular_starts(700, 12)
    batch = LogBatch(log, starts, 2.0, backend=backend)
    paths, plain = batch.predict(model, leaf), batch.predict("linear", leaf)
    for start, states in zip(starts.tolist(), paths, strict=True):
        np.testing.assert_allclose(states, predict_individually(model, leaf, log, start, 2.0), rtol=1e-12, atol=1e-12)
    assert np.abs(paths - plain).max() > 1e-3


@pytest.mark.parametrize("backend", BACKENDS)
def test_block_size_does_not_change_the_result(leaf, log, backend, monkeypatch):
    starts = [regular_starts(500, 150), regular_starts(500, 150) + np.arange(150)]
    whole = [predict_log("linear", leaf, log, s, 1.0, backend=backend) for s in starts]
    monkeypatch.setattr(batch_module, "MAX_BLOCK_COLUMNS", 20)
    monkeypatch.setattr(batch_module, "MAX_BLOCK_INSTANTS", 500)
    for s, expected in zip(starts, whole, strict=True):
        states = predict_log("linear", leaf, log, s, 1.0, backend=backend)
        np.testing.assert_allclose(states, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_models_with_different_substeps_have_their_own_samples(leaf, log, monkeypatch):
    """The first blocks of both models have the same number of instants, for five and for two starts."""
    monkeypatch.setattr(batch_module, "MAX_BLOCK_INSTANTS", 800)
    monkeypatch.setattr(integrate, "required_substeps", lambda model, *_: 1 if model.name == "kinematic" else 2)
    starts = regular_starts(1000, 6, 400)
    together = LogBatch(log, starts, 0.5, 0.005, substeps="auto", backend="numpy")
    together.predict("kinematic", leaf)
    alone = LogBatch(log, starts, 0.5, 0.005, substeps=2, backend="numpy")
    np.testing.assert_array_equal(together.predict("linear", leaf), alone.predict("linear", leaf))


def test_memory_per_start_is_bounded(leaf):
    def peak(log):
        signals = LogSignals(log, 0.1, 5.0)
        starts = np.arange(log.start_ns + 10**9, log.end_ns - 6 * 10**9, 50 * MS)
        tracemalloc.start()
        predict_log("nonlinear", leaf, signals, starts, points=(5.0,), backend="numpy")
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top, len(starts)

    (short, few), (long, many) = peak(drive(1000.0, 20)), peak(drive(3000.0, 20))
    # 100 bytes per start in and out, twice while they are concatenated, and 2 x 16 for the inputs on the grid;
    # separate input windows would need 9 x 201 x 8 = 14 kB per start.
    assert many - few > 35_000
    assert long - short < 400 * (many - few)


def test_separate_instants_of_many_starts_are_not_stored(log):
    """Those of one hour with ten starts per second would need 290 MB at a step of 5 ms."""
    batch = LogBatch(log, regular_starts(500, batch_module.MAX_BLOCK_COLUMNS + 1, 1), 5.0, backend="numpy")
    tracemalloc.start()
    counts = [block.count for block in batch._plan_blocks(1, False)]
    current, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert sum(counts) == batch_module.MAX_BLOCK_COLUMNS + 1 and current < 1e6 and peak < 8e6  # of 13 MB


def test_substeps_reduce_the_error_and_equal_shorter_steps(leaf, log):
    starts = regular_starts(700, 20)
    errors = []
    exact = predict_log("linear", leaf, log, starts, 1.0, substeps=16)
    for count in (1, 2):
        divided = predict_log("linear", leaf, log, starts, 1.0, substeps=count)
        assert divided.shape == (20, 21, 6)
        errors.append(np.abs(divided - exact).max())
    assert errors[1] < 0.3 * errors[0]  # sampled inputs are not smooth: below order 4
    expected = predict_individually(MODELS["linear"], leaf, log, int(starts[3]), 1.0, step=0.025)
    np.testing.assert_allclose(predict_log("linear", leaf, log, starts, 1.0, substeps=2)[3], expected[::2],
                               rtol=1e-12, atol=1e-12)


def test_too_long_step_is_a_warning_or_is_divided(leaf, monkeypatch):
    monkeypatch.setattr(integrate, "_issued_warnings", set())
    stiff, slow_log, starts = replace(leaf, minimum_slip_speed=0.1), drive(mean_speed=3.5), regular_starts(700, 20)
    with pytest.warns(StepTooLongWarning, match=r"minimum_slip_speed of 2\.7 m/s in .* or substeps=2") as caught:
        for _ in range(2):
            coarse = predict_log("linear", stiff, slow_log, starts)
    assert len(caught) == 1
    divided = predict_log("linear", stiff, slow_log, starts, substeps="auto")
    np.testing.assert_array_equal(divided, predict_log("linear", stiff, slow_log, starts, substeps=2))
    fine = predict_log("linear", stiff, slow_log, starts, substeps=16)
    assert np.nanmax(np.abs(divided - fine)) < 0.1 * np.nanmax(np.abs(coarse - fine))


def test_model_receives_its_additional_signals(leaf, log):
    base = MODELS["linear"]

    def inputs(angle, acceleration, p, correction):
        return base.inputs(angle + correction, acceleration, p)

    model, starts = replace(base, name="corrected", inputs=inputs, signals=("correction",)), regular_starts(700, 10)
    time = np.arange(T0, T0 + 20 * 10**9, 10 * MS)
    with pytest.raises(ConfigurationError, match="model corrected needs the signal correction, which was not given"):
        predict_log(model, leaf, log, starts)
    states = predict_log(model, leaf, log, starts, 2.0, signals={"correction": (time, np.full(len(time), 0.01))})
    shifted = replace(log, road_wheel_angle=log.road_wheel_angle + 0.01)
    np.testing.assert_allclose(states, predict_log("linear", leaf, shifted, starts, 2.0), atol=1e-12)


@pytest.mark.parametrize(("arguments", "message"), [
    ({"points": (0.51,)}, r"points: \[0.51\] are not increasing multiples of 0.05 s within the horizon of 5 s"),
    ({"points": (5.05,)}, "within the horizon"), ({"points": (2.0, 1.0)}, "increasing"), ({"points": ()}, "points"),
    ({"horizon": 1.01}, "horizon: 1.01 s is not a whole number of steps"),
    ({"inputs": "guessed"}, "inputs: 'guessed' is neither measured nor held"),
    ({"substeps": 0}, "substeps: 0 is neither auto nor an integer from 1 to 64"), ({"substeps": 1.5}, "substeps: 1.5"),
    ({"backend": "gpu"}, "unknown backend 'gpu'"),
])
def test_invalid_arguments_are_rejected(leaf, log, arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        predict_log("linear", leaf, log, regular_starts(500, 3), **arguments)


def test_predictions_from_an_empty_log_are_nan(leaf):
    values, times_ns = np.empty(0), np.empty(0, np.int64)
    empty = DriveLog("empty", times_ns, *[values] * 6, times_ns, values)
    states = predict_log("linear", leaf, empty, regular_starts(0, 3), 1.0)
    assert states.shape == (3, 21, 6) and np.isnan(states).all()


def test_starts_on_a_common_grid_share_its_instants():
    instants = 25 * MS * np.arange(201)
    block, = plan_blocks(regular_starts(0, 1000), instants, 1)
    assert block.is_shared and block.spacing == 4 and len(block.times_ns) == 4 * (1000 + 50)
    block, = plan_blocks(np.delete(regular_starts(0, 1000), slice(100, 140)), instants, 1)
    assert block.is_shared and block.count == 1000 and len(block.start_columns) == 960
    blocks = list(plan_blocks(regular_starts(0, 1000) + np.arange(1000), instants, 1))
    assert not any(b.is_shared for b in blocks) and sum(b.count for b in blocks) == 1000
    assert max(b.times_ns.size for b in blocks) <= batch_module.MAX_BLOCK_INSTANTS
    hours_apart = np.concatenate([regular_starts(0, 1000), regular_starts(10**7 + 3, 1000)])
    block, = plan_blocks(hours_apart, instants, 48)
    assert block.is_shared and block.count == 1000 + 50 + 1000
    two_rates = np.concatenate([regular_starts(0, 1000), regular_starts(10**7 + 3, 1000)[::2]])
    assert all(b.is_shared for b in plan_blocks(two_rates, instants, 48))
    assert list(plan_blocks(np.empty(0, np.int64), instants, 1)) == []
    for b in (b for starts in (hours_apart, two_rates, regular_starts(0, 20_000))
              for b in plan_blocks(starts, instants, 48)):
        times = b.times_ns
        for k in (0, 1, 77, 200):
            np.testing.assert_array_equal(times[b.offsets[k] + b.start_columns],
                                          b.starts_ns[b.start_columns] + instants[k])


@pytest.mark.skipif(not has_numba(), reason="numba is not installed")
def test_numba_lanes_are_the_default_backend():
    assert get_backend().__name__ == "st_core.backends.numba_lanes"


def test_sparse_starts_with_long_horizons_are_covered_once():
    """The common grid between two of these starts is longer than a block."""
    instants_ns = 25 * MS * np.arange(2 * batch_module.MAX_BLOCK_COLUMNS + 2)
    starts_ns = T0 + 25 * MS * np.array([0, 1, 2 * batch_module.MAX_BLOCK_COLUMNS + 1])
    for lanes in (1, 4 * batch_module.MAX_BLOCK_COLUMNS):  # the latter permits the shared grid
        blocks = list(plan_blocks(starts_ns, instants_ns, lanes))
        assert [block.rows.start for block in blocks] == [0, *(block.rows.stop for block in blocks[:-1])]
        assert np.array_equal(np.concatenate([block.starts_ns[block.start_columns] for block in blocks]), starts_ns)
