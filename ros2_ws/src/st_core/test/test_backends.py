"""Batch backends against the same equations on Python floats; NaN, blocks, fallbacks, exact operations.

Symmetry: test_models.py. Order of convergence: test_integrate.py; shorter steps of batches: test_batch.py.
"""

import logging
import math
import platform
import re
from dataclasses import replace

import numpy as np
import pytest
from effect_values import values_towards_bound
from st_core import backends, ops
from st_core.augmented import augment, set_effects_to_null
from st_core.backends import numpy_batch
from st_core.effects import find_applicable_effects
from st_core.errors import ConfigurationError
from st_core.integrate import rk4
from st_core.models import MODELS, get_model

STEP, STEPS = 0.05, 100
LAST_POINT = np.array([STEPS])
HALF_STEPS = np.arange(2 * STEPS + 1)
needs_numba = pytest.mark.skipif(not backends.has_numba(), reason="numba is not installed")
BACKENDS = ["numpy", pytest.param("lanes", marks=needs_numba)]
EFFECTS_BY_BASE = [(base, name) for base in MODELS for name in find_applicable_effects(base)]
# One effect for each kind of hook, for the fast run.
QUICK = [("nonlinear", "friction"), ("nonlinear", "steering_offset"), ("linear", "tyre_relaxation"),
         ("linear", "road_bank"), ("kinematic", "tyre_slip")]


def random_cases(count, seed=1):
    """Start states (6, n) and inputs over 5 s, (201, n) each: 1 to 20 m/s, lateral acceleration up to 6 m/s^2."""
    draw = np.random.default_rng(seed)
    speed = draw.uniform(1.0, 20.0, count)
    angle = np.clip(draw.uniform(-6.0, 6.0, count) * 2.7 / speed**2, -0.3, 0.3)
    time = 0.5 * STEP * HALF_STEPS[:, None]
    wave = 1.0 + 0.2 * np.sin(draw.uniform(0.5, 3.0, count) * time + draw.uniform(0.0, 6.0, count))
    states = np.stack([*draw.uniform(-100.0, 100.0, (2, count)), speed, draw.uniform(-0.3, 0.3, count),
                       draw.uniform(-3.0, 3.0, count), draw.uniform(-0.4, 0.4, count)])
    acceleration = draw.uniform(-0.15, 0.5, count) * np.cos(draw.uniform(0.2, 1.0, count) * time)
    return states, angle * wave, acceleration


