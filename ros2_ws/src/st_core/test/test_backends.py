"""Every batch backend against the same functions on Python floats, and the properties a prediction has to keep."""

import logging
import math
import platform
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from st_core import backends, ops
from st_core.augmented import augment, set_effects_to_null
from st_core.backends import numpy_batch
from st_core.effects import EFFECTS, applicable
from st_core.errors import ConfigurationError
from st_core.integrate import rk4
from st_core.models import MODELS, get_model

STEP, STEPS = 0.05, 100
LAST = np.array([STEPS])
HALF = np.arange(2 * STEPS + 1)
needs_numba = pytest.mark.skipif(not backends.has_numba(), reason="numba is not installed")
BACKENDS = ["numpy", pytest.param("lanes", marks=needs_numba)]
EFFECTS_BY_BASE = [(base, name) for base in MODELS for name in applicable(base)]
# One of each kind of hook, for the quick run.
QUICK = [("nonlinear", "friction"), ("nonlinear", "steering_offset"), ("linear", "tyre_relaxation"),
         ("linear", "road_bank"), ("kinematic", "tyre_slip")]


def cases(count, seed=1):
    """Start states (6, n) and inputs over 5 s, (201, n) each: 1 to 20 m/s, lateral acceleration up to 6 m/s^2."""
    draw = np.random.default_rng(seed)
    speed = draw.uniform(1.0, 20.0, count)
    angle = np.clip(draw.uniform(-6.0, 6.0, count) * 2.7 / speed**2, -0.3, 0.3)
    time = 0.5 * STEP * HALF[:, None]
    wave = 1.0 + 0.2 * np.sin(draw.uniform(0.5, 3.0, count) * time + draw.uniform(0.0, 6.0, count))
    states = np.stack([*draw.uniform(-100.0, 100.0, (2, count)), speed, draw.uniform(-0.3, 0.3, count),
                       draw.uniform(-3.0, 3.0, count), draw.uniform(-0.4, 0.4, count)])
    acceleration = draw.uniform(-0.15, 0.5, count) * np.cos(draw.uniform(0.2, 1.0, count) * time)
    return states, angle * wave, acceleration


