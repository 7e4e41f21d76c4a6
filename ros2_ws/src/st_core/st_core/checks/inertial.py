"""Checks of each channel against others by kinematic relations that are valid for any vehicle.

    r = d(yaw)/dt        a_x = dv_x/dt - v_y r        a_y = dv_y/dt + v_x r

An accelerometer measures the specific force, so a slope appears as a bias of a_x, a banked road or a mounting angle as
a bias of a_y. If the accelerometer is at a distance d behind the INS point, its a_y lags by d / v at speed v.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.special import fdtri

from ..clock_fit import STEP, Fit, Pair, fit, mean_correlation, rate_noise, resample, select_common_samples
from ..clock_types import MAX_SPAN
from ..leap_seconds import LEAP_SECONDS
from ..log import DriveLog
from ..regression import symmetric_interval, white_noise
from ..timeseries import NANOSECOND
from ..tyres import STANDARD_GRAVITY
from .finding import HORIZON, LIMITS, WHEEL_SCALE_TOLERANCE, Advice, Comparison, Finding, Severity
from .motion import MIN_COHERENCE, MIN_MOVING_SPEED, Motion, correlate, find_spans, is_near
from .position import MIN_LOSS_RATIO
from .regression import Estimate, Regression, add_systematic_uncertainty, is_relevant

MAX_LAG = 1.5  # s; largest lag searched for, in both directions
MAX_CLOCK_OFFSET = 40.0  # s; largest offset between two clocks searched for; TAI is 37 s ahead of UTC
MIN_COMMON_TIME = 15.0  # s; minimum overlap of two series
NOT_FITTED, UNIT_SCALE = Estimate(0.0, 0.0, 0.0), Estimate(1.0, 0.0, 0.0)
LAG_TEST_SHIFT = 0.3  # s; a drive determines a lag if lags smaller and larger by this both fit worse
BIAS_RESIDUAL_RATIO = 1.25  # ratio of the residuals with a scale and with a bias above which a bias is reported
MIN_SCALE_CORRELATION = 0.98  # at a higher correlation, noise reduces a scale by less than 4 %
MIN_RESIDUAL_FRACTION = 1e-4  # minimum of 1 - r^2; interpolation and filters leave a residual of 1 % of the signal
GRID_ERROR = 0.1  # fraction of the variance by which the residual at a grid point may exceed a minimum between points
DECORRELATION_TIME = 10.0  # s between independent values of the lag
GYRO_CUTOFF, ACCELERATION_CUTOFF, SPEED_CUTOFF = 4.0, 1.5, 1.5  # Hz
GYRO_CORRELATION = 0.9  # minimum correlation of yaw rate and change of yaw; a coarse yaw does not reach it
GYRO_SCALE_ERROR = 0.02  # smallest reported deviation from 1; the scale of a gyroscope is accurate to 1 %
GYRO_BIAS = 0.001  # rad/s; smallest reported bias; twice the bias of a good INS
ACCELERATION_SCALE_ERROR = 0.35  # smallest reported deviation from 1; roll and pitch of the body cause up to 0.33
MIN_ACCELERATION_SCALE = 0.9  # smallest ratio to the derivative of velocity; a mounting angle of 25 deg causes this
ACCELERATION_LAG = 0.12  # s; smallest reported lag; filters of accelerometers cause delays of up to 0.1 s
MAX_GRAVITY_RATIO = 1.2  # factor by which the mean of a vertical acceleration may differ from gravity
MAX_LATITUDE = 72.0  # deg, of a road in web Mercator; the northernmost roads of Europe are at 71
MIN_UNRELATED_WINDOWS = 20  # minimum number of windows of 1 s to report an acceleration as unrelated to the motion
MIN_SENSOR_ANGLE, MAX_SENSOR_ANGLE = 0.1, 1.2  # rad; smaller ones change a_x and a_y by at most 10 % of each other
MIN_ANGLE_GAIN = 0.5  # smallest advantage over a slope; Huber loss of one window with a residual at the outlier limit
MIN_ACCELERATION_DEVIATION = 0.25  # m/s^2; minimum spread for a scale; a slope of 2.5 % has this effect
ACCELEROMETER_ARM = 1.5  # m between accelerometer and INS point
SEVERE_ACCELERATION_BIAS = 0.3  # m/s^2; a crossfall of 2.5 % causes a bias of 0.25
MIN_SPEED_DEVIATION = 0.5  # m/s; standard deviation; at constant speed, only slip and noise would be compared
SPEED_LIMITS = {"wheel_speed": (WHEEL_SCALE_TOLERANCE, 0.15), "ins_speed": (0.005, 0.03)}
"""Smallest reported (deviation of the scale from 1, lag [s]); wheel speed signals are averaged over time."""
ACCELERATIONS = ("acceleration_x", "acceleration_y")
ACCELERATION_UNITS = {1.0 / STANDARD_GRAVITY: "is its unit g"}
SPEED_UNITS = {3.6: "is its unit km/h", 2.23694: "is its unit mph", 1.0 / 3.6: "was it divided by 3.6 twice"}
CORRECTION_KEYS = {"lag": "earlier", "scale": "scale", "bias": "add"}  # keys of run.yaml


@dataclass(frozen=True, eq=False)
class Agreement:
    """Lag [s], scale [1] and bias [unit] of a measured quantity relative to a derived one."""

    lag: Estimate
    scale: Estimate
    bias: Estimate
    correlation: float  # at this lag
    spread: float  # standard deviation of the derived quantity [unit]
    time: np.ndarray  # (n,) of the filtered series at this lag, for a figure [s]
    measured: np.ndarray  # (n,) [unit]
    derived: np.ndarray  # (n,) [unit]
    other_lags: tuple[float, ...] = ()  # lags [s] that fit equally well, because the motion is periodic
    expected_lag_rejected: bool = True  # whether the lag expected without a fault fits significantly worse
    correlation_without_lag: float = 0.0
    determines_lag: bool = True  # whether lags that differ by LAG_TEST_SHIFT fit significantly worse
    drift: Estimate = NOT_FITTED  # increase of the lag per second [1]

    @property
    def correlates(self) -> bool:
        """Whether the correlation, of either sign, is high enough to compare the two series."""
        return abs(self.correlation) >= LIMITS.min_correlation

    @property
    def has_lag(self) -> bool:
        """Whether the lag is significant, and fits significantly better than the lag expected without a fault."""
        return self.lag.is_significant and self.expected_lag_rejected


def compare_series(time: np.ndarray, derived: np.ndarray, measured_time: np.ndarray, measured: np.ndarray,
                   cutoff: float, *, derived_is_angle: bool = False, fit_bias: bool = True,
                   fit_drift: bool = False, expected_lag: float = 0.0,
                   min_lag: float = 0.0, max_lag: float = MAX_LAG, max_fitted_lag: float = MAX_LAG) -> Agreement | None:
    """Agreement of two time series of a quantity. None if `derived` is constant, if the series overlap by less than
    MIN_COMMON_TIME, if one of them spans more than MAX_SPAN, if they correlate most at a lag below min_lag, if the fit
    fails, or if |lag| exceeds max_fitted_lag.

    time, measured_time: ascending [s]; values NaN where unknown. cutoff: of the low-pass filter [Hz].
    derived_is_angle: whether to compare the rate of `derived`. fit_drift: whether to estimate the drift of the lag.
    expected_lag: lag without a fault [s]. min_lag, max_lag: limits of the lags searched, in both directions [s].
    max_fitted_lag: limit of the fitted lag [s], which may be outside the searched range.
    """
    if max(float(np.ptp(t)) if len(t) else 0.0 for t in (time, measured_time)) > MAX_SPAN:
        return None
    reference = resample(time, derived, cutoff, derived_is_angle)
    other = resample(measured_time, measured, cutoff)
    if min(side.known.sum() for side in (reference, other)) * STEP < MIN_COMMON_TIME:
        return None
    pair = Pair("", reference, other)
    try:
        solution, *alternatives = _find_best_offsets(pair, cutoff, min_lag, max_lag)
    except (ValueError, np.linalg.LinAlgError):
        return None
    if not abs(solution.offset) <= max_fitted_lag:
        return None
    quantile = symmetric_interval(0.0, 1.0, max(len(reference.time) * STEP / DECORRELATION_TIME - 1.0, 1.0))[1]
    lag = Estimate(-solution.offset, solution.offset_deviation, quantile * solution.offset_deviation)
    drift = NOT_FITTED
    if fit_drift:
        drift_fit = fit([pair], solution.offset, middle=float(other.time.mean()))
        drift = Estimate(-drift_fit.drift, drift_fit.drift_deviation, quantile * drift_fit.drift_deviation)
    rows, x, _ = select_common_samples(pair, (solution.offset, 0.0))
    if len(rows) * STEP < MIN_COMMON_TIME or not float(np.std(x)) > 0.0:
        return None
    y, correlation = other.values[rows], correlate(x, other.values[rows])
    problem = Regression(other.time[rows], y[:, None], {"scale": x[:, None], "bias": np.ones((len(rows), 1))})
    noise = white_noise(derived) * rate_noise(float(np.median(np.diff(time))), cutoff) if derived_is_angle else 0.0
    scale, bias = _fit_line(problem, x, correlation, fit_bias, noise)

    def fits_worse(offset: float) -> bool:  # significantly (F test, 95 %)
        (smallest, residual), common = _compute_residual_fractions(pair, [solution.offset, offset], cutoff)
        return residual > _compute_f_limit(common, cutoff, 0.95) * smallest

    unshifted_rows, unshifted, _ = select_common_samples(pair, (0.0, 0.0))
    return Agreement(lag, scale, bias, correlation, float(np.std(x)), other.time[rows], y, x,
                     tuple(-alternative.offset for alternative in alternatives), fits_worse(-expected_lag),
                     correlate(unshifted, other.values[unshifted_rows]),
                     all(fits_worse(solution.offset + shift) for shift in (-LAG_TEST_SHIFT, LAG_TEST_SHIFT)), drift)


def _find_best_offsets(pair: Pair, cutoff: float, min_lag: float, max_lag: float) -> list[Fit]:
    """Fits of the best offset and of all offsets that are not significantly worse, the smallest offset first.

        (1 - r^2) / (1 - r_best^2) <= F(0.975; n, n),   n = 2 cutoff T: independent samples of the residual in time T
    """
    lags, correlation = mean_correlation([pair], MIN_COMMON_TIME, (-max_lag, max_lag)) or (np.zeros(0), np.zeros(0))
    if not correlation.max(initial=0.0) > 0.0:
        return [fit([pair], offset=0.0, middle=0.0, free_drift=False)]
    residual = 1.0 - np.maximum(correlation, 0.0) ** 2
    best = int(np.argmin(residual))
    if abs(lags[best]) < min_lag:
        raise ValueError("the lag is below min_lag")
    peaks = 1 + np.flatnonzero((residual[1:-1] < residual[:-2]) & (residual[1:-1] <= residual[2:]))
    known_count = min(float(side.known.sum()) for side in (pair.reference, pair.other))
    fits: list[Fit] = []
    limit = _compute_f_limit(known_count, cutoff) * residual[best] + GRID_ERROR
    correlates = residual[best] <= 1.0 - LIMITS.min_correlation**2 + GRID_ERROR
    peaks = peaks[correlates & (residual[peaks] <= limit)]
    for start in dict.fromkeys((best, *peaks.tolist())):
        solution = fit([pair], float(lags[start]), middle=0.0, free_drift=False)
        if all(abs(solution.offset - other.offset) > STEP for other in fits):
            fits.append(solution)
    if len(fits) == 1:
        return fits
    fractions, common = _compute_residual_fractions(pair, [solution.offset for solution in fits], cutoff)
    limit = _compute_f_limit(common, cutoff) * min(fractions)
    return sorted((solution for solution, fraction in zip(fits, fractions, strict=True) if fraction <= limit),
                  key=lambda solution: abs(solution.offset))


def _compute_f_limit(samples: float, cutoff: float, level: float = 0.975) -> float:
    """Quantile, at probability `level`, of the ratio of two estimates of one variance. samples: number per estimate."""
    degrees_of_freedom = max(2.0 * cutoff * STEP * samples, 1.0)
    return float(fdtri(degrees_of_freedom, degrees_of_freedom, level))


def _compute_residual_fractions(pair: Pair, offsets: Sequence[float], cutoff: float) -> tuple[list[float], int]:
    """(1 - r^2 at each offset, number of samples), from the samples common to all offsets. With different samples the
    comparison would be biased, since a filtered derivative is least accurate at its ends.

    Both series u are whitened, because a wrong lag may fit slow errors such as road slope: u(t) - rho u(t - delay),
    delay = 1 / (2 cutoff), rho: autocorrelation of the smallest residual at this delay."""
    series = [select_common_samples(pair, (offset, 0.0))[:2] for offset in offsets]
    common = np.flatnonzero(np.bincount(np.concatenate([rows for rows, _ in series])) == len(series))
    values, delay = pair.other.values[common], round(0.5 / (cutoff * STEP))
    candidates = [derived[np.isin(rows, common)] for rows, derived in series]
    best = max(candidates, key=lambda derived: abs(correlate(derived, values)))
    terms = np.stack([best, np.ones(len(best))], axis=1)
    residual = values - terms @ np.linalg.lstsq(terms, values, rcond=None)[0]
    rho = max(correlate(residual[delay:], residual[:-delay]), 0.0)
    r = [correlate(*(u[delay:] - rho * u[:-delay] for u in (derived, values))) for derived in candidates]
    return [max(1.0 - correlation**2, MIN_RESIDUAL_FRACTION) for correlation in r], len(common)


def _fit_line(problem: Regression, derived: np.ndarray, correlation: float, fit_bias: bool,
              noise: float) -> tuple[Estimate, Estimate]:
    """(scale, bias). If they are confounded, as in one long bend, only one is estimated: the bias if its residual is
    clearly smaller (BIAS_RESIDUAL_RATIO), else the scale. The other is assumed to be correct.

    noise: standard deviation of the noise of the derived series, which reduces the slope of the regression on it to a
    fraction 1 - noise^2 / variance >= r^2 of the scale (errors in variables: Fuller 1987, 1.2).
    """
    are_confounded = abs(float(derived.mean())) > float(derived.std()) and abs(correlation) < MIN_SCALE_CORRELATION
    if fit_bias and not are_confounded:
        both = problem.estimate(("scale", "bias"))
        fraction = max(1.0 - noise**2 / max(float(np.var(derived)), 1e-300), correlation**2) or 1.0  # r = 0: constant
        scale = both["scale"].scaled(1.0 / fraction)
        return scale, both["bias"].shifted((both["scale"].value - scale.value) * float(derived.mean()))
    scale = problem.estimate(("scale",))["scale"]
    if not fit_bias:
        return scale, NOT_FITTED
    shifted = Regression(problem.time, problem.y - derived[:, None], problem.columns)
    if problem.fit(("scale",))[1] <= BIAS_RESIDUAL_RATIO * shifted.fit(("bias",))[1]:
        return scale, NOT_FITTED
    return UNIT_SCALE, shifted.estimate(("bias",))["bias"]


@dataclass
class Results:
    """Results of comparisons, to which the checks add."""

    findings: list[Finding] = field(default_factory=list)
    estimates: dict[str, Estimate] = field(default_factory=dict)  # by name of the finding
    panels: list[Comparison] = field(default_factory=list)  # of the figure


@dataclass(frozen=True)
class Tolerances:
    """Limits of the errors of a channel relative to a reference."""

    channel: str
    reference: str
    unit: str
    lag: float  # smallest reported lag [s]
    scale: float  # smallest reported deviation of the scale from 1
    bias: float  # smallest reported bias [unit]
    severe_lag: float = 0.0  # smallest lag that identification and discovery do not tolerate [s]
    severe_scale: float = 0.0  # smallest such deviation of the scale from 1
    severe_bias: float = np.inf  # smallest such bias [unit]
    position_effect: float = 0.0  # position shift at the end of the horizon per unit of error [m]
    min_spread: float = 0.0  # smallest standard deviation of the reference for which a lag is reported [unit]
    min_correlation: float = LIMITS.min_correlation  # at a lower correlation, only the lag is checked
    unit_questions: Mapping[float, str] = field(default_factory=dict)  # question about the unit, by factor
    bias_question: str = ""  # question about the cause of a bias


def check_agreement(results: Results, agreement: Agreement | None, tolerances: Tolerances, title: str,
                    removed_scale: float = 1.0, removed_reference_scale: float = 1.0) -> None:
    """Add the result of a comparison. title: of the panel, which shows both series in recorded units. removed_scale,
    removed_reference_scale: factors already divided out of the channel and of the reference."""
    if agreement is None:
        return
    name = tolerances.channel
    results.panels.append(Comparison(
        name, title, tolerances.unit, name, f"from {tolerances.reference}", agreement.time,
        removed_scale * agreement.measured, removed_reference_scale * agreement.derived,
        tuple(f"{name}_{kind}" for kind in ("scale", "bias", "lag"))))
    if not agreement.correlates:
        return
    scale, lag, bias = (add_systematic_uncertainty(f"{name}_{kind}", getattr(agreement, kind))
                        for kind in ("scale", "lag", "bias"))
    if (lag.is_significant and agreement.expected_lag_rejected and abs(lag.value) >= tolerances.lag
            and agreement.spread >= tolerances.min_spread):
        results.findings.append(_make_lag_finding(agreement, lag, tolerances))
    results.estimates |= {f"{name}_lag": lag} if agreement.determines_lag else {}
    if abs(agreement.correlation) < tolerances.min_correlation:  # noise biases the scale and the bias, but not the lag
        return
    results.estimates |= {f"{name}_scale": scale}
    results.estimates |= {f"{name}_bias": bias} if bias.standard_error else {}  # 0: no bias was fitted
    # Regression on a noisy quantity yields between r^2 and 1 times the true slope (Fuller 1987, Measurement Error
    # Models, 1.1), so noise of the derived quantity may explain a scale below 1.
    explained_by_noise = scale.value < 1.0 and scale.value / agreement.correlation**2 + scale.half_width > 1.0
    divisor, scale_error = 1.0, abs(scale.value - 1.0)
    if not explained_by_noise and not is_near(scale.value, 1.0, LIMITS.channel_unit_ratio):
        results.findings.append(_make_unit_finding(scale, tolerances))
        return
    if scale_error >= tolerances.scale and scale.shifted(-1.0).is_significant and not explained_by_noise:
        divisor = scale.value  # the user's correction divides by the reported scale before it subtracts the bias
        text = f"{name} is {scale} times its value from {tolerances.reference}"
        results.findings.append(_make_finding("scale", text, scale, scale_error * agreement.spread, tolerances,
                                              1.0 / divisor, scale_error >= tolerances.severe_scale))
    error = abs(bias.value) / max(abs(scale.value), 1e-300)
    if bias.is_significant and error >= tolerances.bias:
        side, unit = "high" if bias.value > 0.0 else "low", tolerances.unit.replace("^2", "²")
        text = (f"{name} is {abs(bias)} {unit} too {side} compared with {tolerances.reference}"
                f"{tolerances.bias_question}")
        results.findings.append(_make_finding("bias", text, bias, error, tolerances, -bias.value / divisor,
                                              error >= tolerances.severe_bias))


def _make_lag_finding(agreement: Agreement, lag: Estimate, tolerances: Tolerances) -> Finding:
    rate = float(np.std(np.gradient(agreement.derived, agreement.time)))
    text = (f"{tolerances.channel} {'lags' if lag.value > 0.0 else 'leads'} {tolerances.reference} by "
            f"{abs(lag)} s{format_alternative_lags(agreement)}")
    if abs(agreement.correlation) < tolerances.min_correlation:
        text += f"; their correlation is only {abs(agreement.correlation):.2f}, so scale and bias are not checked"
    return _make_finding("lag", text, lag, abs(lag.value) * rate, tolerances, lag.value,
                         abs(lag.value) >= tolerances.severe_lag)


def _make_unit_finding(scale: Estimate, tolerances: Tolerances) -> Finding:
    """Finding about a scale far from 1. If a unit or sign explains it, the correction has the unit's exact factor."""
    nearest = _find_nearest_factor(scale.value, (1.0, *tolerances.unit_questions))
    factor = nearest if is_near(scale.value, nearest, LIMITS.channel_unit_ratio) else scale.value
    opposite = "does it have the opposite sign" if factor < 0.0 else ""
    reason = " and ".join(filter(None, (tolerances.unit_questions.get(abs(factor), ""), opposite)))
    text = (f"{tolerances.channel} is {scale} times its value from {tolerances.reference}"
            + (f": {reason}?" if reason else ""))
    return Finding(f"{tolerances.channel}_scale", Severity.WARNING, (tolerances.channel,), text, scale.value, "1",
                   scale.interval, advice=_make_advice(tolerances.channel, "scale", float(f"{1.0 / factor:.6g}")))


