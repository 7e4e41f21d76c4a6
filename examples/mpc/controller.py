"""Nonlinear model predictive control of a car along a path, with any model of the suite.

    min  sum_k  q_n n_k^2 + q_c c_k^2 + q_s s_k^2 + q_v (v_k - v_ref,k)^2 + r_d (d_delta_k)^2 + r_a (d_a_k)^2
    s.t. x_{k+1} = F(x_k, u_k, h),  u_k = u_{k-1} + d_k,  bounds on u and d
         low_k - e_k <= n_k <= high_k + e_k,  e_k >= 0, with r_e e_k^2 added to the sum     (corridor only)

n, s: lateral and longitudinal deviation from the reference point [m]; c: velocity across the path [m/s]; d: change of
the inputs u from one step to the next. F is `step` of st_core.backends.casadi_backend. The method is multiple shooting.
"""

from dataclasses import dataclass, field
from time import perf_counter, process_time
from typing import NamedTuple

import casadi
import numpy as np
from st_core.backends.casadi_backend import build
from st_core.models import Model
from st_core.vehicle import VehicleParameters

SOLVERS = {
    "ipopt": ("ipopt", {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 60,
                        "ipopt.tol": 1e-4, "ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-3}),
    "rti": ("sqpmethod", {"print_time": False, "print_header": False, "print_iteration": False, "print_status": False,
                          "max_iter": 1, "max_iter_ls": 0, "error_on_fail": False, "qpsol": "qrqp",
                          "qpsol_options": {"print_time": False, "print_iter": False, "print_header": False,
                                            "print_info": False, "error_on_fail": False}}),
}
"""ipopt solves each step to convergence. rti (real-time iteration) solves one quadratic program per step, started from
the previous solution: SQP with qrqp, Gauss-Newton Hessian, full steps."""


@dataclass(frozen=True)
class Tuning:
    """Weights [1 / unit^2], limits, and the prediction step h [s], which is also the control interval."""

    step: float = 0.1
    substeps: int = 2  # integration steps in h; one is too long for the tyre dynamics at 3 m/s
    across: float = 4.0  # q_n
    course: float = 0.4  # q_c
    along: float = 0.05  # q_s
    speed: float = 1.0  # q_v
    steering_change: float = 400.0  # r_d
    acceleration_change: float = 0.3  # r_a
    angle: float = 0.5  # bound of the road-wheel angle [rad]
    angle_change: float = 0.045  # bound of its change in a step [rad]
    acceleration: tuple[float, float] = (-5.0, 2.5)  # bounds [m/s^2]
    acceleration_step: float = 1.0  # bound of its change in a step [m/s^2]
    outside: float = 1.0e4  # r_e [1/m^2]; e is a few millimetres if the corridor is feasible


class Reference(NamedTuple):
    """Position [m] and yaw [rad] of the path, and speed [m/s], at the end of each step; (steps,) each."""

    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    speed: np.ndarray


class Solution(NamedTuple):
    """Result of `Controller.control`."""

    inputs: tuple[float, float]  # (road_wheel_angle [rad], velocity_x_dot [m/s^2]) for the next step
    planned: np.ndarray  # inputs of all steps, (steps, 2)
    predicted: np.ndarray  # states at the end of each step, (steps, states)
    wall: float  # elapsed time of the solver [s]
    cpu: float  # processor time of the solver [s]
    iterations: int
    # False if ipopt did not converge (inputs: last iterate) or the result is not finite (inputs: previous ones).
    solved: bool


@dataclass
class Controller:
    """Controller with one model and horizon. Call `control` every `tuning.step` [s]; it starts from its last solution.

    steps: number in the horizon. corridor: whether `control` gets limits of the lateral deviation.
    """

    model: Model
    vehicle: VehicleParameters
    steps: int
    tuning: Tuning = field(default_factory=Tuning)
    solver: str = "ipopt"
    corridor: bool = False

    def __post_init__(self):
        self.symbolic = build(self.model, self.vehicle, self.tuning.substeps)
        if self.symbolic.parameters:
            raise ValueError(f"model {self.model.name}: {self.symbolic.parameters[0].name} has no value; give it one")
        self._states = len(self.symbolic.states)
        self._last = (0.0, 0.0)
        self._guess: np.ndarray | None = None
        self._duals = None
        self._build_problem()

    def _build_problem(self) -> None:
        t, n, steps = self.tuning, self._states, self.steps
        limits = steps if self.corridor else 0
        variables = casadi.MX.sym("variables", (2 + n) * steps + limits)
        parameters = casadi.MX.sym("parameters", n + 2 + 4 * steps + 2 * limits)
        rows = casadi.reshape(variables[:(2 + n) * steps], 2 + n, steps)
        reference = casadi.reshape(parameters[n + 2:n + 2 + 4 * steps], 4, steps)
        x, last, residuals, gaps, changes = parameters[:n], parameters[n:n + 2], [], [], []
        for k in range(steps):
            u, following = rows[:2, k], rows[2:, k]
            gaps.append(self.symbolic.step(x, u, t.step) - following)
            change = u - last
            weights = casadi.vertcat(t.steering_change ** 0.5, t.acceleration_change ** 0.5)
            residuals += [self._stage_residuals(following, u, reference[:, k]), weights * change]
            changes.append(change)
            x, last = following, u
        excess, bounds = variables[(2 + n) * steps:], parameters[n + 2 + 4 * steps:]
        residuals = casadi.vertcat(*residuals, t.outside ** 0.5 * excess)
        low, high = bounds[:limits], bounds[limits:]
        distances = casadi.vertcat(*[self._across(rows[2:, k], reference[:, k]) for k in range(limits)])
        margins = casadi.vertcat(distances + excess - low, high + excess - distances) if limits else casadi.MX(0, 1)
        problem = {"x": variables, "f": casadi.sumsqr(residuals),
                   "g": casadi.vertcat(*gaps, *changes, margins), "p": parameters}
        name, options = SOLVERS[self.solver]
        if self.solver == "rti":
            options = {**options, "hess_lag": self._gauss_newton(variables, parameters, residuals, problem["g"])}
        self._solve = casadi.nlpsol("mpc", name, problem, {**options, "expand": True})
        max_change = [t.angle_change, t.acceleration_step] * steps
        self._limits = {"lbg": [0.0] * (n * steps) + [-v for v in max_change] + [0.0] * (2 * limits),
                        "ubg": [0.0] * (n * steps) + max_change + [np.inf] * (2 * limits),
                        "lbx": [-t.angle, t.acceleration[0], *[-np.inf] * n] * steps + [0.0] * limits,
                        "ubx": [t.angle, t.acceleration[1], *[np.inf] * n] * steps + [np.inf] * limits}

    @staticmethod
    def _gauss_newton(variables, parameters, residuals, constraints):
        """Hessian 2 J' J: positive semidefinite, so that every quadratic program has a minimum."""
        jacobian = casadi.jacobian(residuals, variables)
        scale, multipliers = casadi.MX.sym("scale"), casadi.MX.sym("multipliers", constraints.numel())
        return casadi.Function("hessian", [variables, parameters, scale, multipliers],
                               [2.0 * scale * casadi.mtimes(jacobian.T, jacobian)],
                               ["x", "p", "lam_f", "lam_g"], ["hess_gamma_x_x"]).expand()

    @staticmethod
    def _across(x, reference):
        return casadi.cos(reference[2]) * (x[1] - reference[1]) - casadi.sin(reference[2]) * (x[0] - reference[0])

    def _stage_residuals(self, x, u, reference):
        t = self.tuning
        sine, cosine = casadi.sin(reference[2]), casadi.cos(reference[2])
        off_x, off_y = x[0] - reference[0], x[1] - reference[1]
        rates = self.symbolic.dynamics(x, u)
        return casadi.vertcat(t.across ** 0.5 * self._across(x, reference),
                              t.along ** 0.5 * (cosine * off_x + sine * off_y),
                              t.course ** 0.5 * (cosine * rates[1] - sine * rates[0]),
                              t.speed ** 0.5 * (x[2] - reference[3]))

    def reset(self) -> None:
        """Discard the last solution; call this before a new drive."""
        self._last, self._guess, self._duals = (0.0, 0.0), None, None

    def control(self, state: tuple[float, ...], reference: Reference,
                corridor: tuple[np.ndarray, np.ndarray] | None = None,
                measured: tuple[float, float] | None = None) -> Solution:
        """Solution that starts from the six states at the CG; the yaw of car and path need not be wrapped.

        corridor: (lower, upper) limits of the lateral deviation at the end of each step, left > 0, (steps,) [m].
        measured: current inputs, required if the car does not follow the last solution.
        """
        self._last = self._last if measured is None else measured
        start = self.symbolic.start(state, self._last).full().ravel()
        if self._guess is None:
            self._guess = self._rollout(start)
        p = np.concatenate([start, self._last, np.column_stack(reference).ravel(), *(corridor or ())])
        count = (2 + self._states) * self.steps
        initial = np.concatenate([self._guess.ravel(), np.zeros(self.steps if self.corridor else 0)])
        warm_start = {"lam_x0": self._duals[0], "lam_g0": self._duals[1]} if self._duals else {}
        wall, cpu = perf_counter(), process_time()
        result = self._solve(x0=initial, p=p, **self._limits, **warm_start)
        wall, cpu = perf_counter() - wall, process_time() - cpu
        rows = result["x"].full()[:count].reshape(self.steps, 2 + self._states)
        statistics = self._solve.stats()
        if not np.all(np.isfinite(rows)):
            self._guess, self._duals = None, None
            return Solution(self._last, np.empty((0, 2)), np.empty((0, self._states)), wall, cpu,
                            statistics["iter_count"], False)
        t = self.tuning
        angle, acceleration = np.clip(rows[0, :2], [-t.angle, t.acceleration[0]], [t.angle, t.acceleration[1]])
        self._last = float(angle), float(acceleration)
        self._guess, self._duals = np.vstack([rows[1:], rows[-1]]), (result["lam_x"], result["lam_g"])
        return Solution(self._last, rows[:, :2], rows[:, 2:], wall, cpu, statistics["iter_count"],
                        self.solver == "rti" or bool(statistics["success"]))

    def _rollout(self, start: np.ndarray) -> np.ndarray:
        rows, x = [], start
        for _ in range(self.steps):
            x = self.symbolic.step(x, self._last, self.tuning.step).full().ravel()
            rows.append([*self._last, *x])
        return np.array(rows)
