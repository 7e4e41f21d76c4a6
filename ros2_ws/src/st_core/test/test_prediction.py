"""Live prediction: where a start lies, when there is none and why, and that it resumes by itself."""

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


def feed(predictor, ms_from, ms_to, steering=True, ins_too=True, speed=10.0):
    """100 Hz INS with steering 3 ms after each sample."""
    for ms in range(ms_from, ms_to, 10):
        if ins_too:
            predictor.add_ins(ins(ms, speed))
        if steering:
            predictor.add_steering(T0 + (ms + 3) * MS, 0.05 + 1e-5 * ms)


@pytest.fixture
def predictor(leaf):
    return Predictor(leaf, MODELS)


def now(ms):
    return T0 + round(ms * MS)


def reason(result) -> str:
    assert isinstance(result, Skip) and result.kind == "stale"
    return result.reason


def test_start_is_the_newest_instant_at_which_both_are_known(predictor, leaf):
    feed(predictor, 0, 500)
    start = predictor.find_start(now(500))
    assert start.time_ns == T0 + 490 * MS  # INS is the older of the two
    assert start.inputs.road_wheel_angle == pytest.approx(0.05 + 1e-5 * 487)
    assert start.inputs.velocity_x_dot == pytest.approx(0.0, abs=1e-9)
    predictor.add_ins(ins(500))
    start = predictor.find_start(now(505))
    assert start.time_ns == T0 + 493 * MS  # now steering is
    assert start.state.x == pytest.approx(4.93 - leaf.cg_to_ins_x)
    assert start.state.velocity_y == pytest.approx(0.1 * 0.398)


def test_trajectories_start_at_the_start(predictor, leaf):
    feed(predictor, 0, 500)
    start = predictor.find_start(now(500))
    for model in MODELS:
        path = predictor.run(start, model)
        assert path.states.shape == (101, 6) and path.time[-1] == pytest.approx(5.0)
        np.testing.assert_array_equal(path.states[0], start.state.as_tuple())
        np.testing.assert_array_equal(path.states, predict(model, leaf, start.state, start.inputs).states)


def test_nothing_received_yet(predictor):
    assert reason(predictor.find_start(now(0))) == "INS: nothing received yet"
    predictor.add_ins(ins(0))
    assert reason(predictor.find_start(now(0))) == "steering: nothing received yet"
    assert predictor.ages(now(50)) == {"INS": pytest.approx(0.05), "steering": math.inf}


def test_silence_names_the_signal_and_its_age_and_ends_by_itself(predictor):
    feed(predictor, 0, 500)
    feed(predictor, 500, 1000, steering=False)
    assert reason(predictor.find_start(now(1000))) == "steering: newest sample is 0.51 s old (limit 0.2 s)"
    feed(predictor, 1000, 1500, ins_too=False)
    assert reason(predictor.find_start(now(1500))) == "INS: newest sample is 0.51 s old (limit 0.2 s)"
    feed(predictor, 1500, 1600)
    assert isinstance(predictor.find_start(now(1600)), Start)


def test_short_silence_uses_the_last_common_instant(predictor):
    feed(predictor, 0, 500)
    feed(predictor, 500, 650, steering=False)
    assert predictor.find_start(now(650)).time_ns == T0 + 493 * MS


def test_a_gap_is_not_bridged(predictor):
    feed(predictor, 0, 500)
    predictor.add_ins(ins(640))
    predictor.add_steering(now(600), 0.05)
    # INS is not known between 490 and 640 ms; 490 ms itself is, and is not too old yet.
    assert predictor.find_start(now(650)).time_ns == T0 + 490 * MS
    assert reason(predictor.find_start(now(700))) == (
        "INS: gap of 0.150 s at the newest common instant, last known 0.21 s ago")


def test_after_a_gap_the_acceleration_takes_one_more_sample(predictor):
    feed(predictor, 0, 500)
    predictor.add_ins(ins(1000))
    for ms in (990, 1000, 1010):
        predictor.add_steering(now(ms), 0.05)
    assert reason(predictor.find_start(now(1010))) == (
        "INS: forward acceleration not known yet, only one sample since a gap")
    predictor.add_ins(ins(1010))
    assert isinstance(predictor.find_start(now(1010)), Start)


def test_clocks_that_disagree_are_said_so(predictor):
    feed(predictor, 0, 500)
    assert reason(predictor.find_start(now(-2000))) == "INS: newest sample is 2.49 s in the future; the clocks disagree"


def test_signals_on_different_clocks_have_no_common_instant(leaf):
    predictor = Predictor(leaf, MODELS, PredictionSettings(stale_after=5.0))
    feed(predictor, 0, 500, steering=False)
    feed(predictor, 3000, 3500, ins_too=False)
    assert "begins 2.513 s after" in reason(predictor.find_start(now(3500)))


