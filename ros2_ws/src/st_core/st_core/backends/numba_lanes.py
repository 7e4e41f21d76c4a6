"""Backend that numba compiles from the functions of a model; vector registers hold several predictions (lanes).

All functions of a model are inlined into one loop over lanes, which LLVM vectorises. For a model with tyres the loop
computes one stage of a Runge-Kutta step, since compiling all four stages takes more than twice as long. For the
kinematic model, whose equations are short, one loop over all four stages is faster. Three vectors are interleaved,
because each operation on a vector waits for the previous one. Measurements: docs/measurements/performance.md.

The functions of `st_core.ops` have versions without branches. Sine, cosine: x = n pi/2 + r with |r| <= pi/4. pi/2 is
split into two parts, the first with 33 bits, so that its product with n is exact up to |n| = 2^20 or 1.6e6 rad. Arc
tangent: in each of four ranges atan x = base + atan t, with one division and |t| <= tan(pi/12). The polynomials
interpolate at Chebyshev nodes in r^2 or t^2, with relative errors < 6e-17. They are evaluated by Estrin's scheme, since
the longest chain of operations limits the speed. The arc tangent of infinity is NaN. Checked by: test_backends.py.
"""

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from threading import Lock
from types import FunctionType
from typing import Any, cast

import llvmlite.binding
import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import NumbaError
from numba.core.registry import cpu_target
from numba.extending import intrinsic, overload

from .. import ops
from ..models import Model
from ..types import STATE_NAMES
from . import numba_cache, numpy_batch

# LLVM fast-math flags, without nnan and ninf, because NaN in a log must give NaN. Callees do not inherit them.
FLAGS = ("contract", "nsz", "arcp")
OPTIONS: Any = {"fastmath": set(FLAGS), "error_model": "numpy", "forceinline": True, "no_cfunc_wrapper": True}

SIGN_MASK = np.int64(-(2**63))  # mask of the sign bit
MAGNITUDE_MASK = np.int64(2**63 - 1)  # mask of all bits but the sign bit
ONE_BITS = np.int64(0x3FF0000000000000)  # bits of 1.0

ROUNDING_OFFSET = 1.5 * 2.0**52  # the low bits of x + ROUNDING_OFFSET are the integer nearest to x
TWO_OVER_PI = 0.6366197723675814
HALF_PI_HIGH, HALF_PI_LOW = 1.5707963267341256, 6.077100506506192e-11

# Coefficients of the polynomials: S of the sine, C of the cosine, A of the arc tangent.
S1, S2, S3 = -0.16666666666666666, 0.008333333333330905, -0.00019841269836710015
S4, S5, S6 = 2.755731608182638e-06, -2.5051128069891774e-08, 1.591788278413412e-10
C1, C2, C3 = 0.04166666666666657, -0.0013888888888865072, 2.4801587282473078e-05
C4, C5, C6 = -2.755731205923296e-07, 2.087538637959625e-09, -1.1341301033703834e-11

A1, A2, A3, A4 = -0.3333333333333324, 0.1999999999984203, -0.14285714239428257, 0.11111105932082634
A5, A6, A7, A8 = -0.09090623565675247, 0.0768371258882859, -0.06521798362425968, 0.04577471134842663
TAN_PI_12, COT_PI_12 = 0.2679491924311227, 3.732050807568877
TAN_PI_6 = 0.5773502691896257
PI_6, PI_3, HALF_PI = 0.5235987755982989, 1.0471975511965979, 1.5707963267948966


def inline(function, implementation=None):
    """Register a plain function for inlining in compiled code, with another implementation if one is given."""
    @overload(function, jit_options=OPTIONS, strict=False)
    def implement(*args, **kwargs):
        return implementation or function
    return function


def _make_bitcast(source, target):
    @intrinsic
    def bitcast(_, x):
        def generate(context, builder, signature, arguments):
            return builder.bitcast(arguments[0], context.get_value_type(target))
        return target(source), generate
    return bitcast


_to_bits, _from_bits = _make_bitcast(types.float64, types.int64), _make_bitcast(types.int64, types.float64)


@inline
def _sine_cosine(x):
    """(sine of r, cosine of r, integer with n in its low bits). LLVM merges calls with the same x."""
    shifted = x * TWO_OVER_PI + ROUNDING_OFFSET
    n = shifted - ROUNDING_OFFSET
    r = (x - n * HALF_PI_HIGH) - n * HALF_PI_LOW
    z = r * r
    z2 = z * z
    z4 = z2 * z2
    s = (S1 + z * S2) + z2 * (S3 + z * S4) + z4 * (S5 + z * S6)
    c = (C1 + z * C2) + z2 * (C3 + z * C4) + z4 * (C5 + z * C6)
    return r + r * z * s, (1.0 - 0.5 * z) + z2 * c, _to_bits(shifted)


