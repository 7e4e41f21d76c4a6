"""Loads an exported model (.casadi files), and uses it in acados.

    ./st export nonlinear --output build/nonlinear
    ./st shell -- python examples/mpc/acados_example.py build/nonlinear

It compares the exported step with an integration of the exported dynamics and, if acados is available (acados_template
installed, ACADOS_SOURCE_DIR set), with an integrator of acados.
"""

import importlib.util
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import casadi
import numpy as np


@dataclass
class ImportedModel:
    """An exported model with symbols of its states, inputs and parameters. *_bounds: (lower, upper) or infinite."""

    description: dict
    x: casadi.SX
    u: casadi.SX
    p: casadi.SX
    rates: casadi.SX
    step: casadi.Function
    state_bounds: tuple[np.ndarray, np.ndarray]
    input_bounds: tuple[np.ndarray, np.ndarray]


def load(folder: Path) -> ImportedModel:
    """The model in a folder written by `st export --format casadi`."""
    description = json.loads((folder / "model.json").read_text(encoding="utf-8"))
    name = description["model"]
    dynamics, step = (casadi.Function.load(str(folder / f"{name}_{kind}.casadi")) for kind in ("dynamics", "step"))
    x, u, p = (casadi.vertcat(*(casadi.SX.sym(v["name"]) for v in description[key]))
               for key in ("states", "inputs", "parameters"))
    p_argument = [p] if description["parameters"] else []
    return ImportedModel(description, x, u, casadi.SX(p), dynamics(x, u, *p_argument), step,
                         _bounds(description["states"]), _bounds(description["inputs"]))


def _bounds(entries: list[dict]) -> tuple[np.ndarray, np.ndarray]:
    lower = [-np.inf if e["lower"] is None else e["lower"] for e in entries]
    upper = [np.inf if e["upper"] is None else e["upper"] for e in entries]
    return np.array(lower), np.array(upper)


def make_acados_model(model: ImportedModel):
    """The model as acados expects it, with explicit and implicit dynamics of SX symbols."""
    from acados_template import AcadosModel

    result = AcadosModel()
    result.name, result.x, result.u, result.p = model.description["model"], model.x, model.u, model.p
    result.xdot = casadi.SX.sym("xdot", model.x.numel())
    result.f_expl_expr, result.f_impl_expr = model.rates, result.xdot - model.rates
    return result


def constrain(ocp, model: ImportedModel) -> None:
    """Set the exported bounds as box constraints of an acados OCP; states without bounds are not constrained."""
    lower, upper = model.state_bounds
    bounded = np.flatnonzero(np.isfinite(lower) & np.isfinite(upper))
    ocp.constraints.idxbx, ocp.constraints.lbx, ocp.constraints.ubx = bounded, lower[bounded], upper[bounded]
    ocp.constraints.idxbu = np.arange(model.u.numel())
    ocp.constraints.lbu, ocp.constraints.ubu = model.input_bounds


def largest_difference(model: ImportedModel, x: np.ndarray, u: np.ndarray, h: float) -> float:
    """Largest difference between the exported step and Runge-Kutta integration of the dynamics passed to acados."""
    values = [q["value"] for q in model.description["parameters"]]
    f = casadi.Function("f", [model.x, model.u], [casadi.substitute(model.rates, model.p, casadi.DM(values))]
                        if values else [model.rates])
    state, substep = casadi.DM(x), h / model.description["substeps"]
    for _ in range(model.description["substeps"]):
        a = f(state, u)
        b = f(state + substep / 2 * a, u)
        c = f(state + substep / 2 * b, u)
        state = state + substep / 6 * (a + 2 * b + 2 * c + f(state + substep * c, u))
    return float(casadi.norm_inf(state - model.step(x, u, h, *([values] if values else []))))


def integrate_with_acados(model: ImportedModel, x: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
    from acados_template import AcadosSim, AcadosSimSolver

    sim = AcadosSim()
    sim.model = make_acados_model(model)
    sim.solver_options.T, sim.solver_options.integrator_type = h, "ERK"
    sim.solver_options.num_stages, sim.solver_options.num_steps = 4, model.description["substeps"]
    sim.parameter_values = np.array([q["value"] for q in model.description["parameters"]])
    return np.asarray(AcadosSimSolver(sim).simulate(x=x, u=u))


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__)
        return 2
    model = load(Path(sys.argv[1]))
    x = np.zeros(model.x.numel())
    x[2], u = 10.0, np.array([0.05, 0.5])
    print(f"{model.description['model']}: {model.x.numel()} states, {model.u.numel()} inputs, "
          f"{model.p.numel()} parameters; step differs from integration by {largest_difference(model, x, u, 0.05):.1e}")
    if importlib.util.find_spec("acados_template") is None:
        print("acados_template is not installed: the comparison with acados is skipped")
        return 0
    values = [[q["value"] for q in model.description["parameters"]]] if model.description["parameters"] else []
    expected = model.step(x, u, 0.05, *values).full().ravel()
    print(f"acados differs from the step by {np.abs(integrate_with_acados(model, x, u, 0.05) - expected).max():.1e}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