def run(backend, model, p, states, angle, acceleration, points=LAST, step=STEP):
    """(points, 6, n) by a backend; columns made up to its multiple and taken off again."""
    backend = backends.get_backend(backend)
    count = states.shape[1]
    columns = -(-count // backend.LANES) * backend.LANES

    def wide(a):
        return np.pad(a, ((0, 0), (0, columns - count)), mode="edge")

    angle, acceleration, states = wide(angle), wide(acceleration), wide(states)
    with np.errstate(all="ignore"):
        w = np.array([np.broadcast_to(f, angle.shape).ravel() for f in model.inputs(angle, acceleration, p)])
        start = np.array(model.start_state(tuple(states), tuple(w[:, :columns]), p))
    return backend.advance(model, p, start, w, np.arange(len(angle)) * columns, step, points)[:, :, :count]


def on_floats(model, p, states, angle, acceleration):
    """The last states, (6, n), one prediction after the other."""
    result = []
    for i in range(states.shape[1]):
        grid = [model.inputs(a, b, p) for a, b in zip(angle[:, i].tolist(), acceleration[:, i].tolist(), strict=True)]
        start = model.start_state(tuple(states[:, i].tolist()), grid[0], p)
        result.append(rk4(model.rhs, start, grid, p, STEP)[-1][:6])
    return np.array(result).T


def assert_same(ours, reference):
    assert np.isfinite(reference).all()
    np.testing.assert_array_less(np.abs(ours - reference) / np.maximum(1.0, np.abs(reference)), 1e-12)


@pytest.mark.parametrize("count", [30, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", MODELS)
def test_random_predictions_agree(leaf, name, count):
    model = MODELS[name]
    p, drawn = model.parameters(leaf), cases(count)
    reference = on_floats(model, p, *drawn)
    for backend in [b for b in backends.NAMES if b == "numpy" or backends.has_numba()]:
        assert_same(run(backend, model, p, *drawn)[0], reference)


def values_of(effect, share):
    """Values of an effect a share of the way from null to the upper (or lower) limit of each parameter."""
    values = {}
    for q in effect.parameters:
        limit = q.bounds[1] if share > 0.0 or q.bounds[0] == q.null else q.bounds[0]
        values[q.name] = q.null + abs(share) * (limit - q.null) if q.fit else q.null
    return values


def check_effect(car, backend, base, name, among=None):
    """among: a model with this effect and others at their null, to run in the backend instead of this effect alone."""
    effect, drawn = EFFECTS[name], cases(16, seed=7)
    seen = False
    for share in (-0.6, 0.3, 0.9):
        try:
            model = augment(base, {name: values_of(effect, share)})
            p = model.parameters(car)
        except ConfigurationError:
            continue  # no car any more
        reference = on_floats(model, p, *drawn)
        if among is not None:
            model = among.with_values({name: values_of(effect, share)})
            p = model.parameters(car)
        # A car that spins magnifies the last digit; what is checked here are the equations.
        calm = np.abs(reference[5]) < 2.0
        seen |= bool(calm.any())
        assert_same(run(backend, model, p, *drawn)[0][:, calm], reference[:, calm])
    assert seen


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("base", "name"), QUICK)
def test_effects_agree(leaf, backend, base, name):
    check_effect(leaf, backend, base, name)


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("base", "name"), EFFECTS_BY_BASE)
def test_every_effect_agrees_at_several_values(leaf, backend, base, name):
    """In lanes all in one kernel for each base: a kernel for each effect takes minutes to compile."""
    everything = set_effects_to_null(augment(base, applicable(base))) if backend == "lanes" else None
    check_effect(leaf, backend, base, name, everything)


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("base", MODELS)
def test_all_effects_at_once_agree_and_are_neutral_at_null(leaf, backend, base):
    model, drawn = augment(base, applicable(base)), cases(16, seed=3)
    p = model.parameters(leaf)
    assert_same(run(backend, model, p, *drawn)[0], on_floats(model, p, *drawn))
    nothing = set_effects_to_null(model)
    plain = run(backend, MODELS[base], MODELS[base].parameters(leaf), *drawn)[0]
    assert_same(run(backend, nothing, nothing.parameters(leaf), *drawn)[0], plain)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", MODELS)
def test_a_batch_is_its_columns(leaf, backend, name):
    model = MODELS[name]
    p, (states, angle, acceleration) = model.parameters(leaf), cases(60)
    points = np.array([0, 1, 50, 100])
    together = run(backend, model, p, states, angle, acceleration, points)
    np.testing.assert_array_equal(together[0], states)
    for i in (0, 17, 59):
        column = slice(i, i + 1)
        alone = run(backend, model, p, states[:, column], angle[:, column], acceleration[:, column], points)
        if backend == "lanes":
            np.testing.assert_array_equal(together[:, :, column], alone)
        else:  # numpy itself treats a row of one apart from a row of many
            np.testing.assert_allclose(together[:, :, column], alone, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_left_is_the_mirror_of_right(leaf, backend, name, seed):
    model = MODELS[name]
    p, (states, angle, acceleration) = model.parameters(leaf), cases(4, seed)
    mirror = np.array([1.0, -1.0, 1.0, -1.0, -1.0, -1.0])[:, None]
    left = run(backend, model, p, states, angle, acceleration)[0]
    right = run(backend, model, p, states * mirror, -angle, acceleration)[0]
    np.testing.assert_allclose(right, left * mirror, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", MODELS)
def test_error_falls_with_the_fourth_power_of_the_step(leaf, backend, name):
    model = MODELS[name]
    p, (states, _, _) = model.parameters(leaf), cases(8)
    states[2] = 12.0

    def at(parts):
        # A step response: inputs the same in between, so that only the step differs.
        held = np.ones((2 * 40 * parts + 1, 8))
        return run(backend, model, p, states, 0.05 * held, 0.3 * held, np.array([40 * parts]), STEP / parts)[0]

    exact = at(16)
    errors = [np.abs(at(parts) - exact).max() for parts in (1, 2)]
    assert 3.6 < math.log2(errors[0] / errors[1]) < 4.6


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", MODELS)
def test_nan_in_one_column_stays_there(leaf, backend, name):
    model, points = MODELS[name], np.arange(0, 101, 10)
    p, (states, angle, acceleration) = model.parameters(leaf), cases(10)
    clean = run(backend, model, p, states, angle, acceleration, points)
    states[0, 3], angle[60:, 5], acceleration[:, 7] = np.nan, np.nan, np.inf
    dirty = run(backend, model, p, states, angle, acceleration, points)
    untouched = [i for i in range(10) if i not in (3, 5, 7)]
    np.testing.assert_array_equal(dirty[:, :, untouched], clean[:, :, untouched])
    assert np.isnan(dirty[:, 0, 3]).all()
    np.testing.assert_array_equal(dirty[:3, :, 5], clean[:3, :, 5])  # until 1.5 s, when the angle is lost
    assert np.isnan(dirty[4:, :2, 5]).all()
    assert not np.isfinite(dirty[1:, 2, 7]).any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_yaw_may_have_turned_many_times(leaf, backend):
    model, (states, angle, acceleration) = MODELS["nonlinear"], cases(20)
    p = model.parameters(leaf)
    states[:2] = 0.0
    once = run(backend, model, p, states, angle, acceleration)[0]
    turned = states.copy()
    turned[4] += 2.0 * math.pi * 1600.0  # 10 000 rad
    often = run(backend, model, p, turned, angle, acceleration)[0]
    # The start angle itself is known to 1e-12 rad only, over up to 100 m.
    np.testing.assert_allclose(often[:4], once[:4], atol=5e-10)


@needs_numba
@pytest.mark.skipif(platform.machine() != "x86_64", reason="reads x86 instructions")
@pytest.mark.parametrize("name", MODELS)
def test_lanes_are_vector_instructions(leaf, name):
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
    # Were the loop over lanes not vectorised, only the single kind would be there.
    assert packed > 10 * single and packed > 100


@needs_numba
def test_operations_are_exact():
    import numba
    from st_core.backends.numba_ops import FLAGS

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
    for name, ours in zip(names, out, strict=True):
        limit = [0.5] if name in ("maximum", "minimum") else []
        reference = np.array([getattr(ops, name)(v, *limit) for v in x.tolist()])
        # The tangent near its poles is as exact as the cosine it divides by: relative to its slope.
        size = np.maximum(1.0, np.square(reference)) if name == "tan" else 1.0
        np.testing.assert_array_less(np.nan_to_num(np.abs(ours - reference) / size), 4.5e-16, err_msg=name)
        assert (np.isnan(ours) == np.isnan(reference)).all()
    special = np.array([0.0, -0.0, math.nan, math.inf, -math.inf])
    out = np.empty((9, 5))
    all_of(special, 0.5, out)
    for name, ours in zip(names, out, strict=True):
        limit = [0.5] if name in ("maximum", "minimum") else []
        reference = np.array([getattr(ops, name)(v, *limit) for v in special.tolist()])
        if name == "atan":
            reference[3:] = math.nan  # documented: the one difference
        np.testing.assert_allclose(ours, reference, atol=1e-16)


@needs_numba
def test_a_model_numba_cannot_compile_runs_in_numpy_and_says_so(leaf, caplog):
    base = MODELS["kinematic"]

    def rhs(state, w, p):
        try:
            return base.rhs(state, w, p)
        finally:
            {}.setdefault(len(state), []).append(len)

    model = replace(base, name="odd", rhs=rhs)
    p, drawn = model.parameters(leaf), cases(5)
    with caplog.at_level(logging.WARNING):
        ours = run("lanes", model, p, *drawn)[0]
        run("lanes", model, p, *drawn)
    np.testing.assert_array_equal(ours, run("numpy", base, p, *drawn)[0])
    message, = (record.getMessage() for record in caplog.records)
    assert message.startswith("model odd runs in numpy; numba cannot compile it: ") and "\n" not in message


def test_without_numba_numpy_takes_over_with_one_line(monkeypatch, caplog):
    monkeypatch.setattr(backends, "has_numba", lambda: False)
    backends._warn_numpy.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert backends.get_backend() is numpy_batch and backends.get_backend() is numpy_batch
    assert [r.getMessage() for r in caplog.records] == [
        "numba is not installed: batches run in numpy, about five times slower"]
    with pytest.raises(ConfigurationError, match="backend lanes: numba is not installed"):
        backends.get_backend("lanes")
    with pytest.raises(ConfigurationError, match="unknown backend 'gpu'; known are lanes, numpy"):
        backends.get_backend("gpu")


def test_numpy_works_in_blocks(leaf, monkeypatch):
    model, drawn = get_model("linear"), cases(50)
    p = model.parameters(leaf)
    whole = run("numpy", model, p, *drawn)
    monkeypatch.setattr(numpy_batch, "BLOCK_SIZE", 7)
    np.testing.assert_array_equal(run("numpy", model, p, *drawn), whole)
