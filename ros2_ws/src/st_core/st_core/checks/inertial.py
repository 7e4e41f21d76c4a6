"""Channels that are derivatives of others, whatever the car.

    r = d(yaw)/dt        a_x = dv_x/dt - v_y r        a_y = dv_y/dt + v_x r

An accelerometer feels gravity as well: a slope is a bias of a_x, a banked road or a mounting angle one of a_y. It may
sit a metre or two from the point of the velocities; at speed v that looks like a lag of distance / v in a_y.
"""

import numpy as np

from .channel import Expected, identity, judged
from .finding import Advice, AuxiliaryData, Finding, Identity, Series, Severity
from .lag import Agreement, agreement
from .limits import HORIZON, LIMITS, WHEEL_SCALE
from .motion import MOVING, Motion, sideways
from .regression import Estimate

G = 9.80665
GYRO_CUTOFF, ACCELERATION_CUTOFF, SPEED_CUTOFF = 4.0, 1.5, 1.5  # Hz
GYRO_CORRELATION = 0.9  # two outputs of one unit; less is a yaw too coarse to be differentiated
GYRO_SCALE = 0.02  # 1; a gyroscope's scale is known to 1 %
GYRO_BIAS = 0.001  # rad/s; an INS that is in order shows half of it
ACCELERATION_SCALE = 0.35  # 1; a body that rolls and pitches makes up to a third of it
ACCELERATION_LAG = 0.12  # s; filters of accelerometers take up to 0.1 s
LEVER = 1.5  # m between accelerometer and INS point
GRAVE_ACCELERATION = 0.3  # m/s^2; a road's crossfall of 2.5 % is 0.25
SPEED_SPREAD = 0.5  # m/s; at one speed only slip and noise would be compared
WHEEL_LAG = 0.15  # s; wheel speeds are averaged over some turns
FACTORS = {1.0 / G: "g"}
LEANS = ": mounted askew, or the road is not level?"
SPEED_FACTORS = {3.6: "km/h", 2.23694: "mph", 1.0 / 3.6: "divided by 3.6 twice"}

Judged = tuple[list[Finding], dict[str, Estimate], Identity | None]


def yaw_rate(motion: Motion, seed: int) -> tuple[Agreement | None, Expected]:
    """Against the change of yaw. A model forgets a wrong start of its yaw rate within the settling time."""
    reach = LIMITS.settling * float(np.median(np.abs(motion.velocity_x))) * HORIZON
    found = agreement(motion.time, motion.yaw, motion.time, motion.yaw_rate, GYRO_CUTOFF, seed, True)
    return found, Expected("yaw_rate", "yaw", "rad/s", LIMITS.lag, GYRO_SCALE, GYRO_BIAS,
                           (LIMITS.grave_lag, 0.03, 0.01), reach, correlation=GYRO_CORRELATION)


def turn_lag(motion: Motion, seed: int) -> float:
    """By how much the yaw rate lags yaw [s], where that hides how they agree; 0 where they agree without it."""
    found = agreement(motion.time, motion.yaw, motion.time, motion.yaw_rate, ACCELERATION_CUTOFF, seed, True)
    if found is None or not (found.late and found.lag.significant) or abs(found.lag.value) < LIMITS.grave_lag:
        return 0.0
    # A yaw rate of the other sign fits half a period later, too.
    now = abs(found.correlation_now)
    return found.lag.value if found.correlation >= LIMITS.correlation and now < found.correlation - 0.05 else 0.0


def corrected_yaw_rate(motion: Motion, found: Agreement) -> Motion:
    """With the lag, scale and bias taken out, where they are known."""
    if found.correlation < LIMITS.correlation:
        return motion
    late = found.lag.value if found.lag.significant and found.late else 0.0
    known = found.correlation >= GYRO_CORRELATION
    rate = (motion.yaw_rate - found.bias.value) / found.scale.value if known else motion.yaw_rate
    return motion.with_(yaw_rate=np.interp(motion.time + late, motion.time, rate))


def accelerations(motion: Motion, seed: int) -> list[Judged]:
    """Findings of both accelerations against the derivative of velocity; none where its axes are wrong."""
    if sideways(motion):
        return []
    derivative = {"acceleration_x": _slope(motion.time, motion.velocity_x) - motion.velocity_y * motion.yaw_rate,
                  "acceleration_y": _slope(motion.time, motion.velocity_y) + motion.velocity_x * motion.yaw_rate}
    speed = float(np.median(np.abs(motion.velocity_x)))
    lags = {"acceleration_x": ACCELERATION_LAG,
            "acceleration_y": max(ACCELERATION_LAG, LEVER / max(speed, MOVING))}
    channels = {name: values for name in derivative if (values := getattr(motion, name)) is not None}

    def against(name: str, values: np.ndarray) -> Agreement | None:
        return agreement(motion.time, derivative[name], motion.time, values, ACCELERATION_CUTOFF, seed)
    agreements = {name: against(name, values) for name, values in channels.items()}
    crossed = zip(channels, reversed(channels.values()), strict=True)
    if len(channels) == 2 and not any(map(_correlates, agreements.values())) and all(
            _correlates(against(name, values)) for name, values in crossed):
        text = "acceleration_x and acceleration_y are exchanged (x is forward, y left)"
        return [([Finding("acceleration_axes", Severity.WARNING, (*channels,), text, advice=Advice(
            "run.yaml", "columns: {acceleration_x: acceleration_y, acceleration_y: acceleration_x}",
            {"columns": dict(zip(channels, reversed(channels), strict=True))}))], {}, None)]
    findings = []
    for name, found in agreements.items():
        expected = Expected(name, "velocity and yaw rate" if name[-1] == "y" else "velocity", "m/s^2", lags[name],
                            ACCELERATION_SCALE, LIMITS.bias_acceleration, (0.0, 0.0, GRAVE_ACCELERATION),
                            factors=FACTORS, why=LEANS)
        title = f"{'lateral' if name[-1] == 'y' else 'forward'} acceleration: sensor against velocity"
        findings.append((*judged(found, expected), identity(found, expected, title)))
    return findings


def _correlates(found: Agreement | None) -> bool:
    return found is not None and abs(found.correlation) >= LIMITS.correlation


def speeds(motion: Motion, auxiliary: AuxiliaryData, start_ns: int, time_factor: float, seed: int) -> list[Judged]:
    """Other sources of the speed against the INS's forward speed. time_factor: by which all stamps run too fast."""
    findings = []
    for name, series, scale, lag in (("wheel_speed", auxiliary.wheel_speed, WHEEL_SCALE, WHEEL_LAG),
                                     ("ins_speed", auxiliary.ins_speed, 0.005, 0.03)):
        if series is None or len(series.time_ns) < 2:
            continue
        found = speed(motion, series, start_ns, time_factor, seed)
        expected = Expected(name, "velocity_x", "m/s", lag, scale, np.inf, (0.0, 0.0, np.inf),
                            least_spread=SPEED_SPREAD, factors=SPEED_FACTORS)
        title = f"forward speed: {name.replace('_', ' ')} against velocity_x"
        findings.append((*judged(found, expected), identity(found, expected, title)))
    return findings


def speed(motion: Motion, series: Series, start_ns: int, time_factor: float, seed: int) -> Agreement | None:
    """Another source of the speed against the INS's forward speed."""
    time = (series.time_ns - start_ns) * 1e-9 / time_factor
    return agreement(motion.time, motion.velocity_x, time, series.values, SPEED_CUTOFF, seed, biased=False)


def _slope(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.gradient(values, time) if len(time) > 1 else np.zeros_like(values)
