"""Alternative implementations of a prediction, which `command` compares: C++, scalar numba, CasADi, commonroad."""

import ctypes
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np

FLAGS = ["-O3", "-march=native", "-fschedule-insns", "-fno-trapping-math", "-fPIC", "-shared"]
SOURCE = Path(__file__).parent / "limit.cpp"
STEPS, STEP = 100, 0.05


def flatten(p) -> list[float]:
    return [x for value in p for x in flatten(value)] if isinstance(p, tuple) else [float(p)]


def compile_limit(folder: Path, name: str, p, start, w, offsets) -> dict[str, Callable[[], np.ndarray]]:
    """Compiles the C++ kernel of a model for 8 to 32 predictions at a time; each call returns the end states."""
    numbers, out = np.array(flatten(p)), np.empty_like(start)
    calls = {}
    for vectors in (1, 2, 3, 4):
        library = folder / f"limit{vectors}.so"
        if not library.exists():
            subprocess.run(["g++", *FLAGS, f"-DNV={vectors}", str(SOURCE), "-o", str(library)], check=True)
        function = getattr(ctypes.CDLL(str(library)), name)

        def call(function=function):
            function(_pointer(numbers), _pointer(start), ctypes.c_int64(start.shape[1]), _pointer(w),
                     ctypes.c_int64(w.shape[1]), _pointer(offsets), ctypes.c_int(STEPS), ctypes.c_double(STEP),
                     _pointer(out))
            return out
        calls[f"c++ {8 * vectors} lanes"] = call
    return calls


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def compile_numba_scalar(model, p, start, w, offsets) -> Callable[[], np.ndarray]:
    """Compiles the kernel of a model for one prediction at a time."""
    import numba
    from st_core.backends import numba_lanes as lanes

    before, lanes.LANES = lanes.LANES, 1
    try:
        p = lanes.as_floats(p)
        kernel = lanes.make_kernel(model, numba.typeof(p), len(w), len(start))
        with lanes.interleave_vectors():
            kernel.compile(lanes.SIGNATURE)
    finally:
        lanes.LANES = before
    out = np.empty(start.size)

    def call():
        kernel(np.array(flatten(p)), start.ravel(), start.shape[1], w.ravel(), w.shape[1], offsets, STEP,
               np.array([STEPS]), out)
        return out.reshape(start.shape)
    return call


def casadi_calls(folder: Path, name: str, car, count: int) -> dict[str, Callable[[], object]]:
    """CasADi predictions of 100 steps with constant inputs for `count` starts: interpreted, and as generated C."""
    import casadi
    from st_core.backends.casadi_backend import build

    step = build(name, car).step
    state = np.tile([[0.0], [0.0], [10.0], [0.0], [0.0], [0.0]], count)
    inputs = np.tile([[0.05], [0.1]], STEPS * count)
    lengths = np.full((1, STEPS * count), STEP)
    source = casadi.CodeGenerator(f"{name}_step.c")
    source.add(step)
    source.generate(f"{folder}/")
    library = folder / f"{name}_step.so"
    subprocess.run(["gcc", "-O3", "-march=native", "-fPIC", "-shared", str(folder / f"{name}_step.c"), "-o",
                    str(library), "-lm"], check=True)
    functions = {"casadi map": step, "casadi generated C": casadi.external(step.name(), str(library))}
    return {label: lambda f=f.mapaccum(STEPS).map(count): f(state, inputs, lengths) for label, f in functions.items()}


def commonroad_calls() -> dict[str, Callable[[], object]]:
    """Predictions of 5 s with two models of commonroad: ST (linear tyres) and STD (Magic Formula, wheel speeds)."""
    from scipy.integrate import odeint
    from vehiclemodels.init_st import init_st
    from vehiclemodels.init_std import init_std
    from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
    from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st
    from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std

    p, u, first = parameters_vehicle2(), [0.0, 0.1], [0.0, 0.0, 0.05, 10.0, 0.0, 0.0, 0.0]
    times = STEP * np.arange(STEPS + 1)
    calls = {}
    for label, rhs, values in (("ST", vehicle_dynamics_st, init_st(list(first))),
                               ("STD", vehicle_dynamics_std, init_std(list(first), p))):
        start = np.array(values, float)

        def with_odeint(rhs=rhs, start=start):
            return odeint(lambda x, t: rhs(x, u, p), start, times)

        def with_rk4(rhs=rhs, start=start):
            def f(x):
                return np.array(rhs(x, u, p))
            x = start
            for _ in range(STEPS):
                a = f(x)
                b = f(x + 0.5 * STEP * a)
                c = f(x + 0.5 * STEP * b)
                x = x + STEP / 6.0 * (a + 2.0 * (b + c) + f(x + STEP * c))
            return x
        calls |= {f"commonroad {label} odeint": with_odeint, f"commonroad {label} RK4": with_rk4}
    return calls