@pytest.mark.parametrize(("speed", "starts"), [(0.0, False), (0.49, False), (0.51, True), (-0.6, True)])
def test_below_the_minimum_speed_there_is_no_prediction(leaf, speed, starts):
    predictor = Predictor(replace(leaf, cg_to_ins_x=0.0), MODELS)
    feed(predictor, 0, 500, speed=speed)
    result = predictor.find_start(now(500))
    assert isinstance(result, Start) == starts
    if not starts:
        assert result.kind == "slow"
        assert result.reason == f"speed {speed:.2f} m/s is below 0.5 m/s"


def test_invalid_samples_lead_to_staleness_not_to_nan(predictor):
    feed(predictor, 0, 500)
    for ms in range(500, 1000, 10):
        assert not predictor.add_ins(ins(ms, velocity_y=math.nan))
        predictor.add_steering(now(ms), 0.05)
    assert reason(predictor.find_start(now(1000))).startswith("INS: newest sample is 0.51 s old")


@pytest.mark.parametrize("jump_ms", [-3_600_000, -2_000, 2_000, 3_600_000])
def test_time_may_jump_and_prediction_resumes(predictor, jump_ms):
    feed(predictor, 0, 1000)
    assert isinstance(predictor.find_start(now(1000)), Start)
    for ms in range(0, 300, 10):
        predictor.add_ins(ins(1000 + jump_ms + ms))
        predictor.add_steering(now(1000 + jump_ms + ms), 0.07)
    start = predictor.find_start(now(1300 + jump_ms))
    assert isinstance(start, Start)
    assert start.time_ns == now(1290 + jump_ms)
    assert start.inputs.road_wheel_angle == 0.07


def test_order_duplicates_and_lateness_do_not_change_the_start(leaf):
    straight, mixed = Predictor(leaf, MODELS), Predictor(leaf, MODELS)
    samples = [ins(ms, 10.0 + math.sin(0.01 * ms)) for ms in range(0, 1000, 10)]
    for sample in samples:
        straight.add_ins(sample)
    random = np.random.default_rng(5)
    order = sorted(range(100), key=lambda i: i + random.uniform(0.0, 6.0))
    for i in order:
        mixed.add_ins(samples[i])
        mixed.add_ins(samples[i])
    for predictor in (straight, mixed):
        for ms in range(0, 990, 10):
            predictor.add_steering(now(ms), 0.05)
    assert order != sorted(order)
    assert mixed.find_start(now(1000)) == straight.find_start(now(1000))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.integers(-3000, 3000), st.sampled_from([0.0, 0.2, 9.0, math.nan, 1e308]))))
def test_no_input_makes_it_raise(leaf, events):
    predictor = Predictor(leaf, MODELS)
    for is_ins, ms, value in events:
        if is_ins:
            predictor.add_ins(ins(ms, value))
        else:
            predictor.add_steering(now(ms), value)
        result = predictor.find_start(now(ms))
        assert isinstance(result, Start | Skip)
        if isinstance(result, Start):
            predictor.run(result, "nonlinear")


def test_settings_and_models_are_checked(leaf):
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
    only = Predictor(leaf, ["linear"])
    feed(only, 0, 500)
    with pytest.raises(ConfigurationError, match="'kinematic' is not configured; the models are linear"):
        only.run(only.find_start(now(500)), "kinematic")


@pytest.mark.parametrize(("horizon", "step", "steps"),
                         [(5.0, 0.05, 100), (0.3, 0.1, 3), (7.0, 0.07, 100), (10.0, 0.001, 10000)])
def test_steps_are_counted_past_rounding(horizon, step, steps):
    assert step_count(horizon, step) == steps


def test_configuration_hash_knows_vehicle_and_settings(leaf):
    base = configuration_hash(leaf, PredictionSettings())
    assert base == configuration_hash(replace(leaf, name="other"), PredictionSettings())
    others = {configuration_hash(replace(leaf, mass=1600.0), PredictionSettings())}
    others |= {configuration_hash(leaf, PredictionSettings(**{key: value})) for key, value in
               {"horizon": 4.0, "step": 0.1, "minimum_speed": 1.0, "stale_after": 0.3, "maximum_gap": 0.2,
                "filter_cutoff": 4.0}.items()}
    assert len(others) == 7 and base not in others


def test_inputs_of_the_wrong_length_are_refused(leaf):
    state = VehicleState(0.0, 0.0, 10.0, 0.0, 0.0, 0.0)
    with pytest.raises(StCoreError, match=r"velocity_x_dot: shape \(101,\), not \(201,\)"):
        predict("linear", leaf, state, InputSequence(np.zeros(201), np.zeros(101)))
    with pytest.raises(StCoreError, match="road_wheel_angle: shape"):
        predict("linear", leaf, state, InputSequence(np.zeros(3), np.zeros(201)))


def test_integers_are_as_good_as_floats(leaf):
    whole = predict("nonlinear", leaf, VehicleState(0, 0, 10, 0, 0, 0), ControlInput(0, 1))
    floats = predict("nonlinear", leaf, VehicleState(0.0, 0.0, 10.0, 0.0, 0.0, 0.0), ControlInput(0.0, 1.0))
    np.testing.assert_array_equal(whole.states, floats.states)
