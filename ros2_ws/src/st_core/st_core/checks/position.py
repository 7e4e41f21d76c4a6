"""Checks of positions against velocity and yaw, by an identity that is valid for any vehicle:

    p(t2) - p(t1) = integral of R(yaw) v dt,   over windows of one second

Each cause of a residual contributes a term that is linear in the size of the cause:

    x or y scale s        p = s p_true                           s - 1 times the derived displacement along that axis
    velocity scale 1/s    v = v_true / s                         s - 1 times the derived displacement
    lateral scale 1/s     v_y = v_y_true / s                     s - 1 times the integral of R(yaw) (0, v_y) dt
    map shear h           x = x_true + h y_true                  h times the displacement north, in x
    yaw offset a          yaw = yaw_true + a                     -a times the displacement, rotated by +90 deg
    yaw drift w           yaw = yaw_true + w (t - start)         as a yaw offset of w (t - start)
    position lag T        p(t) = p_true(t - T)                   -T (V2 - V1),  V = R(yaw) v
    velocity lag T        v(t) = v_true(t - T), body axes        +T integral of R(yaw) dv/dt dt, both axes or only x
    reference a, side b   p at a point a [m] ahead, b left       (R(yaw2) - R(yaw1)) (a, b)
    velocity bias b       v = v_true + b, one body axis          -integral of R(yaw) b dt
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from .finding import HORIZON, LIMITS, Advice, Alternative, Comparison, Finding, Severity, find, neutral_value
from .motion import Motion, has_varying_speed, is_near
from .regression import BLOCK_LENGTH, Estimate, Regression, add_systematic_uncertainty, is_relevant

WINDOW = 1.0  # s, length of the windows
HORIZON_WINDOWS = round(HORIZON / WINDOW)  # number of windows in the horizon
MIN_WINDOWS = 10
ITERATIONS = 3
MAX_RESIDUAL_LAG_RATIO = 0.5  # largest ratio of the position lag with the right yaw to that with the wrong yaw
MIN_LOSS_RATIO = 1.1  # ratio of the losses of two explanations above which the one with the smaller loss is preferred
VARIATION_INTERVAL = 20.0  # s between the instants at which the size of a varying cause is fitted
MAX_VARIATION_INTERVALS = 16  # largest number of such intervals; it limits the memory
MIN_VARIATION_RATIO = 2.0  # ratio of the losses per degree of freedom above which a cause varies
MIN_SIGN_GAIN = 0.01  # m; minimum reduction of the misfit by the opposite sign; RTK noise is 1 cm
MIN_LATERAL_VELOCITY = 0.02  # m/s, root mean square
MAX_WHEEL_SLIP = 0.02  # s^2/m; slip of a wheel per acceleration; 0.01 for a longitudinal stiffness of 10 Fz
# m; RMS motion across a straight below which no scale error, except a unit error, causes a warning
MIN_WIDTH = LIMITS.warning_effect / (LIMITS.unit_ratio - 1.0)
SPHERICAL_EARTH_SCALE = 0.005  # largest scale error per axis of a projection on a spherical earth
MIN_VELOCITY_BIAS = 0.05  # m/s; INS velocities are accurate to 0.03
# Smallest reported relative error of velocity_y alone. At a point 1.5 m ahead of the rear axle, an error of 0.25 m
# changes velocity_y by 0.17 of its value.
MIN_LATERAL_SCALE_ERROR = 0.15
Names = tuple[str, ...]  # of causes
AXIS_SCALES = ("x_scale", "y_scale")
VELOCITY_SCALES = ("velocity_scale", "velocity_y_scale")
# Causes that are confounded at constant speed. Only one of them is fitted.
LAG_OF_VELOCITY_X = {"velocity_x_lag": {"velocity_lag", "position_lag"}}
BIASES = {"velocity_x_bias": {*AXIS_SCALES, "velocity_scale"}, "velocity_y_bias": {"yaw_offset"}}
CONFOUNDED = {"velocity_scale": {*AXIS_SCALES, "velocity_x_bias"}, "yaw_offset": {"velocity_y_bias"}, **BIASES,
              "velocity_lag": {"velocity_x_lag"}, "velocity_x_lag": {"velocity_lag"},
              **{axis: {"velocity_scale", "velocity_x_bias"} for axis in AXIS_SCALES}}
RARE_CAUSES = {*BIASES, *LAG_OF_VELOCITY_X, "velocity_y_scale", "position_side"}
# Causes that are not fitted, by the rare causes fitted together instead. Rare causes are preferred to others if
# their loss is clearly smaller, or if they are fewer and their loss is not clearly larger.
RARE_EXPLANATIONS: Mapping[tuple[str, ...], set[str]] = {
    **{(name,): confounded for name, confounded in (BIASES | LAG_OF_VELOCITY_X).items()},
    ("velocity_y_scale",): {"position_reference", "yaw_offset"},
    ("velocity_y_scale", "position_reference"): {"yaw_offset"},
    ("position_side",): set(),
}
MIN_REPORTED_VALUES = {"s": LIMITS.lag, "m": LIMITS.ins_position, "m/s": MIN_VELOCITY_BIAS,
                       "velocity_y_scale": MIN_LATERAL_SCALE_ERROR}
"""Smallest reported value of a cause, by its name or unit."""
_LATERAL_SCALE = (("velocity_y_scale",), ("velocity_y_scale", "position_reference"))
LATERAL_CAUSES = {"velocity_y_scale": (("position_reference", "yaw_offset"),), "position_reference": _LATERAL_SCALE,
                  "yaw_offset": _LATERAL_SCALE}
"""Causes that may explain the same residual in a drive at one speed, by the cause found."""

ALTERNATIVE_LAGS = {"velocity_lag": Alternative("only velocity_x does", ("velocity_x_lag",)),
                    "velocity_x_lag": Alternative("velocity_y also does", ("velocity_lag",))}
"""Lag that may explain the same residual where velocity_y is small, by the cause found."""
OPPOSITE_LATERAL_SIGN = "velocity_y has the opposite sign (left is positive)"
OPPOSITE_SIGN_FINDING = Finding("velocity_y_scale", Severity.ERROR, ("velocity_y",), OPPOSITE_LATERAL_SIGN, -1.0,
                                advice=Advice.correct("velocity_y", scale=-1.0))
VARY_BENDS = Advice("text", "drive bends at different speeds and radii to distinguish the two")


class Cause(NamedTuple):
    """A cause of a residual. channels, unit, text: of its finding. corrected_channel, key: of its entry in run.yaml; if
    corrected_channel is "", no correction exists, and key is the text of the advice."""

    channels: tuple[str, ...]
    corrected_channel: str
    key: str
    unit: str
    text: str


CAUSES = {
    "x_scale": Cause(("x",), "x", "scale", "1", "x is {value:.4f} ± {half:.4f} times the integrated velocity: scaled "
                     "by the cosine of a different latitude?"),
    "y_scale": Cause(("y",), "y", "scale", "1", "y is {value:.4f} ± {half:.4f} times the integrated velocity: "
                     "projected with a different earth radius?"),
    "map_shear": Cause(("x",), "", "project latitude and longitude with an origin near the drive", "1", "x {change} by "
                       "{size:.4f} ± {half:.4f} m per metre north: projected far from its origin?"),
    "velocity_scale": Cause(("velocity_x", "velocity_y"), "velocity", "scale", "1",
                            "velocity is {value:.4f} ± {half:.4f} times the rate of change of positions"),
    "velocity_y_scale": Cause(("velocity_y",), "velocity_y", "scale", "1", "velocity_y is {value:.3f} ± {half:.3f} "
                              "times its value from positions, yaw and velocity_x"),
    "yaw_offset": Cause(("yaw",), "yaw", "add", "rad", "yaw points {size:.4f} ± {half:.4f} rad ({degrees:.2f} deg) too "
                        "far {side} according to positions and velocities; or is the map rotated or distorted?"),
    "yaw_drift": Cause(("yaw",), "", "use an INS with two antennas, or drive bends while it aligns: no constant "
                       "correction exists", "rad/s", "yaw drifts to the {side} by {size:.2g} ± {half:.1g} rad/s "
                       "({per_minute:.2f} deg per minute) compared with positions and velocities"),
    "position_lag": Cause(("x", "y"), "position", "earlier", "s",
                          "positions {lag} velocity and yaw by {size:.3f} ± {half:.3f} s"),
    "velocity_lag": Cause(("velocity_x", "velocity_y"), "velocity", "earlier", "s",
                          "velocities {lag} positions and yaw by {size:.3f} ± {half:.3f} s"),
    "velocity_x_lag": Cause(("velocity_x",), "velocity_x", "earlier", "s",
                            "velocity_x, unlike velocity_y, {lag}s positions and yaw by {size:.3f} ± {half:.3f} s"),
    "position_reference": Cause(("x", "y"), "position", "ahead", "m", "positions refer to a point {size:.2f} ± "
                                "{half:.2f} m {ahead} that of velocities"),
    "position_side": Cause(("x", "y"), "", "set the lever arm of the antenna in the INS: no correction exists", "m",
                           "positions refer to a point {size:.2f} ± {half:.2f} m to the {side} of that of velocities"),
    "velocity_x_bias": Cause(("velocity_x",), "velocity_x", "add", "m/s", "velocity_x is {size:.2f} ± {half:.2f} m/s "
                             "too {high} compared with positions, at every speed"),
    "velocity_y_bias": Cause(("velocity_y",), "velocity_y", "add", "m/s", "velocity_y is {size:.2f} ± {half:.2f} m/s "
                             "too {high} compared with positions and yaw, at every speed"),
}
VARYING_CAUSES = (  # cause, what it varies with, smallest reported standard deviation, finding, statement, advice
    ("yaw_offset", "time", LIMITS.heading_misalignment, "yaw_wander", "yaw wanders by up to {size:.3f} rad "
     "({degrees:.1f} deg) during the drive according to positions and velocities", CAUSES["yaw_drift"].key),
    ("yaw_offset", "heading", LIMITS.heading_misalignment, "yaw_wander", "the error of yaw depends on the heading and "
     "varies by up to {size:.3f} rad ({degrees:.1f} deg): is yaw from a compass near iron?",
     "calibrate the compass in the car, or use an INS with two antennas: no constant correction exists"),
    ("position_lag", "time", LIMITS.severe_lag, "position_lag", "the lag of positions behind velocity and yaw varies "
     "by up to {size:.2f} s during the drive",
     "stamp positions with the time of their measurement: no constant correction exists"),
    ("velocity_scale", "time", SPHERICAL_EARTH_SCALE, "velocity_scale", "the ratio of velocity to the rate of change "
     "of positions varies by up to {size:.3f} during the drive",
     "check the source of the velocity: no constant correction exists"),
)
VARYING_FINDINGS = tuple(name for *_, name, _, _ in VARYING_CAUSES)
SPHERE_TEXT = "{axis} is {value:.4f} ± {half:.4f} times the integrated velocity: projected on a spherical earth?"


def make_residual_regression(motion: Motion) -> Regression:
    """Regression of the residual of the identity on the effects of all causes, by window."""
    windows = motion.make_windows(WINDOW)
    # Vectors in the map frame are complex: east + i north.
    velocity, heading = motion.velocity_map, np.exp(1j * motion.yaw)
    displacement, velocity_change = windows.integral(velocity), windows.change(velocity)
    forward, integrated_heading = motion.velocity_x * heading, windows.integral(heading)
    columns = {
        "x_scale": displacement.real, "y_scale": 1j * displacement.imag, "map_shear": displacement.imag,
        "velocity_scale": displacement, "velocity_y_scale": windows.integral(1j * motion.velocity_y * heading),
        "yaw_offset": -1j * displacement, "position_lag": -velocity_change,
        "yaw_drift": -1j * displacement * (windows.time + 0.5 * WINDOW - motion.time[0]),
        "velocity_lag": velocity_change - windows.integral(1j * motion.yaw_rate * velocity),
        "velocity_x_lag": windows.change(forward) - windows.integral(1j * motion.yaw_rate * forward),
        "position_reference": windows.change(heading), "position_side": 1j * windows.change(heading),
        "velocity_x_bias": -integrated_heading, "velocity_y_bias": -1j * integrated_heading,
    }
    measured = windows.change(motion.position)
    residual = measured - displacement
    sums = np.cumsum((measured, displacement), axis=1)
    change = sums[:, HORIZON_WINDOWS:] - sums[:, :-HORIZON_WINDOWS]
    across = (change * np.exp(-0.5j * np.angle(np.square(change).sum(axis=1, keepdims=True)))).imag
    if np.square(across).sum(axis=1).min() <= MIN_WIDTH**2 * change.shape[1]:
        columns |= {name: np.zeros_like(displacement) for name in (*AXIS_SCALES, "map_shear")}
    return Regression(windows.time, np.stack((residual.real, residual.imag), axis=1),
                      {name: np.stack((column.real, column.imag), axis=1) for name, column in columns.items()})


class _Explanation(NamedTuple):
    causes: dict[str, Estimate]
    corrected: Motion  # motion corrected for the causes
    effects: dict[str, float]  # shift of the position at the end of the horizon by each possible cause [m per unit]


def _explain_residual(motion: Motion, rare_explanations: Mapping[tuple[str, ...], set[str]]) -> _Explanation:
    """The causes found by repeated selection and correction. rare_explanations: those of RARE_EXPLANATIONS to try."""
    causes: dict[str, Estimate] = {}
    corrected, slips, correction = motion, set[str](), dict[str, float]()
    for _ in range(ITERATIONS):  # the effect of a large cause is nonlinear and biases the other estimates
        problem = make_residual_regression(corrected)
        effects = {name: problem.compute_effect(name, HORIZON_WINDOWS) for name in problem.columns}  # m per unit
        min_values = {name: max(LIMITS.min_reported_effect / max(effect, 1e-9),
                                MIN_REPORTED_VALUES.get(name, MIN_REPORTED_VALUES.get(CAUSES[name].unit, 0.0)))
                      for name, effect in effects.items()}
        explanations = {names: confounded for names, confounded in rare_explanations.items()
                        if names == ("position_side",) or has_varying_speed(motion.velocity_x)}
        refined = _refine_causes(problem, causes, min_values, explanations)
        for name in [n for n in ALTERNATIVE_LAGS if n in refined]:  # at constant acceleration, a bias acts like a lag
            lag = problem.estimate(tuple(dict.fromkeys((*refined, "velocity_x_bias"))))[name]
            slips = slips - {name} | ({name} if _is_wheel_slip(problem, correction, name, tuple(refined)) else set())
            if not is_relevant(_add_refinement(name, causes, lag), min_values[name]):
                del refined[name]
        # An axis scale that differs from 1 as much as a wrong unit is kept only if its effect is enough for a warning.
        causes = {name: estimate for name, estimate in refined.items() if is_relevant(estimate, min_values[name]) and (
            name not in AXIS_SCALES or abs(estimate.value) * effects[name] >= LIMITS.warning_effect
            or is_near(1.0 + estimate.value, 1.0, LIMITS.unit_ratio))}
        # The slip of a wheel is not a fault. At nearly constant speed v, it acts like a lead c v, see `_is_wheel_slip`.
        correction = {"velocity_x_lag" if name in slips else name: estimate.value for name, estimate in causes.items()}
        corrected = _correct_causes(motion, correction)
        if not causes:
            break
    return _Explanation({name: causes[name] for name in causes if name not in slips}, corrected, effects)


def _is_wheel_slip(problem: Regression, correction: Mapping[str, float], lag: str, causes: Names) -> bool:
    """Whether a wheel speed v (1 + c a_x), with slip c per acceleration, fits better than `lag`, a lag of velocity.
    problem: for the motion after `correction`, since the effect of a large lag is linear only near its value."""
    speed = np.linalg.norm(problem.columns["velocity_scale"], axis=1)[:, None] / WINDOW
    recorded = 2.0 * problem.y - problem.compute_residual(correction)
    with_lag, with_slip = (Regression(problem.time, recorded, {**problem.columns, lag: column}) for column in (
        problem.columns[lag], speed * problem.columns["velocity_x_lag"]))
    _, scale, _ = with_lag.fit(causes)
    return (-MAX_WHEEL_SLIP < with_slip.fit(causes)[0][lag] < 0.0
            and with_slip.compute_loss(causes, scale) < with_lag.compute_loss(causes, scale))


def _fits_better(problem: Regression, causes: Names, other_problem: Regression, other_causes: Names) -> bool:
    """Whether `causes` have a clearly smaller loss than `other_causes`, or are fewer without a clearly larger loss."""
    _, scale, _ = other_problem.fit(other_causes)
    ratio = MIN_LOSS_RATIO if len(causes) >= len(other_causes) else 1.0 / MIN_LOSS_RATIO
    return ratio * problem.compute_loss(causes, scale) < other_problem.compute_loss(other_causes, scale)


def check_positions(motion: Motion) -> tuple[Motion, list[Finding], dict[str, Estimate]]:
    """(motion corrected for the causes found, the findings, reported estimates of all causes that have an
    effect); with fewer than MIN_WINDOWS windows, the motion as given and no estimates."""
    if len(motion.make_windows(WINDOW)) < MIN_WINDOWS:
        return motion, [], {}
    explanation = _explain_residual(motion, RARE_EXPLANATIONS)
    # Rare causes were selected from a linear approximation, which is inaccurate where another cause is large.
    for rare in sorted(RARE_CAUSES & explanation.causes.keys()):
        others = {names: confounded for names, confounded in RARE_EXPLANATIONS.items()
                  if rare not in names and {*names} <= explanation.causes.keys()}
        without = _explain_residual(motion, others)
        problems = [make_residual_regression(each.corrected) for each in (explanation, without)]
        if not _fits_better(problems[0], (*explanation.causes,), problems[1], (*without.causes,)):
            explanation = without
    explanation, varying_findings = _find_varying_cause(motion, explanation)
    causes, corrected, effects = explanation
    if causes.keys() >= {"yaw_offset", "yaw_drift"}:  # the best constant correction of a drift is its mean
        change = causes["yaw_drift"].value * float(np.ptp(motion.time))
        causes |= {"yaw_offset": causes["yaw_offset"].shifted(0.5 * change)}
    problem = make_residual_regression(corrected)
    findings = [_make_finding(name, estimate, effects[name]) for name, estimate in causes.items()
                if not _convert_to_reported(name, estimate).covers(neutral_value(name))]
    findings = _add_lag_alternative(_add_lateral_alternative(findings, problem, causes), problem, causes)
    findings = varying_findings + [f for f in findings if f.name not in {v.name for v in varying_findings}]
    estimates = {}
    for name, column in problem.columns.items():  # each is fitted together with the causes found
        if column.any():
            alongside = tuple(other for other in causes if other != name and other not in CONFOUNDED.get(name, ()))
            estimate = _add_refinement(name, causes, problem.estimate((*alongside, name))[name])
            estimates[name] = _convert_to_reported(name, estimate)
    estimates["position_scale"] = estimates["velocity_scale"].inverse()  # assumes a correct velocity
    return corrected, findings, estimates


def _make_heading_terms(motion: Motion, time: np.ndarray) -> np.ndarray:
    """(n, 5) constant, first and second harmonic of the heading at these times [s]: hard and soft iron of a compass."""
    yaw = np.interp(time, motion.time, motion.yaw)
    return np.stack([np.ones(len(time)), *(f(k * yaw) for k in (1, 2) for f in (np.sin, np.cos))], axis=1)


def _find_varying_cause(motion: Motion, explanation: _Explanation) -> tuple[_Explanation, list[Finding]]:
    """(explanation, finding) with a cause that varies with time, linearly between instants at equal intervals, or with
    the heading, if it explains the positions far better than constant causes; otherwise, and without v_y, (explanation
    as given, [])."""
    problem, corrected = make_residual_regression(motion), make_residual_regression(explanation.corrected)
    middle = problem.time + 0.5 * WINDOW
    count = int(np.clip(np.ptp(middle) / VARIATION_INTERVAL, 2, MAX_VARIATION_INTERVALS)) + 1
    instants = np.linspace(middle[0], middle[-1], count)

    def make_terms(quantity: str, time: np.ndarray) -> np.ndarray:  # (n, number of terms)
        if quantity == "time":
            return np.stack([np.interp(time, instants, row) for row in np.eye(count)], axis=1)
        return _make_heading_terms(motion, time)

    fits: list[tuple[float, np.ndarray]] = []
    for cause, quantity, *_ in VARYING_CAUSES:
        terms = make_terms(quantity, middle)
        columns = {str(k): problem.columns[cause] * term[:, None] for k, term in enumerate(terms.T)}
        varying = Regression(problem.time, problem.y, {**problem.columns, **columns})
        names = (*columns, *dict.fromkeys((*AXIS_SCALES, *explanation.causes)))
        values, scale, _ = varying.fit(names)
        loss = varying.compute_loss(names, scale)
        # Any further constant cause is preferred, even where the drive does not determine it.
        constant_loss = min(corrected.compute_loss(tuple(dict.fromkeys((*explanation.causes, other))), scale)
                            for other in corrected.columns)
        # Fraction of the degrees of freedom, two per block of windows, that remains after fitting the values.
        remaining = 1.0 - len(columns) * BLOCK_LENGTH / (2.0 * np.ptp(middle))
        fits.append((loss / max(remaining * constant_loss, 1e-300), np.array([values[label] for label in columns])))
    best = min(range(len(fits)), key=lambda k: fits[k][0])
    (ratio, theta), (cause, quantity, smallest, name, statement, advice) = fits[best], VARYING_CAUSES[best]
    value = make_terms(quantity, motion.time) @ theta
    if not motion.velocity_y.any() or not 0.0 < ratio * MIN_VARIATION_RATIO <= 1.0 or np.std(value) < smallest:
        return explanation, []
    size = float(np.ptp(value))
    value -= theta[0] if quantity == "heading" else value.mean() if cause == "yaw_offset" else 0.0  # without offset
    effect = float(np.std(value)) * problem.compute_effect(cause, HORIZON_WINDOWS)
    finding = Finding(name, LIMITS.severity(effect), CAUSES[cause].channels, statement.format(
        size=size, degrees=np.rad2deg(size)), size if name not in CAUSES else None, CAUSES[cause].unit, effect=effect,
        advice=Advice("text", advice))
    explanations = {names: confounded for names, confounded in RARE_EXPLANATIONS.items() if cause not in confounded}
    return _explain_residual(_correct_causes(motion, {cause: value}), explanations), [finding]


def attribute_scale_to_positions(motion: Motion, findings: list[Finding], estimates: dict[str, Estimate],
                                 confirm: Callable[[float], str | None]) -> tuple[Motion, list[Finding]]:
    """(motion, findings) with a scale error of the velocity attributed to the positions instead, if other measurements
    confirm the recorded velocity. confirm: `inertial.confirm_velocity` of the drive."""
    velocity_scale = find(findings, "velocity_scale")
    if velocity_scale is None or not velocity_scale.value or not (confirmed_by := confirm(velocity_scale.value)):
        return motion, findings
    scale = estimates["position_scale"]
    text = (f"x and y are {scale.value:.4g} ± {scale.half_width:.4f} times the integrated velocity, which agrees with "
            f"{confirmed_by}")
    advice = Advice.correct("position", scale=float(f"{1.0 / scale.value:.5g}"))
    attributed = replace(velocity_scale, name="position_scale", channels=("x", "y"), statement=text,
                         value=scale.value, interval=scale.interval, advice=advice)
    factor = {"scale": velocity_scale.value}
    return (motion.apply_entry({"correct": {"position": factor, "velocity": factor}}),
            [attributed if finding is velocity_scale else finding for finding in findings])


def attribute_scale_to_velocity_x(motion: Motion, findings: list[Finding],
                                  estimates: dict[str, Estimate]) -> tuple[Motion, list[Finding]]:
    """(motion, findings) with a scale error of both velocities attributed to velocity_x alone, if the findings also
    contain a scale error of velocity_y that cancels it, so that the recorded velocity_y is correct."""
    both, lateral = find(findings, "velocity_scale"), find(findings, "velocity_y_scale")
    if both is None or lateral is None or not both.value or not both.advice or "correct" not in both.advice.entry or (
            abs(both.value * (lateral.value or 0.0) - 1.0) >= MIN_LATERAL_SCALE_ERROR):
        return motion, findings
    estimates["velocity_y_scale"] = estimates["velocity_y_scale"].scaled(both.value)
    text = f"velocity_x, unlike velocity_y, is {both.value:.4g} times the rate of change of positions"
    attributed = replace(both, name="velocity_x_scale", channels=("velocity_x",), statement=text,
                         advice=Advice.correct("velocity_x", **both.advice.entry["correct"]["velocity"]))
    return (motion.apply_entry({"correct": {"velocity_y": {"scale": both.value * (lateral.value or 1.0)}}}),
            [attributed if finding is both else finding for finding in findings if finding is not lateral])


def compute_scaled_misfit(motion: Motion, *causes: str, from_compass: bool = False) -> float:
    """Median misfit of positions and velocity per second [m], inf for a short drive; axis scales, `causes` and, if
    from_compass, an error of yaw that depends on the heading are fitted."""
    problem = make_residual_regression(motion)
    if len(problem.time) < MIN_WINDOWS:
        return np.inf
    terms = _make_heading_terms(motion, problem.time + 0.5 * WINDOW).T if from_compass else ()
    columns = {str(k): problem.columns["yaw_offset"] * term[:, None] for k, term in enumerate(terms)}
    return Regression(problem.time, problem.y, {**problem.columns, **columns}).fit((*AXIS_SCALES, *causes, *columns))[1]


def positions_confirm_yaw_lag(motion: Motion, corrected: Motion, lag: float) -> bool | None:
    """Whether yaw, not the yaw rate, lags by `lag` [s]; None if both fit. corrected: the motion without that lag. At
    constant speed v, a lag T of yaw, a lag -T of the positions, and a reference point v T ahead have the same effect.
    The yaw for which the fitted position lag is smaller is correct, whatever the reference point. If the drive does not
    determine this lag, the reference point is assumed to be that of the velocities. False for a short drive."""
    problems = make_residual_regression(motion), make_residual_regression(corrected)
    if len(problems[0].time) < MIN_WINDOWS:
        return False
    causes = (*AXIS_SCALES, "position_lag", "velocity_lag", "velocity_x_lag")
    with_reference = (*causes, "position_reference")
    is_yaw = _has_clearly_smaller_lag(*problems, with_reference)
    is_small = abs(lag) < LIMITS.severe_lag  # a small error of the velocities has the effect of a small lag of yaw
    if is_small or is_yaw is not None:
        return None if is_small and is_yaw else is_yaw
    is_yaw = _has_clearly_smaller_lag(*problems, causes)
    if is_yaw is None:
        return None
    # Changes of speed may still contradict this assumption.
    _, scale, _ = problems[is_yaw].fit(with_reference)
    losses = [problem.compute_loss(with_reference, scale) for problem in problems]
    return None if losses[is_yaw] > MIN_LOSS_RATIO * losses[not is_yaw] else is_yaw


def _has_clearly_smaller_lag(recorded: Regression, corrected: Regression, causes: tuple[str, ...]) -> bool | None:
    """Whether the position lag, fitted with other causes, is clearly smaller in the corrected motion than in the
    recorded one (False: larger); None if neither is clearly smaller."""
    lags = [abs(add_systematic_uncertainty("position_lag", problem.estimate(causes)["position_lag"]))
            for problem in (recorded, corrected)]
    smaller, larger = sorted(lags, key=lambda lag: lag.value)
    if not larger.is_significant or smaller.value > MAX_RESIDUAL_LAG_RATIO * larger.value:
        return None
    return smaller is lags[1]


def correct_lateral_sign(motion: Motion) -> tuple[Motion, Finding | None]:
    """Correct a velocity_y of opposite sign, if no common cause explains the positions equally well."""
    problem, mirrored = make_residual_regression(motion), replace(motion, velocity_y=-motion.velocity_y)
    if len(problem.time) < MIN_WINDOWS or float(np.sqrt(np.mean(motion.velocity_y**2))) < MIN_LATERAL_VELOCITY:
        return motion, None
    yaw_rate = motion.yaw_rate
    reference = -2.0 * float(motion.velocity_y @ yaw_rate) / max(float(yaw_rate @ yaw_rate), 1e-12)  # m
    # The map may also be rotated from the middle of the drive on.
    first_half = problem.columns["yaw_offset"] * (problem.time < np.median(problem.time))[:, None]
    rotated = Regression(problem.time, problem.y, {**problem.columns, "first_half": first_half})
    misfits = [rotated.fit((*AXIS_SCALES, "yaw_offset", "first_half"))[1]]
    for name in problem.columns.keys() - {*AXIS_SCALES, *RARE_CAUSES, "velocity_scale"}:
        theta, misfit, _ = problem.fit((*AXIS_SCALES, name))
        # v_y is mostly the yaw rate times a distance d, so a wrong sign resembles a reference point 2 d away.
        expected, fitted = abs(reference), theta[name] * np.sign(reference)
        if name != "position_reference" or not 0.75 * expected < fitted < 1.33 * expected:
            misfits.append(misfit)
    is_opposite = compute_scaled_misfit(mirrored) < min(0.8 * min(misfits), min(misfits) - MIN_SIGN_GAIN)
    return (mirrored, OPPOSITE_SIGN_FINDING) if is_opposite else (motion, None)


def _add_lateral_alternative(findings: list[Finding], problem: Regression,
                             causes: dict[str, Estimate]) -> list[Finding]:
    """The findings; if a scale of velocity_y explains the residual as well as other causes do, the findings name both
    and have no correction. problem: regression for the motion corrected for the causes."""
    found = tuple(name for name in LATERAL_CAUSES if name in causes)
    if not found or {*found} > {"velocity_y_scale"}:
        return findings
    candidates = [names for names in LATERAL_CAUSES[found[0]] if not {*found} <= {*names}]
    others, values = _find_equivalent(problem, causes, found, candidates, AXIS_SCALES)
    if not others:
        return findings
    text = "the reference point of the positions and the yaw offset are wrong"
    if "velocity_y_scale" in others:
        fraction = 1.0 + values["velocity_y_scale"]  # of the lateral velocity of the positions
        text = (OPPOSITE_LATERAL_SIGN if is_near(fraction, -1.0, LIMITS.unit_ratio) else
                "positions were computed without velocity_y" if abs(fraction) < MIN_LATERAL_SCALE_ERROR else
                f"velocity_y is {1.0 / fraction:.2f} times its true value")
        if "position_reference" in others:
            text += f" and positions refer to a point {values['position_reference']:+.2f} m ahead"
    alternative = Alternative(text, others)
    return [finding.with_alternative(alternative, VARY_BENDS, "velocity_y") if finding.name in found else finding
            for finding in findings]


def _add_lag_alternative(findings: list[Finding], problem: Regression, causes: dict[str, Estimate]) -> list[Finding]:
    """The findings; if a lag of both velocities fits as well as a lag of velocity_x, they name both and correct only
    velocity_x, which lags in both cases. problem: regression for the motion corrected for the causes."""
    found = tuple(name for name in ALTERNATIVE_LAGS if name in causes)
    if not found:
        return findings
    alternative = ALTERNATIVE_LAGS[found[0]]
    alongside = tuple(name for name in causes if name not in found)
    if not _find_equivalent(problem, causes, found, [alternative.findings], alongside)[0]:
        return findings
    advice = Advice.correct("velocity_x", earlier=float(f"{causes[found[0]].value:.5g}"))
    return [replace(finding, alternatives=(alternative,), advice=advice) if finding.name in found else finding
            for finding in findings]


def _find_equivalent(problem: Regression, causes: dict[str, Estimate], found: Names, candidates: Sequence[Names],
                     alongside: Names) -> tuple[Names, dict[str, float]]:
    """(candidates that explain the effects of the causes found equally well, their values); ((), {}) if there are
    none. problem: for the corrected motion. alongside: causes that are also fitted."""
    sizes = {name: causes[name].value for name in found}
    if "velocity_y_scale" in sizes:  # its column is that of the corrected velocity_y
        sizes = {name: value / (1.0 + value) for name, value in sizes.items()}
    recorded = Regression(problem.time, 2.0 * problem.y - problem.compute_residual(sizes), problem.columns)
    _, scale, _ = recorded.fit((*alongside, *found))
    losses = {names: recorded.compute_loss((*alongside, *names), scale) for names in (found, *candidates)}
    others = min(candidates, key=lambda names: MIN_LOSS_RATIO ** len(names) * losses[names])
    if losses[others] > MIN_LOSS_RATIO * losses[found]:
        return (), {}
    return others, recorded.fit((*alongside, *others))[0]


def _refine_causes(problem: Regression, causes: dict[str, Estimate], min_values: dict[str, float],
                   rare_explanations: Mapping[tuple[str, ...], set[str]]) -> dict[str, Estimate]:
    """Refined values of the causes found so far, and further causes. min_values: smallest reported value by cause."""
    excluded = {*causes, *(other for name in causes for other in CONFOUNDED.get(name, ()))}
    candidates = [name for name in min_values if name not in excluded]
    common = [name for name in candidates if name not in RARE_CAUSES]
    best = (*causes, *_find_causes(problem, common, min_values, tuple(causes)))
    for rare, confounded in rare_explanations.items():
        is_tried = confounded & {*best[len(causes):]} if rare[0] in CONFOUNDED else rare == ("velocity_y_scale",) or (
            _fits_better(problem, (*best, *(name for name in rare if name not in best)), problem, best))
        if {*rare} <= {*candidates} and is_tried:
            others = [name for name in candidates if name not in {*confounded, *RARE_CAUSES, *rare}]
            alternative = (*causes, *rare, *_find_causes(problem, others, min_values, (*causes, *rare)))
            joint = problem.estimate(alternative)
            if (_fits_better(problem, alternative, problem, best)
                    and all(is_relevant(joint[name], min_values[name]) for name in rare)
                    and ("velocity_y_scale" not in rare or _has_lateral_scale_error(problem, alternative))):
                best = alternative
    return {name: _add_refinement(name, causes, estimate) for name, estimate in problem.estimate(best).items()}


def _has_lateral_scale_error(problem: Regression, causes: tuple[str, ...]) -> bool:
    """Whether the error of velocity_y is a scale error, rather than noise or drift. Errors in variables: noise in
    velocity_y biases the regression of the displacements from positions on those from velocity_y, but not the reverse
    regression. The slope of the latter is the scale and must differ from 1 as well."""
    name = "velocity_y_scale"
    columns = {other: problem.columns[other] for other in (*AXIS_SCALES, *causes) if other != name}
    columns["derived"] = problem.y + problem.columns[name]
    error = Regression(problem.time, problem.columns[name], columns).estimate(tuple(columns))["derived"].shifted(-1.0)
    return is_relevant(error, MIN_LATERAL_SCALE_ERROR) and error.value * problem.fit(causes)[0][name] < 0.0


def _add_refinement(name: str, causes: Mapping[str, Estimate], refinement: Estimate) -> Estimate:
    """Estimate of a cause, from its value so far and a refinement fitted to the corrected motion."""
    value = causes[name].value if name in causes else 0.0
    return refinement.scaled(1.0 + value if name in VELOCITY_SCALES else 1.0).shifted(value)


def _find_causes(problem: Regression, candidates: list[str], min_values: dict[str, float],
                 required: tuple[str, ...]) -> tuple[str, ...]:
    """Further causes among the candidates. min_values: smallest reported value by cause. required: causes so far."""
    selected = [name for name in candidates if name != "velocity_scale" or not problem.columns["x_scale"].any()]
    causes = problem.select_causes(selected, min_values, required, () if "velocity_scale" in required else AXIS_SCALES)
    axes = [name for name in AXIS_SCALES if name in causes]
    if "velocity_scale" not in candidates or not axes or (
            max(abs(causes[name].value) for name in axes) < SPHERICAL_EARTH_SCALE):
        return tuple(causes)
    # In GNSS positions, an equal scale error of both axes is far rarer than a scale error of the velocity.
    others = [name for name in causes if name not in axes]
    if len(axes) == 2:
        x, y = (causes[name] for name in AXIS_SCALES)
        half_width = float(np.hypot(x.half_width, y.half_width))
        is_velocity_scale = abs(x.value - y.value) - half_width < SPHERICAL_EARTH_SCALE * abs(1.0 + y.value)
    else:
        _, scale, _ = problem.fit([*required, *causes])
        # On a drive along one axis, the motion along the other axis decides between the two explanations.
        is_velocity_scale = (problem.compute_loss([*required, *others, "velocity_scale"], scale)
                             <= MIN_LOSS_RATIO * problem.compute_loss([*required, *causes], scale))
    return (*others, "velocity_scale") if is_velocity_scale else tuple(causes)


def _make_finding(name: str, estimate: Estimate, sensitivity: float) -> Finding:
    """Finding of a cause. sensitivity: shift of the position at the end of the horizon [m per unit]."""
    cause, reported = CAUSES[name], _convert_to_reported(name, estimate)
    effect = abs(reported.value - neutral_value(name)) * sensitivity
    positive, degrees = reported.value > 0.0, np.rad2deg(abs(reported.value))
    spherical = name in AXIS_SCALES and abs(estimate.value) < SPHERICAL_EARTH_SCALE
    text = (SPHERE_TEXT if spherical else cause.text).format(
        axis=name[0], value=reported.value, size=abs(reported.value), half=reported.half_width, degrees=degrees,
        per_minute=60.0 * degrees, side="left" if positive else "right",
        lag="lag" if positive else "lead", ahead="ahead of" if positive else "behind",
        change="increases" if positive else "decreases", high="high" if positive else "low")
    severity = LIMITS.severity(effect, cause.unit == "s" and abs(estimate.value) >= LIMITS.severe_lag)
    if name == "velocity_y_scale" and not is_near(reported.value, 1.0, LIMITS.unit_ratio):
        severity = Severity.ERROR
    correction = {"scale": 1.0 / (reported.value or np.inf), "earlier": reported.value}.get(cause.key, -reported.value)
    advice = (Advice.correct(cause.corrected_channel, **{cause.key: float(f"{correction:.5g}")})
              if cause.corrected_channel else Advice("text", cause.key))
    if name == "velocity_y_scale" and abs(reported.value) * MIN_LATERAL_SCALE_ERROR > 1.0:
        text += ": were the positions computed without it?"
        advice = Advice("text", "record GNSS positions")
    return Finding(name, severity, cause.channels, text, reported.value, cause.unit, reported.interval, (), effect,
                   advice)


def _convert_to_reported(name: str, cause: Estimate) -> Estimate:
    """Estimate of a cause as its finding reports it, with systematic uncertainty; a scale without error is 1."""
    if name in VELOCITY_SCALES:
        return add_systematic_uncertainty(name, cause.shifted(1.0).inverse())
    return add_systematic_uncertainty(name, cause.shifted(1.0) if name.endswith("_scale") else cause)


def _correct_causes(motion: Motion, causes: Mapping[str, Any]) -> Motion:
    """The motion corrected for causes, each constant or with one value per INS sample."""
    values = {**dict.fromkeys(CAUSES, 0.0), **causes}
    scale = 1.0 + values["velocity_scale"]
    arm = (values["position_reference"] + 1j * values["position_side"]) * np.exp(1j * motion.yaw)
    lateral_scale = scale * (1.0 + values["velocity_y_scale"])
    y = motion.y / (1.0 + values["y_scale"])
    x = motion.x / (1.0 + values["x_scale"]) - values["map_shear"] * y
    motion = replace(motion, x=x - arm.real, y=y - arm.imag,
                     yaw=motion.yaw - values["yaw_offset"] - values["yaw_drift"] * (motion.time - motion.time[0]),
                     velocity_x=motion.velocity_x * scale - values["velocity_x_bias"],
                     velocity_y=motion.velocity_y * lateral_scale - values["velocity_y_bias"])
    for cause in {"position_lag", "velocity_lag", "velocity_x_lag"} & causes.keys():
        motion = motion.shifted_earlier(values[cause], *CAUSES[cause].channels)
    return motion


def make_distance_panel(motion: Motion, factors: Mapping[str, float]) -> Comparison:
    """Distance per second in the recorded units, for a figure. factors: scale errors already corrected, by finding."""
    windows = motion.make_windows(WINDOW)
    measured, derived = np.abs(windows.change(motion.position)), np.abs(windows.integral(motion.velocity_map))
    return Comparison("position", "distance per second: positions versus velocity", "m", "from x, y",
                      "from velocity and yaw", windows.time, measured * factors.get("position_scale", 1.0),
                      derived * abs(factors.get("velocity_scale", factors.get("velocity_x_scale", 1.0))),
                      (*CAUSES, "position_scale", "velocity_x_scale", "velocity_y_scale"))