def _sin(x):
    s, c, n = _sine_cosine(x)
    return _from_bits(_to_bits(c if n & 1 else s) ^ ((n & 2) << 62))


def _cos(x):
    s, c, n = _sine_cosine(x)
    return _from_bits(_to_bits(s if n & 1 else c) ^ (((n + 1) & 2) << 62))


def _atan(x):
    # The sign u = +-1 is applied from the start, since this does not lengthen the chain of operations.
    a = _from_bits(_to_bits(x) & MAGNITUDE_MASK)
    u = _from_bits((_to_bits(x) & SIGN_MASK) | ONE_BITS)
    below_one = a < 1.0
    middle = (a > TAN_PI_12) & (a < COT_PI_12)
    n = x if below_one else -u
    d = 1.0 if below_one else a
    c = -TAN_PI_6 if below_one else TAN_PI_6
    c = (c if middle else 0.0) * u
    near = PI_6 if below_one else PI_3
    far = 0.0 if below_one else HALF_PI
    base = (near if middle else far) * u
    t = (n + c * d) / (d - c * n)
    z = t * t
    z2 = z * z
    z4 = z2 * z2
    p = ((A1 + z * A2) + z2 * (A3 + z * A4)) + z4 * ((A5 + z * A6) + z2 * (A7 + z * A8))
    return (base + t) + t * z * p


for _function, _implementation in {
        ops.sin: _sin, ops.cos: _cos, ops.tan: lambda x: ops.sin(x) / ops.cos(x), ops.atan: _atan,
        ops.sqrt: lambda x: math.sqrt(x),  # noqa: PLW0108  # numba needs a Python function
        ops.sign: lambda x: 1.0 if x > 0.0 else -1.0 if x < 0.0 else x,
        ops.absolute: lambda x: _from_bits(_to_bits(x) & MAGNITUDE_MASK),
        ops.maximum: lambda x, limit: limit if x < limit else x,
        ops.minimum: lambda x, limit: limit if x > limit else x}.items():
    inline(_function, _implementation)


# Number of lanes, a multiple of three vectors of 8 (AVX-512) or 4 (AVX2) numbers. With fewer than 16 lanes the
# loop is not vectorised and seven times slower; for 32 to 96 lanes and 2 to 4 vectors the speed varies by < 15 %.
LANES = 48
INTERLEAVED_VECTORS = 3
CACHE_LINE = 64  # bytes
EXCLUDED_MODULES = frozenset((ops.__name__,))  # modules whose functions have implementations above

_kernels: dict[Any, Any] = {}
_inlined_functions: set = set()
_lock = Lock()


def advance(model: Model, p: Any, start: np.ndarray, w: np.ndarray, offsets: np.ndarray, step: float,
            points: np.ndarray) -> np.ndarray:
    """States of all columns at the points; see `st_core.backends`. Warns and uses numpy if numba fails."""
    numbers: list[float] = []
    kernel = _get_kernel(model, p, _collect_numbers(p, numbers), len(w), len(start))
    if kernel is None:
        return numpy_batch.advance(model, as_floats(p), start, w, offsets, step, points)
    columns = start.shape[1]
    out = np.empty((len(points), len(STATE_NAMES), columns))
    kernel(np.array(numbers), np.ascontiguousarray(start).ravel(), columns, np.ascontiguousarray(w).ravel(),
           w.shape[1], np.ascontiguousarray(offsets, np.int64), step, np.ascontiguousarray(points, np.int64),
           out.ravel())
    return out


def can_compile(model: Model, p: Any, fields: int, states: int) -> bool:
    """Compile the kernel or load it from the cache; False if numba fails. fields, states: lengths of w and state."""
    return _get_kernel(model, p, _collect_numbers(p, []), fields, states) is not None


def as_floats(p: Any) -> Any:
    """p with all its numbers as Python floats."""
    if not isinstance(p, tuple):
        return float(p)
    values = map(as_floats, p)
    return type(p)(*values) if hasattr(p, "_fields") else tuple(values)


def _get_kernel(model: Model, p: Any, types_of_p: tuple, fields: int, states: int):
    # The key contains no parameter values, so a fit, which changes them a thousand times, compiles once.
    key = (model.rhs, types_of_p, fields, states)
    with _lock:
        if key not in _kernels:
            _kernels[key] = _compile(model, numba.typeof(as_floats(p)), fields, states)
        return _kernels[key]