def run_backend(backend, model, p, states, angle, acceleration, points=LAST_POINT, step=STEP):
    """(points, 6, n) by a backend; columns are padded to a multiple of its lanes and removed again."""
    backend = backends.get_backend(backend)
    count = states.shape[1]
    columns = -(-count // backend.LANES) * backend.LANES

    def pad_columns(a):
        return np.pad(a, ((0, 0), (0, columns - count)), mode="edge")

    angle, acceleration, states = pad_columns(angle), pad_columns(acceleration), pad_columns(states)
    with np.errstate(all="ignore"):
        w = np.array([np.broadcast_to(f, angle.shape).ravel() for f in model.inputs(angle, acceleration, p)])
        start = np.array(model.start_state(tuple(states), tuple(w[:, :columns]), p))
    return backend.advance(model, p, start, w, np.arange(len(angle)) * columns, step, points)[:, :, :count]


def predict_on_floats(model, p, states, angle, acceleration):
    """The last states, (6, n), predicted one after the other."""
    result = []
    for i in range(states.shape[1]):
        grid = [model.inputs(a, b, p) for a, b in zip(angle[:, i].tolist(), acceleration[:, i].tolist(), strict=True)]
        start = model.start_state(tuple(states[:, i].tolist()), grid[0], p)
        result.append(rk4(model.rhs, start, grid, p, STEP)[-1][:6])
    return np.array(result).T


def assert_equal_to_rounding(values, reference):
    assert np.isfinite(reference).all()
    np.testing.assert_array_less(np.abs(values - reference) / np.maximum(1.0, np.abs(reference)), 1e-12)


@pytest.mark.parametrize("count", [30, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", MODELS)
def test_random_predictions_equal_those_on_floats(leaf, name, count):
    model = MODELS[name]
    p, inputs = model.parameters(leaf), random_cases(count)
    reference = predict_on_floats(model, p, *inputs)
    for backend in [b for b in backends.NAMES if b == "numpy" or backends.has_numba()]:
        assert_equal_to_rounding(run_backend(backend, model, p, *inputs)[0], reference)


def assert_lanes_equal_floats(car, base, name, all_at_null=None):
    """all_at_null: a compiled model with all effects at null, used instead of a model with this effect alone."""
    inputs, compared = random_cases(16, seed=7), False
    for share in (-0.6, 0.3, 0.9):
        try:
            model = augment(base, {name: values_towards_bound(name, share)})
            p = model.parameters(car)
        except ConfigurationError:
            continue  # outside the bounds of the vehicle parameters
        reference = predict_on_floats(model, p, *inputs)
        if all_at_null is not None:
            model = all_at_null.with_values({name: values_towards_bound(name, share)})
            p = model.parameters(car)
        # A spinning car amplifies rounding errors.
        stable = np.abs(reference[5]) < 2.0
        compared |= bool(stable.any())
        assert_equal_to_rounding(run_backend("lanes", model, p, *inputs)[0][:, stable], reference[:, stable])
    assert compared


# numpy with effects: test_effects.py, test_batch_equals_loop_and_arrays_equal_floats.
@pytest.mark.slow
@needs_numba
@pytest.mark.parametrize(("base", "name"), QUICK)
def test_effects_in_lanes_equal_floats(leaf, base, name):
    assert_lanes_equal_floats(leaf, base, name)


@needs_numba
@pytest.mark.slow
@pytest.mark.parametrize(("base", "name"), EFFECTS_BY_BASE)
def test_every_effect_in_lanes_equals_floats(leaf, base, name):
    """All in one kernel per base: compiling one kernel per effect takes minutes."""
    assert_lanes_equal_floats(leaf, base, name, set_effects_to_null(augment(base, find_applicable_effects(base))))


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("base", MODELS)
def test_all_effects_together_equal_floats_and_at_null_the_base(leaf, backend, base):
    model, inputs = augment(base, find_applicable_effects(base)), random_cases(16, seed=3)
    p = model.parameters(leaf)
    assert_equal_to_rounding(run_backend(backend, model, p, *inputs)[0], predict_on_floats(model, p, *inputs))
    at_null = set_effects_to_null(model)
    plain = run_backend(backend, MODELS[base], MODELS[base].parameters(leaf), *inputs)[0]
    assert_equal_to_rounding(run_backend(backend, at_null, at_null.parameters(leaf), *inputs)[0], plain)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", MODELS)
def test_batch_equals_its_columns_run_alone(leaf, backend, name):
    model = MODELS[name]
    p, (states, angle, acceleration) = model.parameters(leaf), random_cases(60)
    points = np.array([0, 1, 50, 100])
    together = run_backend(backend, model, p, states, angle, acceleration, points)
    np.testing.assert_array_equal(together[0], states)
    for i in (0, 17, 59):
        column = slice(i, i + 1)
        alone = run_backend(backend, model, p, states[:, column], angle[:, column], acceleration[:, column], points)
        if backend == "lanes":
            np.testing.assert_array_equal(together[:, :, column], alone)
        else:  # numpy rounds arrays of one element differently
            np.testing.assert_allclose(together[:, :, column], alone, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", MODELS)
def test_nan_does_not_spread_to_other_columns(leaf, backend, name):
    model, points = MODELS[name], np.arange(0, 101, 10)
    p, (states, angle, acceleration) = model.parameters(leaf), random_cases(10)
    clean = run_backend(backend, model, p, states, angle, acceleration, points)
    states[0, 3], angle[60:, 5], acceleration[:, 7] = np.nan, np.nan, np.inf
    dirty = run_backend(backend, model, p, states, angle, acceleration, points)
    untouched = [i for i in range(10) if i not in (3, 5, 7)]
    np.testing.assert_array_equal(dirty[:, :, untouched], clean[:, :, untouched])
    assert np.isnan(dirty[:, 0, 3]).all()
    np.testing.assert_array_equal(dirty[:3, :, 5], clean[:3, :, 5])  # the angle is NaN from 1.5 s
    assert np.isnan(dirty[4:, :2, 5]).all()
    assert not np.isfinite(dirty[1:, 2, 7]).any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_yaw_of_many_turns_predicts_the_same_path(leaf, backend):
    model, (states, angle, acceleration) = MODELS["nonlinear"], random_cases(20)
    p = model.parameters(leaf)
    states[:2] = 0.0
    single = run_backend(backend, model, p, states, angle, acceleration)[0]
    turned = states.copy()
    turned[4] += 2.0 * math.pi * 1600.0  # 10 000 rad
    many_turns = run_backend(backend, model, p, turned, angle, acceleration)[0]
    # A start yaw of 10 000 rad is rounded to 1e-12 rad, over up to 100 m.
    np.testing.assert_allclose(many_turns[:4], single[:4], atol=5e-10)


@pytest.mark.slow
@needs_numba
@pytest.mark.skipif(platform.machine() != "x86_64", reason="reads x86 instructions")
@pytest.mark.parametrize("name", MODELS)
def test_lanes_compile_to_vector_instructions(leaf, name):
    import numba
    from st_core.backends import numba_lanes as lanes

    model = MODELS[name]
    p = model.parameters(leaf)
    w = model.inputs(0.1, 0.2, p)
    kernel = lanes.make_kernel(model, numba.typeof(lanes.as_floats(p)), len(w), 6)
    with lanes.interleave_vectors():
        kernel.compile(lanes.SIGNATURE)
    code = "".join(kernel.inspect_asm().values())
    packed, single = (len(re.findall(rf"\bv?(?:f?n?m?(?:add|sub)\w*|mul|div){kind}\b", code)) for kind in ("pd", "sd"))
    # Without vectorisation of the loop over lanes there would be scalar instructions only.
    assert packed > 10 * single and packed > 100


@needs_numba
def test_numba_operations_equal_python_to_rounding():
    import numba
    from st_core.backends.numba_lanes import FLAGS

    @numba.njit(fastmath=set(FLAGS), error_model="numpy")
    def all_of(x, limit, out):
        for i in range(len(x)):
            out[0, i], out[1, i], out[2, i], out[3, i] = ops.sin(x[i]), ops.cos(x[i]), ops.tan(x[i]), ops.atan(x[i])
            out[4, i], out[5, i], out[6, i] = ops.sqrt(x[i]), ops.sign(x[i]), ops.absolute(x[i])
            out[7, i], out[8, i] = ops.maximum(x[i], limit), ops.minimum(x[i], limit)

    draw = np.random.default_rng(5)
    x = np.concatenate([draw.uniform(-size, size, 20000) for size in (0.1, 1.0, 10.0, 1e4, 1e6)])
    out = np.empty((9, len(x)))
    all_of(x, 0.5, out)
    names = ("sin", "cos", "tan", "atan", "sqrt", "sign", "absolute", "maximum", "minimum")
    assert set(names) == set(ops.NAMES)
    for name, values in zip(names, out, strict=True):
        limit = [0.5] if name in ("maximum", "minimum") else []
        reference = np.array([getattr(ops, name)(v, *limit) for v in x.tolist()])
        # The error of the tangent near its poles is that of the cosine: relative to its derivative.
        size = np.maximum(1.0, np.square(reference)) if name == "tan" else 1.0
        np.testing.assert_array_less(np.nan_to_num(np.abs(values - reference) / size), 4.5e-16, err_msg=name)
        assert (np.isnan(values) == np.isnan(reference)).all()
    special = np.array([0.0, -0.0, math.nan, math.inf, -math.inf])
    out = np.empty((9, 5))
    all_of(special, 0.5, out)
    for name, values in zip(names, out, strict=True):
        limit = [0.5] if name in ("maximum", "minimum") else []
        reference = np.array([getattr(ops, name)(v, *limit) for v in special.tolist()])
        if name == "atan":
            reference[3:] = math.nan  # documented: the one difference
        np.testing.assert_allclose(values, reference, atol=1e-16)


@needs_numba
def test_model_that_numba_cannot_compile_runs_in_numpy_with_a_warning(leaf, caplog):
    base = MODELS["kinematic"]

    def rhs(state, w, p):
        try:
            return base.rhs(state, w, p)
        finally:
            {}.setdefault(len(state), []).append(len)

    model = replace(base, name="odd", rhs=rhs)
    p, inputs = model.parameters(leaf), random_cases(5)
    with caplog.at_level(logging.WARNING):
        values = run_backend("lanes", model, p, *inputs)[0]
        run_backend("lanes", model, p, *inputs)
    np.testing.assert_array_equal(values, run_backend("numpy", base, p, *inputs)[0])
    message, = (record.getMessage() for record in caplog.records)
    assert message.startswith("model odd runs in numpy; numba cannot compile it: ") and "\n" not in message


def test_missing_numba_falls_back_to_numpy_with_one_warning(monkeypatch, caplog):
    monkeypatch.setattr(backends, "has_numba", lambda: False)
    backends._warn_numpy.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert backends.get_backend() is numpy_batch and backends.get_backend() is numpy_batch
    assert [r.getMessage() for r in caplog.records] == [
        "numba is not installed: batches run in numpy, five to twenty times slower"]
    with pytest.raises(ConfigurationError, match="backend lanes: numba is not installed"):
        backends.get_backend("lanes")
    with pytest.raises(ConfigurationError, match="unknown backend 'gpu'; known: lanes, numpy"):
        backends.get_backend("gpu")


def test_numpy_blocks_do_not_change_the_result(leaf, monkeypatch):
    model, inputs = get_model("linear"), random_cases(50)
    p = model.parameters(leaf)
    whole = run_backend("numpy", model, p, *inputs)
    monkeypatch.setattr(numpy_batch, "BLOCK_SIZE", 7)
    np.testing.assert_array_equal(run_backend("numpy", model, p, *inputs), whole)
