"""Live prediction: time of the start, reasons for having none, and resumption after faults."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from st_core.errors import ConfigurationError, StCoreError
from st_core.prediction import (
    PredictionSettings,
    Predictor,
    Skip,
    Start,
    configuration_hash,
    predict,
    step_count,
)
from st_core.types import ControlInput, InputSequence, InsSample, VehicleState

MS = 1_000_000
T0 = 1_700_000_000_000_000_000
MODELS = ("kinematic", "linear", "nonlinear")


def ins(ms: float, speed: float = 10.0, **changes) -> InsSample:
    return InsSample(T0 + round(ms * MS), 0.001 * ms * speed, 2.0, 0.0, speed, 0.0, 0.1)._replace(**changes)


def feed(predictor, ms_from, ms_to, steering=True, with_ins=True, speed=10.0):
    """100 Hz INS with steering 3 ms after each sample."""
    for ms in range(ms_from, ms_to, 10):
        if with_ins:
            predictor.add_ins(ins(ms, speed))
        if steering:
            predictor.add_steering(T0 + (ms + 3) * MS, 0.05 + 1e-5 * ms)


@pytest.fixture
def predictor(leaf):
    return Predictor(leaf, MODELS)


def time_at(ms):
    return T0 + round(ms * MS)


def reason(result) -> str:
    assert isinstance(result, Skip) and result.kind == "stale"
    return result.reason


def test_start_is_the_newest_instant_with_both_signals(predictor, leaf):
    feed(predictor, 0, 500)
    start = predictor.find_start(time_at(500))
    assert start.time_ns == T0 + 490 * MS  # the newest INS sample is older
    assert start.inputs.road_wheel_angle == pytest.approx(0.05 + 1e-5 * 487)
    assert start.inputs.velocity_x_dot == pytest.approx(0.0, abs=1e-9)
    predictor.add_ins(ins(500))
    start = predictor.find_start(time_at(505))
    assert start.time_ns == T0 + 493 * MS  # now the newest steering sample is older
    assert start.state.x == pytest.approx(4.93 - leaf.cg_to_ins_x)
    assert start.state.velocity_y == pytest.approx(0.1 * 0.398)


def test_trajectories_begin_at_the_start_state(predictor, leaf):
    feed(predictor, 0, 500)
    start = predictor.find_start(time_at(500))
    for model in MODELS:
        path = predictor.run(start, model)
        assert path.states.shape == (101, 6) and path.time[-1] == pytest.approx(5.0)
        np.testing.assert_array_equal(path.states[0], start.state.as_tuple())
        np.testing.assert_array_equal(path.states, predict(model, leaf, start.state, start.inputs).states)


def test_no_start_before_both_signals_are_received(predictor):
    assert reason(predictor.find_start(time_at(0))) == "INS: nothing received yet"
    predictor.add_ins(ins(0))
    assert reason(predictor.find_start(time_at(0))) == "steering: nothing received yet"
    assert predictor.ages(time_at(50)) == {"INS": pytest.approx(0.05), "steering": math.inf}


def test_stale_signal_is_named_with_its_age_until_it_resumes(predictor):
    feed(predictor, 0, 500)
    feed(predictor, 500, 1000, steering=False)
    assert reason(predictor.find_start(time_at(1000))) == "steering: newest sample is 0.51 s old (limit 0.2 s)"
    feed(predictor, 1000, 1500, with_ins=False)
    assert reason(predictor.find_start(time_at(1500))) == "INS: newest sample is 0.51 s old (limit 0.2 s)"
    feed(predictor, 1500, 1600)
    assert isinstance(predictor.find_start(time_at(1600)), Start)


def test_short_dropout_starts_at_the_last_common_instant(predictor):
    feed(predictor, 0, 500)
    feed(predictor, 500, 650, steering=False)
    assert predictor.find_start(time_at(650)).time_ns == T0 + 493 * MS


def test_gap_is_not_interpolated(predictor):
    feed(predictor, 0, 500)
    predictor.add_ins(ins(640))
    predictor.add_steering(time_at(600), 0.05)
    # INS is unknown between 490 and 640 ms; 490 ms itself is known and not stale yet.
    assert predictor.find_start(time_at(650)).time_ns == T0 + 490 * MS
    assert reason(predictor.find_start(time_at(700))) == (
        "INS: gap of 0.150 s at the newest common instant, last known 0.21 s ago")


def test_acceleration_after_a_gap_needs_a_second_sample(predictor):
    feed(predictor, 0, 500)
    predictor.add_ins(ins(1000))
    for ms in (990, 1000, 1010):
        predictor.add_steering(time_at(ms), 0.05)
    assert reason(predictor.find_start(time_at(1010))) == (
        "INS: forward acceleration unknown at the first sample or after a gap")
    predictor.add_ins(ins(1010))
    assert isinstance(predictor.find_start(time_at(1010)), Start)


def test_clock_disagreement_is_reported(predictor):
    feed(predictor, 0, 500)
    assert reason(predictor.find_start(time_at(-2000))) == (
        "INS: newest sample is 2.49 s in the future; the clocks disagree")


def test_signals_on_different_clocks_have_no_common_instant(leaf):
    predictor = Predictor(leaf, MODELS, PredictionSettings(stale_after=5.0))
    feed(predictor, 0, 500, steering=False)
    feed(predictor, 3000, 3500, with_ins=False)
    assert "begins 2.513 s later" in reason(predictor.find_start(time_at(3500)))


@pytest.mark.parametrize(("speed", "starts"), [(0.0, False), (0.49, False), (0.51, True), (-0.6, True)])
def test_no_start_below_the_minimum_speed(leaf, speed, starts):
    predictor = Predictor(replace(leaf, cg_to_ins_x=0.0), MODELS)
    feed(predictor, 0, 500, speed=speed)
    result = predictor.find_start(time_at(500))
    assert isinstance(result, Start) == starts
    if not starts:
        assert result.kind == "slow"
        assert result.reason == f"speed {speed:.2f} m/s is below 0.5 m/s"


def test_invalid_samples_are_dropped_until_the_signal_is_stale(predictor):
    feed(predictor, 0, 500)
    for ms in range(500, 1000, 10):
        assert not predictor.add_ins(ins(ms, velocity_y=math.nan))
        predictor.add_steering(time_at(ms), 0.05)
    assert reason(predictor.find_start(time_at(1000))).startswith("INS: newest sample is 0.51 s old")


@pytest.mark.parametrize("jump_ms", [-3_600_000, -2_000, 2_000, 3_600_000])
def test_prediction_resumes_after_a_time_jump(predictor, jump_ms):
    feed(predictor, 0, 1000)
    assert isinstance(predictor.find_start(time_at(1000)), Start)
    for ms in range(0, 300, 10):
        predictor.add_ins(ins(1000 + jump_ms + ms))
        predictor.add_steering(time_at(1000 + jump_ms + ms), 0.07)
    start = predictor.find_start(time_at(1300 + jump_ms))
    assert isinstance(start, Start)
    assert start.time_ns == time_at(1290 + jump_ms)
    assert start.inputs.road_wheel_angle == 0.07


def test_reordered_and_duplicate_samples_do_not_change_the_start(leaf):
    in_order, reordered = Predictor(leaf, MODELS), Predictor(leaf, MODELS)
    samples = [ins(ms, 10.0 + math.sin(0.01 * ms)) for ms in range(0, 1000, 10)]
    for sample in samples:
        in_order.add_ins(sample)
    random = np.random.default_rng(5)
    order = sorted(range(100), key=lambda i: i + random.uniform(0.0, 6.0))
    for i in order:
        reordered.add_ins(samples[i])
        reordered.add_ins(samples[i])
    for predictor in (in_order, reordered):
        for ms in range(0, 990, 10):
            predictor.add_steering(time_at(ms), 0.05)
    assert order != sorted(order)
    assert reordered.find_start(time_at(1000)) == in_order.find_start(time_at(1000))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.integers(-3000, 3000), st.sampled_from([0.0, 0.2, 9.0, math.nan, 1e308]))))
def test_arbitrary_samples_never_raise(leaf, events):
    predictor = Predictor(leaf, MODELS)
    for is_ins, ms, value in events:
        if is_ins:
            predictor.add_ins(ins(ms, value))
        else:
            predictor.add_steering(time_at(ms), value)
        result = predictor.find_start(time_at(ms))
        assert isinstance(result, Start | Skip)
        if isinstance(result, Start):
            predictor.run(result, "nonlinear")


def test_invalid_settings_and_models_are_rejected(leaf):
    with pytest.raises(ConfigurationError, match=r"stale_after: -1 s is outside 0.001 to 10 s"):
        PredictionSettings(stale_after=-1.0)
    with pytest.raises(ConfigurationError, match="filter_cutoff: nan Hz is outside"):
        PredictionSettings(filter_cutoff=math.nan)
    with pytest.raises(ConfigurationError, match=r"horizon: 5 s is not a whole number of steps of 0.03 s"):
        PredictionSettings(step=0.03)
    with pytest.raises(ConfigurationError, match="models: empty"):
        Predictor(leaf, [])
    with pytest.raises(ConfigurationError, match="unknown model 'cubic'"):
        Predictor(leaf, ["linear", "cubic"])
    linear_only = Predictor(leaf, ["linear"])
    feed(linear_only, 0, 500)
    with pytest.raises(ConfigurationError, match="'kinematic' is not configured; the models are linear"):
        linear_only.run(linear_only.find_start(time_at(500)), "kinematic")


@pytest.mark.parametrize(("horizon", "step", "steps"),
                         [(5.0, 0.05, 100), (0.3, 0.1, 3), (7.0, 0.07, 100), (10.0, 0.001, 10000)])
def test_step_count_tolerates_rounding(horizon, step, steps):
    assert step_count(horizon, step) == steps


def test_configuration_hash_depends_on_vehicle_and_settings(leaf):
    base = configuration_hash(leaf, PredictionSettings())
    assert base == configuration_hash(replace(leaf, name="other"), PredictionSettings())
    changed = {configuration_hash(replace(leaf, mass=1600.0), PredictionSettings())}
    changed |= {configuration_hash(leaf, PredictionSettings(**{key: value})) for key, value in
               {"horizon": 4.0, "step": 0.1, "minimum_speed": 1.0, "stale_after": 0.3, "maximum_gap": 0.2,
                "filter_cutoff": 4.0}.items()}
    assert len(changed) == 7 and base not in changed


def test_inputs_of_the_wrong_length_are_rejected(leaf):
    state = VehicleState(0.0, 0.0, 10.0, 0.0, 0.0, 0.0)
    with pytest.raises(StCoreError, match=r"velocity_x_dot: shape \(101,\), not \(201,\)"):
        predict("linear", leaf, state, InputSequence(np.zeros(201), np.zeros(101)))
    with pytest.raises(StCoreError, match="road_wheel_angle: shape"):
        predict("linear", leaf, state, InputSequence(np.zeros(3), np.zeros(201)))
    with pytest.raises(ConfigurationError, match="substeps: 0 is below 1"):
        predict("linear", leaf, state, ControlInput(0.0, 0.0), substeps=0)


def test_integers_predict_the_same_as_floats(leaf):
    integers = predict("nonlinear", leaf, VehicleState(0, 0, 10, 0, 0, 0), ControlInput(0, 1))
    floats = predict("nonlinear", leaf, VehicleState(0.0, 0.0, 10.0, 0.0, 0.0, 0.0), ControlInput(0.0, 1.0))
    np.testing.assert_array_equal(integers.states, floats.states)