def _collect_numbers(p: tuple, numbers: list[float]) -> tuple:
    """Append the numbers in p to `numbers`. Returns the nested types of p, a fast equivalent of its numba type."""
    nested: list[Any] = [type(p)]
    for value in p:
        if isinstance(value, tuple):
            nested.append(_collect_numbers(value, numbers))
        else:
            numbers.append(float(value))
            nested.append(float)
    return tuple(nested)


def _compile(model: Model, type_of_p, fields: int, states: int):
    kernel = make_kernel(model, type_of_p, fields, states)
    try:
        fingerprint = numba_cache.compute_fingerprint(cast(FunctionType, model.rhs), EXCLUDED_MODULES)
        numba_cache.enable_cache(kernel, f"{fingerprint} {type_of_p} {fields} {states}")
    except numba_cache.UnhashableError:
        pass  # not cached: compiled in every process
    try:
        with interleave_vectors():
            numba_cache.compile_or_load(kernel, SIGNATURE)
    except NumbaError as error:
        reason = " ".join(str(error).split())
        logging.getLogger(__name__).warning("model %s runs in numpy; numba cannot compile it: %.300s", model.name,
                                            reason)
        return None
    return kernel


def make_kernel(model: Model, type_of_p, fields: int, states: int):
    """The kernel of a model, not compiled yet, for the numba type of its parameters."""
    for function in numba_cache.find_reachable_functions(cast(FunctionType, model.rhs), EXCLUDED_MODULES):
        if function not in _inlined_functions:
            _inlined_functions.add(inline(function))
    return _define_kernel(model.rhs, model.has_tyres, _make_parameter_reader(type_of_p), _make_loader(fields),
                          _make_loader(states), _make_scratch(states))


@contextmanager
def interleave_vectors() -> Iterator[None]:
    """Context in which LLVM compiles with INTERLEAVED_VECTORS full-width vectors.

    By default LLVM uses one vector, of half the width on Intel server processors, which is 40 % slower. The options
    apply to the whole process and are therefore reset.
    """
    _, _, features = cpu_target.target_context.codegen().magic_tuple()
    for option, value in (("interleave", INTERLEAVED_VECTORS), ("width", 8 if "+avx512f" in features else 0)):
        llvmlite.binding.set_option("st_core", f"-force-vector-{option}={value}")
    try:
        yield
    finally:
        for option in ("interleave", "width"):
            llvmlite.binding.set_option("st_core", f"-force-vector-{option}=0")


_ROW, _INDICES = types.float64[::1], types.int64[::1]
SIGNATURE = types.void(_ROW, _ROW, types.int64, _ROW, types.int64, _INDICES, types.float64, _INDICES, _ROW)