def _make_finding(kind: str, text: str, estimate: Estimate, error: float, tolerances: Tolerances, correction: float,
                  severe: bool) -> Finding:
    """Finding about a lag, scale or bias. error: root mean square error of the channel [unit]."""
    effect = error * tolerances.position_effect
    unit = {"lag": "s", "scale": "1", "bias": tolerances.unit}[kind]
    return Finding(f"{tolerances.channel}_{kind}", LIMITS.severity(effect, severe), (tolerances.channel,), text,
                   estimate.value, unit, estimate.interval, (), effect if tolerances.position_effect else None,
                   _make_advice(tolerances.channel, CORRECTION_KEYS[kind], float(f"{correction:.5g}")))


def _make_advice(channel: str, key: str, value: float) -> Advice:
    if channel in SPEED_LIMITS:  # run.yaml cannot correct these
        return Advice("text", "check its source: unit, wheel radius, clock")
    return Advice.correct(channel, **{key: value})


def format_alternative_lags(agreement: Agreement, response: float = 0.0) -> str:
    """Text about other lags that fit equally well; "" if there are none. response: added to each lag [s]."""
    others = sorted(lag + response for lag in agreement.other_lags)
    text = " or ".join(f"{'lags' if lag > 0.0 else 'leads'} by {abs(lag):.2f} s" for lag in others)
    return f" (or {text}, which fits equally well: the motion is periodic)" if text else ""


