"""Backend that numba compiles from the functions of a model, with predictions (lanes) in parallel in vector registers.

All functions of a model are inlined into one loop over lanes, which contains a whole Runge-Kutta step and is vectorised
by LLVM. Three vectors are interleaved, because each operation within a vector waits for the previous one.
Measurements: docs/measurements/performance.md.
"""

import logging
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
from numba.extending import intrinsic

from .. import ops
from ..models import Model
from ..types import STATE_NAMES
from . import numba_cache, numpy_batch
from .numba_ops import FLAGS, inline

# A multiple of three vectors of 8 (AVX-512) or 4 (AVX2) numbers. With fewer than 16 lanes LLVM does not vectorise the
# loop, which is seven times slower; with 32 to 96 lanes and 2 to 4 vectors the speed differs by less than 15 %.
LANES = 48
INTERLEAVE = 3  # vectors
CACHE_LINE = 64  # bytes
EXCLUDED_MODULES = frozenset((ops.__name__,))  # modules with functions that are compiled by `numba_ops`

_compiled: dict[Any, Any] = {}
_inlined: set = set()
_lock = Lock()


def advance(model: Model, p: Any, start: np.ndarray, w: np.ndarray, offsets: np.ndarray, step: float,
            points: np.ndarray) -> np.ndarray:
    """States of all columns at the points, as defined in the package; by numpy, with a warning, if numba cannot compile
    the model."""
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
    """Whether numba can compile the kernel for these numbers of fields of w and of states; compiles or loads it."""
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
        if key not in _compiled:
            _compiled[key] = _compile(model, numba.typeof(as_floats(p)), fields, states)
        return _compiled[key]


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
        fingerprint = numba_cache.fingerprint(cast(FunctionType, model.rhs), EXCLUDED_MODULES)
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
    for function in numba_cache.find_reachable(cast(FunctionType, model.rhs), EXCLUDED_MODULES):
        if function not in _inlined:
            _inlined.add(inline(function))
    return _define_kernel(model.rhs, _make_parameter_reader(type_of_p), _make_loader(fields), _make_loader(states),
                          _make_scratch(states * LANES))


@contextmanager
def interleave_vectors() -> Iterator[None]:
    """Compile with INTERLEAVE full-width vectors.

    By default LLVM uses one vector, of half the width on Intel server processors, which is 40 % slower. The options
    apply to the whole process and are therefore reset.
    """
    _, _, features = cpu_target.target_context.codegen().magic_tuple()
    for option, value in (("interleave", INTERLEAVE), ("width", 8 if "+avx512f" in features else 0)):
        llvmlite.binding.set_option("st_core", f"-force-vector-{option}={value}")
    try:
        yield
    finally:
        for option in ("interleave", "width"):
            llvmlite.binding.set_option("st_core", f"-force-vector-{option}=0")


_ROW, _INDICES = types.float64[::1], types.int64[::1]
SIGNATURE = types.void(_ROW, _ROW, types.int64, _ROW, types.int64, _INDICES, types.float64, _INDICES, _ROW)


def _define_kernel(rhs, read_parameters, load_w, load_state, allocate):
    @numba.njit(fastmath=set(FLAGS), error_model="numpy", nogil=True)
    def kernel(values, start, columns, w, row, offsets, step, points, out):
        p = read_parameters(values)
        half, sixth = 0.5 * step, step / 6.0
        state = allocate()
        for first in range(0, columns, LANES):
            for lane in range(LANES):
                _store(state, LANES, lane, load_state(start, columns, first + lane))
            k = 0
            for point in range(len(points)):
                while k < points[point]:
                    begin, middle, end = offsets[2 * k] + first, offsets[2 * k + 1] + first, offsets[2 * k + 2] + first
                    for lane in range(LANES):
                        s = load_state(state, LANES, lane)
                        w_middle = load_w(w, row, middle + lane)
                        k1 = rhs(s, load_w(w, row, begin + lane), p)
                        k2 = rhs(_add(s, half, k1), w_middle, p)
                        k3 = rhs(_add(s, half, k2), w_middle, p)
                        k4 = rhs(_add(s, step, k3), load_w(w, row, end + lane), p)
                        increment = _add(_add(k1, 2.0, _add(k2, 1.0, k3)), 1.0, k4)
                        _store(state, LANES, lane, _add(s, sixth, increment))
                    k += 1
                for lane in range(LANES):
                    _store(out, columns, point * N_STATES * columns + first + lane, _load_base(state, LANES, lane))
    return kernel


# The functions below move whole tuples of states and fields, lane by lane; their size is known at compile time.

def _make_parameter_reader(type_of_p):
    @intrinsic
    def read_parameters(_, values):
        """The parameters p, nested, from a row of their numbers."""
        def generate(context, builder, signature, arguments):
            row = context.make_array(signature.args[0])(context, builder, arguments[0])
            indices = count()

            def build(kind):
                if isinstance(kind, types.BaseTuple):
                    return context.make_tuple(builder, kind, [build(k) for k in kind.types])
                return builder.load(builder.gep(row.data, [context.get_constant(types.intp, next(indices))]))
            return build(type_of_p)
        return type_of_p(values), generate
    return read_parameters


def _make_scratch(size: int):
    @intrinsic
    def allocate(_):
        """Stack memory for `size` numbers, aligned to cache lines. This aligns the stack as well; otherwise a spilled
        vector may occupy two cache lines, and the speed varies by a third between processes."""
        def generate(context, builder, signature, arguments):
            memory = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), size))
            memory.align = CACHE_LINE
            return builder.bitcast(memory, ir.DoubleType().as_pointer())
        return types.CPointer(types.float64)(), generate
    return allocate


def _make_loader(size: int):
    @intrinsic
    def load(_, table, row, column):
        """The tuple of table[i * row + column] for i < size."""
        result = types.UniTuple(types.float64, size)

        def generate(context, builder, signature, arguments):
            data = _get_pointer(context, builder, signature.args[0], arguments[0])
            indices = [_compute_index(context, builder, i, *arguments[1:]) for i in range(size)]
            return context.make_tuple(
                builder, result, [builder.load(builder.gep(data, [index], inbounds=True)) for index in indices])
        return result(table, types.intp, types.intp), generate
    return load


N_STATES = len(STATE_NAMES)
_load_base = _make_loader(N_STATES)


@intrinsic
def _store(_, table, row, column, values):
    """table[i * row + column] = values[i]."""
    def generate(context, builder, signature, arguments):
        data = _get_pointer(context, builder, signature.args[0], arguments[0])
        for i, value in enumerate(_extract_values(context, builder, signature.args[3], arguments[3])):
            index = _compute_index(context, builder, i, *arguments[1:3])
            builder.store(value, builder.gep(data, [index], inbounds=True))
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


def _get_pointer(context, builder, kind, value):
    return value if isinstance(kind, types.CPointer) else context.make_array(kind)(context, builder, value).data


def _extract_values(context, builder, kind, value):
    return [context.cast(builder, builder.extract_value(value, i), k, types.float64) for i, k in enumerate(kind.types)]


def _compute_index(context, builder, i, row, column):
    return builder.add(column, builder.mul(context.get_constant(types.intp, i), row, flags=("nsw",)), flags=("nsw",))