# long: separate functions for the two types of step add reference counting, which slows the kinematic model by a fifth
def _define_kernel(rhs, in_stages, read_parameters, load_w, load_state, allocate):
    @numba.njit(fastmath=set(FLAGS), error_model="numpy", nogil=True)
    def kernel(values, start, columns, w, stride, offsets, step, points, out):
        p = read_parameters(values)
        half, third, sixth = 0.5 * step, step / 3.0, step / 6.0
        lengths, weights = (0.0, half, half, step), (sixth, third, third, sixth)
        state, slope, following = allocate(), allocate(), allocate()
        for first in range(0, columns, LANES):
            for lane in range(LANES):
                s = load_state(start, columns, first + lane)
                _store(state, LANES, lane, s)
                _store(slope, LANES, lane, s)  # any finite values; the first stage does not depend on them
                _store(following, LANES, lane, s)
            k = 0
            for point in range(len(points)):
                while k < points[point]:
                    if in_stages:
                        for stage in range(4):
                            length, weight = lengths[stage], weights[stage]
                            column = offsets[2 * k + (stage + 1) // 2] + first
                            for lane in range(LANES):
                                s = _add(load_state(state, LANES, lane), length, load_state(slope, LANES, lane))
                                derivative = rhs(s, load_w(w, stride, column + lane), p)
                                _store(slope, LANES, lane, derivative)
                                s = _add(load_state(following, LANES, lane), weight, derivative)
                                _store(following, LANES, lane, s)
                        for lane in range(LANES):
                            _store(state, LANES, lane, load_state(following, LANES, lane))
                    else:
                        begin, middle, end = offsets[2 * k], offsets[2 * k + 1], offsets[2 * k + 2]
                        for column in range(first, first + LANES):
                            lane = column - first
                            s = load_state(state, LANES, lane)
                            w_middle = load_w(w, stride, middle + column)
                            k1 = rhs(s, load_w(w, stride, begin + column), p)
                            k2 = rhs(_add(s, half, k1), w_middle, p)
                            k3 = rhs(_add(s, half, k2), w_middle, p)
                            k4 = rhs(_add(s, step, k3), load_w(w, stride, end + column), p)
                            increment = _add(_add(k1, 2.0, _add(k2, 1.0, k3)), 1.0, k4)
                            _store(state, LANES, lane, _add(s, sixth, increment))
                    k += 1
                for lane in range(LANES):
                    _store(out, columns, point * N_STATES * columns + first + lane, _load_motion(state, LANES, lane))
    return kernel


# The functions below load and store the state or the inputs w of one lane, as tuples with a size known to the compiler.

def _make_parameter_reader(type_of_p):
    @intrinsic
    def read_parameters(_, values):
        """The nested parameters p, from a row of their numbers in depth-first order."""
        def generate(context, builder, signature, arguments):
            row = context.make_array(signature.args[0])(context, builder, arguments[0])
            indices = count()

            def build(part):
                if isinstance(part, types.BaseTuple):
                    return context.make_tuple(builder, part, [build(inner) for inner in part.types])
                return builder.load(builder.gep(row.data, [context.get_constant(types.intp, next(indices))]))
            return build(type_of_p)
        return type_of_p(values), generate
    return read_parameters


def _make_scratch(size: int):
    @intrinsic
    def allocate(_):
        """Stack memory for `size` rows of LANES numbers, aligned to cache lines. The stack is then aligned as well.
        Otherwise a spilled vector may occupy two cache lines, and the speed varies by a third between processes."""
        def generate(context, builder, signature, arguments):
            rows = []
            for _ in range(size):
                memory = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), LANES))
                memory.align = CACHE_LINE
                rows.append(builder.bitcast(memory, ir.DoubleType().as_pointer()))
            return context.make_tuple(builder, signature.return_type, rows)
        return types.UniTuple(types.CPointer(types.float64), size)(), generate
    return allocate


def _make_loader(size: int):
    @intrinsic
    def load(_, table, stride, column):
        """The tuple of table[i * stride + column] for i < size."""
        result = types.UniTuple(types.float64, size)

        def generate(context, builder, signature, arguments):
            return context.make_tuple(builder, result, [
                builder.load(_point_to(context, builder, signature.args[0], i, *arguments)) for i in range(size)])
        return result(table, types.intp, types.intp), generate
    return load


N_STATES = len(STATE_NAMES)
_load_motion = _make_loader(N_STATES)  # the six states, without the extra states of effects


@intrinsic
def _store(_, table, stride, column, values):
    """table[i * stride + column] = values[i]."""
    def generate(context, builder, signature, arguments):
        for i, value in enumerate(_extract_values(context, builder, signature.args[3], arguments[3])):
            builder.store(value, _point_to(context, builder, signature.args[0], i, *arguments[:3]))
        return context.get_dummy_value()
    return types.none(table, types.intp, types.intp, values), generate


@intrinsic
def _add(_, first, factor, second):
    """first + factor * second, element by element of two tuples."""
    result = types.UniTuple(types.float64, len(first))

    def generate(context, builder, signature, arguments):
        left = _extract_values(context, builder, signature.args[0], arguments[0])
        right = _extract_values(context, builder, signature.args[2], arguments[2])
        sums = [builder.fadd(a, builder.fmul(arguments[1], b, flags=FLAGS), flags=FLAGS)
                for a, b in zip(left, right, strict=True)]
        return context.make_tuple(builder, result, sums)
    return result(first, types.float64, second), generate


def _point_to(context, builder, table_type, i, table, stride, column):
    """Address of element `column` of row i of a table, whose rows are separate arrays or `stride` elements apart."""
    if isinstance(table_type, types.BaseTuple):
        return builder.gep(builder.extract_value(table, i), [column], inbounds=True)
    row = builder.mul(context.get_constant(types.intp, i), stride, flags=("nsw",))
    data = context.make_array(table_type)(context, builder, table).data
    return builder.gep(data, [builder.add(column, row, flags=("nsw",))], inbounds=True)


def _extract_values(context, builder, tuple_type, value):
    return [context.cast(builder, builder.extract_value(value, i), element, types.float64)
            for i, element in enumerate(tuple_type.types)]