def compare_yaw_rate(motion: Motion, cutoff: float = GYRO_CUTOFF) -> Agreement | None:
    """Agreement of yaw rate and change of yaw while the car moves; a yaw from the course is undefined at standstill."""
    yaw = np.where(motion.speed > MIN_MOVING_SPEED, motion.yaw, np.nan)
    return compare_series(motion.time, yaw, motion.time, motion.yaw_rate, cutoff, derived_is_angle=True)


def check_yaw_rate(results: Results, motion: Motion, agreement: Agreement | None,
                   removed_factors: Mapping[str, float]) -> None:
    """Compare yaw rate and change of yaw. removed_factors: already divided out of both, by name of the finding."""
    position_effect = LIMITS.yaw_settling_time * float(np.median(np.abs(motion.velocity_x))) * HORIZON
    tolerances = Tolerances(
        "yaw_rate", "yaw", "rad/s", LIMITS.lag, GYRO_SCALE_ERROR, GYRO_BIAS, LIMITS.severe_lag, severe_scale=0.03,
        severe_bias=0.01, position_effect=position_effect, min_correlation=GYRO_CORRELATION)
    check_agreement(results, agreement, tolerances, "yaw rate: sensor versus change of yaw",
                    removed_factors.get("yaw_rate_scale", 1.0),
                    removed_factors.get("yaw_scale", removed_factors.get("yaw_convention", 1.0)))


