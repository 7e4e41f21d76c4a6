"""Effects on vehicle, steering and sensors: batches over a log equal individual predictions on Python floats."""

import functools
import itertools

import numpy as np
import pytest
from effect_values import values_of
from st_core.augmented import augment, set_effects_to_null
from st_core.batch import LogBatch
from st_core.effects import EFFECTS, find_applicable_effects
from st_core.log import INS_SIGNALS, LogSignals
from st_core.models import MODELS
from st_core.prediction import predict
from st_core.readings import correct_log
from st_core.timeseries import NANOSECOND
from st_core.types import InputSequence, VehicleState
from weaving_log import weaving_log

SHARES = (0.4, 2.0)
HORIZON, STEP = 2.0, 0.05


LOG = weaving_log()
STARTS = np.array([1_000_000_000, 1_500_000_000, 2_100_000_000, 3_333_000_000, 5_900_000_000])


def list_effects(base) -> list[str]:
    """Effects that act outside the equations of motion."""
    return [name for name in find_applicable_effects(base)
            if EFFECTS[name].vehicle or EFFECTS[name].steering or EFFECTS[name].observe]


@functools.cache  # the same for every backend
def predict_individually(base, name, share, car) -> np.ndarray:
    model = augment(base, {name: values_of(name, share)})
    signals = LogSignals(correct_log(model, LOG), 0.1, 5.0)
    half_steps = np.round(np.arange(2 * round(HORIZON / STEP) + 1) * 0.5 * STEP / NANOSECOND).astype(np.int64)
    states = signals.states_at(STARTS, model.effective_vehicle(car))
    paths = []
    for start_ns, state in zip(STARTS, states, strict=True):
        times = start_ns + half_steps
        inputs = InputSequence(signals.road_wheel_angle_at(times), signals.ins_at(times, "velocity_x_dot")[0])
        paths.append(predict(model, car, VehicleState(*state.tolist()), inputs, HORIZON, STEP).states)
    return np.array(paths)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["numpy", "lanes"])
@pytest.mark.parametrize("base", MODELS)
def test_batch_over_a_log_equals_individual_predictions(leaf, backend, base):
    if backend == "lanes":
        pytest.importorskip("numba", reason="numba is not installed")
    batch, on_sample = LogBatch(LOG, STARTS, HORIZON, STEP, backend=backend), np.isin(STARTS, LOG.ins_time_ns)
    for name, share in itertools.product(list_effects(base), SHARES):
        model = augment(base, {name: values_of(name, share)})
        expected = predict_individually(base, name, share, leaf)
        np.testing.assert_allclose(batch.predict(model, leaf), expected, rtol=1e-12, atol=1e-12, err_msg=name)
        # At starts on a sample predicted and measured readings agree: the sensor correction is inverted.
        np.testing.assert_allclose(batch.errors(model, leaf)[on_sample, 0], 0.0, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("base", MODELS)
def test_effect_corrects_a_log_equally_with_and_without_other_effects_at_null(leaf, base):
    all_at_null = set_effects_to_null(augment(base, find_applicable_effects(base)))
    for name in list_effects(base):
        values = {name: values_of(name, 1.0)}
        alone, among_others = augment(base, values), all_at_null.with_values(values)
        assert among_others.effective_vehicle(leaf) == alone.effective_vehicle(leaf)
        expected, corrected = correct_log(alone, LOG), correct_log(among_others, LOG)
        for field in (*INS_SIGNALS, "steering_time_ns", "road_wheel_angle"):
            np.testing.assert_allclose(getattr(corrected, field), getattr(expected, field), rtol=1e-13, err_msg=name)