def _compare_acceleration(motion: Motion, name: str, measured: np.ndarray) -> Agreement | None:
    return compare_series(motion.time, _derive_acceleration(motion, name), motion.time, measured, ACCELERATION_CUTOFF)


def _derive_acceleration(motion: Motion, name: str) -> np.ndarray:
    derivative = np.gradient(motion.velocity, motion.time) + 1j * motion.yaw_rate * motion.velocity
    return derivative.imag if name == "acceleration_y" else derivative.real


def is_unit_or_sign(scale: float | None) -> bool:
    """Whether a wrong unit or sign explains the scale of an acceleration."""
    return scale is not None and any(is_near(scale, factor, 1.0 + ACCELERATION_SCALE_ERROR) for factor in (
        -1.0, *ACCELERATION_UNITS, *(-unit for unit in ACCELERATION_UNITS)))


def make_level_motions(motion: Motion) -> list[Motion]:
    """The motion with the yaw rate, or also the velocities, turned from the axes of the car into the horizontal plane.

        g sin(grade) = a_x - dv_x/dt + v_y r       v_x cos(grade), v_y cos(bank), r / (cos(grade) cos(bank))
        g sin(bank) = dv_y/dt + v_x r - a_y        [] without these accelerations
    """
    windows = motion.make_windows(1.0)
    if motion.acceleration_x is None or motion.acceleration_y is None or not len(windows):
        return []
    sine = np.nan_to_num(motion.acceleration_x - _derive_acceleration(motion, "acceleration_x")) + 1j * np.nan_to_num(
        motion.acceleration_y - _derive_acceleration(motion, "acceleration_y"))
    sine = np.interp(motion.time, windows.time + 0.5, windows.mean(sine) / STANDARD_GRAVITY)
    grade, bank = (np.sqrt(1.0 - np.minimum(part**2, 0.75)) for part in (sine.real, sine.imag))  # cosines, up to 60 deg
    rate = replace(motion, yaw_rate=motion.yaw_rate / (grade * bank))
    return [rate, replace(rate, velocity_x=grade * motion.velocity_x, velocity_y=bank * motion.velocity_y)]


def _make_unrelated_finding(motion: Motion, name: str, measured: np.ndarray) -> Finding | None:
    """Finding about an acceleration that does not correlate with the derivative of velocity in windows of 1 s; None if
    it does, is constant or too short, or if the motion has little acceleration and the mean is not that of gravity."""
    windows = motion.make_windows(1.0)
    derived, values = (windows.mean(series) for series in (_derive_acceleration(motion, name), measured))
    known = np.isfinite(values)
    correlation, mean = correlate(derived[known], values[known]), float(np.mean(values[known])) if known.any() else 0.0
    is_vertical = is_near(abs(mean), STANDARD_GRAVITY, MAX_GRAVITY_RATIO)
    if abs(correlation) >= LIMITS.min_correlation or known.sum() < MIN_UNRELATED_WINDOWS or not np.ptp(measured) or (
            not is_vertical and np.std(derived[known]) < MIN_ACCELERATION_DEVIATION):
        return None
    text = f"{name} does not follow velocity and yaw rate (correlation {correlation:.2f})" + (
        f" and has a mean of {mean:.1f} m/s², that of gravity: does this axis of the sensor point up or down?"
        if is_vertical else ": is it another axis of the sensor or another signal, or is the road hilly?")
    advice = Advice("text", "check the axes of the sensor, and leave this column out if none of them fits")
    return Finding("acceleration_unrelated", Severity.WARNING, (name,), text, correlation, advice=advice)


def confirm_velocity(motion: Motion, factor: float) -> str | None:
    """Name of a measurement that agrees with the recorded velocity, but not with the velocity divided by `factor`,
    followed by a question about the positions; None if a measurement agrees only with the latter, or if the positions
    are from GNSS or the factor is within the tolerance of the tyre radius; otherwise ""."""
    wheel = compare_speed(motion, "wheel_speed") if "wheel_speed" in motion.speeds else None
    ratios = {"the wheel speed": wheel.scale.value if wheel else np.nan,
              "the scale of web Mercator at this y": factor * motion.mercator_scale}
    scales = [] if motion.moves_sideways else compute_acceleration_scales(motion)

    def accelerations_agree(factor: float) -> bool:  # roll and pitch of the body increase accelerations
        return all(abs(factor * scale.value - 1.0) < ACCELERATION_SCALE_ERROR
                   and factor * scale.interval[1] >= MIN_ACCELERATION_SCALE for scale in scales)

    confirmed_by = next((name for name, ratio in ratios.items() if abs(factor - 1.0) >= max(
        2.0 * abs(ratio - 1.0), WHEEL_SCALE_TOLERANCE)), "the accelerations")
    if confirmed_by not in ratios and (not accelerations_agree(1.0) or accelerations_agree(factor)):
        other_error = max(2.0 * abs(factor * ratios["the wheel speed"] - 1.0), WHEEL_SCALE_TOLERANCE)
        is_velocity = abs(factor - 1.0) >= other_error or (accelerations_agree(factor) and not accelerations_agree(1.0))
        return None if is_velocity or motion.geographic or abs(factor - 1.0) < WHEEL_SCALE_TOLERANCE else ""
    latitude = float(np.rad2deg(np.arccos(np.clip(factor, 0.0, 1.0))))
    return (f"{confirmed_by}: are they in web Mercator, at a latitude of {latitude:.0f} deg?"
            if 0.0 < latitude < MAX_LATITUDE else f"{confirmed_by}: is the scale of the projection wrong?")


def compute_acceleration_scales(motion: Motion) -> list[Estimate]:
    """Ratio of measured acceleration to derivative of velocity, for each axis on which they correlate."""
    agreements = [_compare_acceleration(motion, name, values) for name in ACCELERATIONS
                  if (values := getattr(motion, name)) is not None]
    return [agreement.scale for agreement in agreements if agreement and agreement.correlates]


def _correct_rotated_accelerometer(motion: Motion) -> tuple[Motion, Finding | None]:
    """(motion with accelerations along the axes of the car, finding) if they show that the sensor is rotated by an
    angle to the left, a_measured = k exp(-i angle) a + bias with a = a_x + i a_y; else (motion, None). The angles from
    both axes must agree, and fit better than a slope in bends to one side, as in a helix, which changes only a_x."""
    if motion.acceleration_x is None or motion.acceleration_y is None:
        return motion, None
    windows, recorded = motion.make_windows(1.0), motion.acceleration_x + 1j * motion.acceleration_y
    x, y = (windows.mean(_derive_acceleration(motion, name)) for name in ACCELERATIONS)
    derived, measured = x + 1j * y, windows.mean(recorded)
    known, ones = np.isfinite(measured), np.ones_like(derived)
    columns = {"along": derived, "across": -1j * derived, "bias_x": ones, "bias_y": 1j * ones,
               "x": x, "y": 1j * y, "y_in_x": y, "x_in_y": -1j * x}
    y, *terms = (np.stack((z.real, z.imag), axis=1)[known] for z in (measured, *columns.values()))
    if known.sum() < MIN_UNRELATED_WINDOWS:
        return motion, None
    problem = Regression(windows.time[known], y, dict(zip(columns, terms, strict=True)))
    turned, by_axis = [*columns][:4], [*columns][2:]
    estimates, separate, (_, scale, _) = problem.estimate(turned), problem.estimate(by_axis), problem.fit(turned)
    along, across = estimates["along"].value, estimates["across"]
    gain = problem.compute_loss(by_axis[:-1], scale) - problem.compute_loss(turned, scale)
    if gain < MIN_ANGLE_GAIN or any(
            separate[name].shifted(-across.value).widened(across.half_width).is_significant
            for name in ("y_in_x", "x_in_y")):  # a scale error of one axis acts like an angle if a_x and a_y correlate
        return motion, None
    radians = float(np.arctan2(across.value, along))
    angle = replace(across.scaled(1.0 / max(float(np.hypot(along, across.value)), 1e-12)), value=radians)
    if not is_relevant(angle, MIN_SENSOR_ANGLE) or abs(radians) > MAX_SENSOR_ANGLE:
        return motion, None
    text = (f"the accelerometer is rotated by {abs(angle)} rad ({np.rad2deg(abs(radians)):.0f} deg) to the "
            f"{'left' if radians > 0.0 else 'right'}")
    advice = Advice("text", f"rotate the accelerations by a = {radians:.3f}: forward = cos(a) acceleration_x - "
                    "sin(a) acceleration_y, lateral = sin(a) acceleration_x + cos(a) acceleration_y")
    recorded = recorded * np.exp(1j * radians)
    return replace(motion, acceleration_x=recorded.real, acceleration_y=recorded.imag), Finding(
        "acceleration_axes", Severity.WARNING, ACCELERATIONS, text, radians, "rad", angle.interval, advice=advice)


def _find_exchanged_accelerations(motion: Motion, measured: Mapping[str, np.ndarray]) -> Finding | None:
    """Finding about exchanged accelerations; a sensor rotated by 90 deg exchanges them and reverses the sign of one.
    None if the exchanged channels do not agree with velocity either. measured: by channel."""
    if len(measured) != 2:
        return None
    sources = dict(zip(measured, reversed([*measured]), strict=True))
    factors = {}
    for name, source in sources.items():
        agreement = _compare_acceleration(motion, name, measured[source])
        # In periodic driving, the opposite sign also correlates at a lag of half a period.
        if (agreement is None or not agreement.correlates
                or agreement.correlation_without_lag * agreement.scale.value <= 0.0):
            return None
        factors[name] = _find_nearest_factor(agreement.scale.value, (1.0, *ACCELERATION_UNITS))
    text = "acceleration_x and acceleration_y are exchanged (x should be forward, y left)"
    opposite = [source for name, source in sources.items() if factors[name] < 0.0]
    if opposite:
        text += f", and {' and '.join(opposite)} {'have' if len(opposite) == 2 else 'has'} the opposite sign"
    if len(opposite) == 1:
        text += ": the sensor is rotated by 90 deg"
    questions = {ACCELERATION_UNITS.get(abs(factor)) for factor in factors.values()} - {None}
    text += "".join(f": {question}?" for question in questions)
    correct = {name: {"scale": float(f"{1.0 / factor:.6g}")} for name, factor in factors.items() if factor != 1.0}
    entry = {"columns": sources, **({"correct": correct} if correct else {})}
    return Finding("acceleration_axes", Severity.WARNING, (*measured,), text, advice=Advice.for_run_yaml(entry))


def _find_nearest_factor(scale: float, factors: Iterable[float]) -> float:
    """The factor nearest to the scale in ratio, with the sign of the scale."""
    return float(np.copysign(min(factors, key=lambda factor: abs(np.log(abs(scale) / factor))), scale))


def check_accelerations(results: Results, motion: Motion) -> None:
    """Compare accelerations with the derivative of velocity, unless the velocity has wrong axes."""
    if motion.moves_sideways:
        return
    speed = float(np.median(np.abs(motion.velocity_x)))
    motion, rotated = _correct_rotated_accelerometer(motion)
    results.findings += [rotated] if rotated else []
    measured = {name: values for name in ACCELERATIONS if (values := getattr(motion, name)) is not None}
    agreements = {name: _compare_acceleration(motion, name, values) for name, values in measured.items()}
    if not any(agreement and agreement.correlates for agreement in agreements.values()) and (
            exchanged := _find_exchanged_accelerations(motion, measured)):
        results.findings.append(exchanged)
        return
    for name, agreement in agreements.items():
        if not (agreement and agreement.correlates) and (
                unrelated := _make_unrelated_finding(motion, name, measured[name])):
            results.findings.append(unrelated)
            continue
        axis, reference, lag = "forward", "velocity", ACCELERATION_LAG
        if name == "acceleration_y":
            axis, reference = "lateral", "velocity and yaw rate"
            lag = max(ACCELERATION_LAG, ACCELEROMETER_ARM / max(speed, MIN_MOVING_SPEED))
        checks_scale = agreement is not None and agreement.spread >= MIN_ACCELERATION_DEVIATION
        tolerances = Tolerances(
            name, reference, "m/s^2", lag, ACCELERATION_SCALE_ERROR if checks_scale else np.inf,
            LIMITS.acceleration_bias, severe_bias=SEVERE_ACCELERATION_BIAS, unit_questions=ACCELERATION_UNITS,
            bias_question=": is the sensor mounted at an angle, or is the road not level?")
        check_agreement(results, agreement, tolerances, f"{axis} acceleration: sensor versus velocity")


def check_speeds(results: Results, motion: Motion) -> None:
    """Compare the speeds from other sources with the forward speed of the INS."""
    for name in motion.speeds:
        scale, lag = SPEED_LIMITS[name]
        tolerances = Tolerances(name, "velocity_x", "m/s", lag, scale, np.inf, min_spread=MIN_SPEED_DEVIATION,
                                unit_questions=SPEED_UNITS)
        title = f"forward speed: {name.replace('_', ' ')} versus velocity_x"
        check_agreement(results, compare_speed(motion, name), tolerances, title)


def restore_speed_sign(log: DriveLog, start_ns: int) -> tuple[DriveLog, list[Finding]]:
    """(the drive, findings). If velocity_x opposes the motion of the positions along yaw between some stops, as a speed
    without a sign does in reverse, its sign is changed there and reported. start_ns: zero of the times [ns]."""
    time, position = (log.ins_time_ns - start_ns) * NANOSECOND, log.x + 1j * log.y
    begin, end = (np.clip(time + side, time[0], time[-1]) for side in (-0.5, 0.5))
    velocity = (np.interp(end, time, position) - np.interp(begin, time, position)) / (end - begin)
    slower, faster = np.sort([np.abs(velocity), np.abs(log.velocity_x)], axis=0)  # positions may jump at a stop
    pauses = [(last, first) for (_, last), (first, _) in pairwise(find_spans(slower > MIN_MOVING_SPEED))]
    stops = [i + int(np.argmin(faster[i:k])) for i, k in pauses if faster[i:k].min() <= MIN_MOVING_SPEED]
    product = log.velocity_x * velocity * np.exp(-1j * log.yaw)
    bounds = np.array([0, *stops, len(time)])  # of the parts between stops
    products, sizes = (np.add.reduceat(values, bounds[:-1]) for values in (product.real, np.abs(product)))
    if not products.min() < 0.0 < products.sum() or (np.abs(products) < MIN_COHERENCE * sizes).any():
        return log, []
    sign = np.repeat(np.where(products < 0.0, -1.0, 1.0), np.diff(bounds))
    times = tuple((float(time[first]), float(time[last])) for first, last in find_spans(sign < 0.0))
    text = (f"velocity_x has the opposite sign for {sum(last - first for first, last in times):.0f} s (forward is "
            "positive): is it a speed without a sign, recorded in reverse?")
    advice = Advice.for_run_yaml({"leave_out": [[round(first, 1), round(last, 1)] for first, last in times]})
    finding = Finding("velocity_x_scale", Severity.ERROR, ("velocity_x",), text, times=times, advice=advice)
    return replace(log, velocity_x=sign * log.velocity_x), [finding]


def check_position_clock(motion: Motion) -> list[Finding]:
    """Finding about positions stamped by a different clock, which agree with velocity and yaw only at a large lag."""
    speed = np.abs(np.gradient(motion.position, motion.time))
    agreement = compare_series(motion.time, motion.speed, motion.time, speed, SPEED_CUTOFF, min_lag=MAX_LAG,
                               max_lag=MAX_CLOCK_OFFSET, max_fitted_lag=MAX_CLOCK_OFFSET)
    if (agreement is None or not (agreement.has_lag and agreement.determines_lag)
            or abs(agreement.lag.value) <= MAX_LAG or agreement.correlation < MIN_SCALE_CORRELATION):
        return []
    lag = agreement.lag
    moving = speed > MIN_MOVING_SPEED
    course = np.exp(1j * np.angle(np.gradient(motion.position, motion.time)[moving]))
    yaw = [np.interp(motion.time[moving] - shift, motion.time, motion.yaw) for shift in (0.0, lag.value)]
    loss, loss_with_lag = (float(np.square(np.abs(course - np.exp(1j * values))).mean()) for values in yaw)
    # The velocity may be late instead, or the drive is straight. Without moving positions, the losses are NaN.
    if not loss > MIN_LOSS_RATIO * loss_with_lag:
        return []
    is_gps_time = abs(abs(lag.value) - LEAP_SECONDS[-1]) < 1.0
    gps = f", such as GPS time, which is {LEAP_SECONDS[-1]} s ahead of UTC" if is_gps_time else ""
    text = (f"positions {'lag' if lag.value > 0.0 else 'lead'} velocity and yaw by {abs(lag)} s: are they stamped by "
            f"another clock{gps}?")
    return [Finding("position_lag", Severity.ERROR, ("x", "y"), text, lag.value, "s", lag.interval,
                    advice=Advice.correct("position", earlier=float(f"{lag.value:.5g}")))]


def compare_speed(motion: Motion, name: str) -> Agreement | None:
    """Agreement of a speed from `motion.speeds` with the forward speed of the INS."""
    return compare_series(motion.time, motion.velocity_x, *motion.speeds[name], SPEED_CUTOFF, fit_bias=False)
