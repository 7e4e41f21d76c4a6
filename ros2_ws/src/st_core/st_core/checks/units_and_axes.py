"""Units, signs and axes: factors too large for a calibration error.

Yaw change has three estimates (yaw, integrated yaw rate, course over ground), distance two (change of position,
integrated velocity); the outlier of three is wrong:

    yaw / course = f, yaw / rate = f, rate / course = 1      -> yaw is f times too large
    position / velocity = 1 / f, yaw / rate = 1 / f          -> the stamps run f times too fast
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from .finding import LIMITS, Advice, Finding, Severity
from .motion import ALIKE, LEAST_WAY, LEAST_WINDOWS, Motion, Windows, integral, near, ratios, sideways, windows
from .regression import Estimate

LEAST_FOLLOWED, FOLLOWS = 0.2, 0.02  # rad of turning; largest misfit of positions, share of the distance
ALONG = 0.1  # of the way, and of what yaw leaves: velocities that miss positions by less are those of the map
GYRO = 0.005  # 1; scale error of a gyroscope or a projection that is in order
LEAST_RATE = 0.005  # of the time; crystals are wrong by 0.0001, nominal rates by a whole sample
CLEARLY = 0.8  # factor of the misfit
TIE = 0.97  # factor of the misfit; closer, velocity_y is too small to show its unit, and has that of velocity_x
DEGREE, GON = 180.0 / np.pi, 200.0 / np.pi
ANGLES = {DEGREE: "degrees", GON: "gon", 1000.0: "mrad"}
SPEEDS = {3.6: "km/h", 2.23694: "mph", 1.94384: "knots"}
LENGTHS = {1000.0: "millimetres", 100.0: "centimetres", 3.28084: "feet", 0.001: "kilometres"}
FARTHEST = 1e-4  # below it positions are angles: a degree of the earth is 111 km
TIMES = {1e3: ("milliseconds", "ms"), 1e6: ("microseconds", "us"), 1e9: ("nanoseconds", "ns")}
SMALLEST_WRAP = 0.01  # rad; 360 degrees are 1.86 degrees more than a whole number of 2 pi


def unit_of(factor: float, table: Mapping[float, Any]) -> float | None:
    """The factor of a table of units that this one is, to 6 %."""
    return next((known for known in table if near(factor, known, 1.06)), None)


def correct_units(motion: Motion) -> tuple[Motion, list[Finding]]:
    """(motion with units, signs and axes corrected, what was corrected). Its stamps are in seconds: see time_unit."""
    found: list[Finding] = []
    for step in (_both_turns, _north_east, _turns, _axes, _way, _velocity_axes, _turned):
        motion, finding = step(motion)
        found += [finding] if finding else []
    return motion, _one_yaw(found)


def _one_yaw(found: list[Finding]) -> list[Finding]:
    """A yaw that counts clockwise, and not from north, is one finding: each correction alone leaves an error."""
    findings = {one.name: one for one in found}
    if not {"yaw_convention", "yaw_offset"} <= findings.keys():
        return found
    clockwise, offset = findings["yaw_convention"], findings.pop("yaw_offset")
    assert clockwise.advice and offset.advice  # both are made with one
    correct = dict(clockwise.advice.entry["correct"]["yaw"])
    correct["add"] += offset.advice.entry["correct"]["yaw"]["add"]
    text = f"{clockwise.text.partition(':')[0]}, and not from north: yaw is from east, counter-clockwise"
    advice = Advice.correct("yaw", **correct)
    return [replace(clockwise, text=text, advice=advice) if one is clockwise else one for one in findings.values()]


def _error(name: str, channels: tuple[str, ...], text: str, value: float | None, advice: Advice) -> Finding:
    return Finding(name, Severity.ERROR, channels, text, value, "1", None, (), None, advice)


def time_unit(motion: Motion) -> tuple[Motion, Finding | None]:
    """Stamps against positions and yaw: milliseconds taken for seconds."""
    if len(motion.time) < 20:
        return motion, None
    spacing = float(np.median(np.diff(motion.time)))
    found = ratios(motion, max(1.0, 50 * spacing) if spacing > 0.2 else 1.0) if spacing > 2e-4 else ratios(
        motion, 50 * spacing)
    both = [r for r in (found.way, found.yaw_rate) if np.isfinite(r)]
    if not both or not all(r > 0 and not 1 / LIMITS.unit < r < LIMITS.unit and near(r, both[0]) for r in both):
        return motion, None
    factor = 1.0 / found.way
    unit = unit_of(factor, TIMES)
    # One ratio alone may also be the unit of velocity; then only a unit of time is accepted.
    if not unit and (len(both) < 2 or 1 / 10 < factor < 10):
        return motion, None
    words, advice = "", Advice("look", "look at the clock that stamps the rows")
    if unit:
        factor, (name, symbol) = unit, TIMES[unit]
        words, advice = f": {name}?", Advice("run.yaml", f"units: {{t: {symbol}}}", {"units": {"t": symbol}})
    text = f"time runs {factor:g} times too fast for positions and yaw{words}"
    return motion.slower(factor), _error("time_unit", ("time",), text, factor, advice)


def nominal_rate(findings: list[Finding], estimates: Mapping[str, Estimate]) -> Finding | None:
    """One finding for stamps at a wrong nominal rate: they make velocity and yaw rate too large by one factor, compared
    with positions and yaw, which is that of the time. None where the two factors differ or one is 1."""
    velocity, turn = (estimates.get(name) for name in ("velocity_scale", "yaw_rate_scale"))
    wrong = next((one for one in findings if one.name in ("velocity_scale", "position_scale")), None)
    if velocity is None or turn is None or wrong is None or turn.shifted(-1.0).covers(0.0):
        return None
    apart = abs(velocity.value - turn.value)
    if apart > float(np.hypot(np.hypot(velocity.half, turn.half), GYRO)) or abs(velocity.value - 1.0) < LEAST_RATE:
        return None
    factor = velocity.value
    text = (f"time runs {factor:.4f} ± {velocity.half:.4f} times too fast for positions and yaw: are the rows stamped "
            "at a nominal rate that is not the true one?")
    scale = float(f"{1.0 / factor:.5g}")
    advice = Advice("run.yaml", f"correct: {{velocity: {{scale: {scale:g}}}, yaw_rate: {{scale: {scale:g}}}}}"
                f"  # or divide the time of the rows by {factor:.4f}",
                {"correct": {"velocity": {"scale": scale}, "yaw_rate": {"scale": scale}}})
    return replace(wrong, name="time_rate", channels=("time",), text=text, value=factor, interval=velocity.interval,
                   advice=advice)


def yaw_is_late(motion: Motion, earlier: Motion) -> bool:
    """Whether positions follow velocity and yaw clearly better with `earlier`, the drive with another time of yaw."""
    return _misfit(earlier) < CLEARLY * _misfit(motion)


def _both_turns(motion: Motion) -> tuple[Motion, Finding | None]:
    """Yaw, of either sense, and yaw rate in one unit, which the course decides. Here the rate is corrected, then yaw.
    """
    r = ratios(motion)
    # A course over one short bend is wrong by ten per cent; yaw and yaw rate decide together.
    size = _angle(r.rate_course, ALIKE)
    if size in ANGLES and near(abs(r.yaw_rate), 1.0, LIMITS.unit) and near(abs(r.yaw_course), size, LIMITS.unit):
        return _yaw_rate(motion, r.rate_course, "the course of the positions", size)
    return motion, None


def _turns(motion: Motion) -> tuple[Motion, Finding | None]:
    """Yaw and yaw rate, each against the other two."""
    r = ratios(motion)
    if not np.isfinite(r.yaw_rate) or 1 / LIMITS.unit < r.yaw_rate < LIMITS.unit:
        return motion, None
    if near(r.yaw_course, 1.0, LIMITS.unit) or _follows(motion) or near(1.0 / r.yaw_rate, DEGREE) or near(
            r.rate_course, 1.0 / r.yaw_rate, LIMITS.unit):
        return _yaw_rate(motion, 1.0 / r.yaw_rate)
    if near(r.rate_course, -1.0, LIMITS.unit) and not near(r.yaw_course, -1.0, LIMITS.unit) and near(
            r.yaw_rate, -1.0, LIMITS.unit):
        return _yaw_rate(motion, -1.0)
    return _yaw(motion, r.yaw_rate)


def _north_east(motion: Motion) -> tuple[Motion, Finding | None]:
    """Yaw and positions of the other sense than the yaw rate: north and east, if the other channels side with the rate.
    """
    r = ratios(motion)
    if not (near(r.yaw_rate, -1.0, LIMITS.unit) and near(r.yaw_course, 1.0, LIMITS.unit)):
        return motion, None
    turn = motion.yaw_rate * motion.velocity_x
    sides = [_sense(motion.steering_at_ins() * motion.velocity_x, turn)]
    if motion.acceleration_y is not None:
        sides.append(_sense(motion.acceleration_y, turn))
    kept, mirrored = _misfit(motion), _misfit(motion.with_(velocity_y=-motion.velocity_y))
    sides.append(1 if mirrored < CLEARLY * kept else -1 if kept < CLEARLY * mirrored else 0)
    if sum(sides) <= 0:
        return motion, None
    text = ("x, y and yaw turn the other way than yaw rate and steering: x north, y east, and yaw a compass heading? "
            "x is east, y north, and yaw from east, counter-clockwise")
    entry = {"columns": {"x": "y", "y": "x"}, "correct": {"yaw": {"scale": -1.0, "add": np.pi / 2}}}
    line = f"columns: {{x: y, y: x}}  # and correct: {{yaw: {{scale: -1, add: {np.pi / 2:g}}}}}"
    return motion.with_(x=motion.y, y=motion.x, yaw=np.pi / 2 - motion.yaw), _error(
        "position_axes", ("x", "y", "yaw"), text, None, Advice("run.yaml", line, entry))


def _sense(values: np.ndarray, turn: np.ndarray) -> int:
    """1 where values and turn clearly have one sign, -1 where the opposite one, else 0."""
    known = np.isfinite(values)
    if known.sum() < 50 or not np.std(values[known]) * np.std(turn[known]) > 0.0:
        return 0
    correlation = float(np.corrcoef(values[known], turn[known])[0, 1])
    return int(np.sign(correlation)) if abs(correlation) >= LIMITS.correlation else 0


def _follows(motion: Motion) -> bool:
    """Whether positions follow yaw and velocity, except for a constant rotation and a unit."""
    over = windows(motion.time, 1.0)
    way = np.hypot(over.change(motion.x), over.change(motion.y))
    run = over.change(integral(motion.time, motion.speed))
    if len(over) < LEAST_WINDOWS or not np.ptp(motion.yaw) > LEAST_FOLLOWED:
        return False
    factor = float(np.sum(way) / max(np.sum(run), 1e-12))
    scaled = motion.with_(velocity_x=factor * motion.velocity_x, velocity_y=factor * motion.velocity_y)
    return _misfit(scaled) < FOLLOWS * float(np.median(way))


def _yaw_rate(motion: Motion, factor: float, against: str = "yaw", size: float = 0.0) -> tuple[Motion, Finding]:
    size = size or _angle(factor)
    exact = float(np.copysign(size, factor))
    reason = (f": {ANGLES[size].replace('degrees', 'deg')}/s?" if size in ANGLES else
              ": it counts the other way (left is positive)" if exact == -1.0 else "")
    text = f"yaw_rate is {factor:.3g} times the rate of change of {against}{reason}"
    return (motion.with_(yaw_rate=motion.yaw_rate / exact),
            _error("yaw_rate_scale", ("yaw_rate",), text, factor, Advice.correct("yaw_rate", scale=1.0 / exact)))


def _yaw(motion: Motion, factor: float) -> tuple[Motion, Finding]:
    size = _angle(factor)
    if factor > 0.0:
        text = (f"yaw is {factor:.3g} times the angle from yaw rate and course"
                + (f": {ANGLES[size]}?" if size in ANGLES else ""))
        corrected = motion.with_(yaw=_without_wraps(motion, motion.yaw / size))
        return corrected, _error("yaw_scale", ("yaw",), text, factor, Advice.correct("yaw", scale=1.0 / size))
    unit = f" in {ANGLES[size]}" if size in ANGLES else ""
    text = f"yaw counts clockwise{unit}: a compass heading from north? Yaw is from east, counter-clockwise"
    scale = -1.0 / size
    corrected = motion.with_(yaw=_without_wraps(motion, scale * motion.yaw + np.pi / 2))
    advice = Advice.correct("yaw", scale=scale, add=np.pi / 2)
    return corrected, _error("yaw_convention", ("yaw",), text, factor, advice)


def _angle(factor: float, within: float = 1.06) -> float:
    """The unit of angles, or 1, that a factor is in size; its own size where it is none."""
    return min((one for one in (*ANGLES, 1.0) if near(abs(factor), one, within)),
               key=lambda one: abs(np.log(abs(factor) / one)), default=abs(factor))


def _without_wraps(motion: Motion, yaw: np.ndarray) -> np.ndarray:
    """A yaw that was unwrapped as if it were in rad still steps where it was wrapped: such steps are left out."""
    step = np.diff(yaw)
    meant = 0.5 * (motion.yaw_rate[1:] + motion.yaw_rate[:-1]) * np.diff(motion.time)
    away = np.abs(step - meant)
    wrapped = away > max(8.0 * 1.4826 * float(np.median(away)), SMALLEST_WRAP)
    return np.concatenate((yaw[:1], yaw[0] + np.cumsum(np.where(wrapped, meant, step))))


def _axes(motion: Motion) -> tuple[Motion, Finding | None]:
    """Positions mirrored against yaw and yaw rate, which agree."""
    r = ratios(motion)
    if not (near(r.yaw_course, -1.0, LIMITS.unit) and near(r.yaw_rate, 1.0, LIMITS.unit)):
        return motion, None
    _, measured, derived = _ways(motion, *motion.velocity_map)
    angle = np.angle(np.sum(measured * derived))
    quarter = int(np.round(angle / (np.pi / 2))) % 4
    axes: dict[int, tuple[str, np.ndarray, np.ndarray, dict[str, Any]]] = {
        0: ("y is mirrored (it should count north)", motion.x, -motion.y, {"correct": {"y": {"scale": -1.0}}}),
        1: ("x and y are exchanged (x is east, y north)", motion.y, motion.x, {"columns": {"x": "y", "y": "x"}}),
        2: ("x is mirrored (it should count east)", -motion.x, motion.y, {"correct": {"x": {"scale": -1.0}}}),
        3: ("x and y are exchanged and mirrored", -motion.y, -motion.x,
            {"columns": {"x": "y", "y": "x"}, "correct": {"x": {"scale": -1.0}, "y": {"scale": -1.0}}}),
    }
    text, x, y, entry = axes[quarter]
    key = "  # and ".join(f"{name}: {value}" for name, value in entry.items()).replace("'", "")
    finding = _error("position_axes", ("x", "y"), f"positions turn the other way than the car: {text}", None,
                     Advice("run.yaml", key, entry))
    return motion.with_(x=x, y=y), finding


def _way(motion: Motion) -> tuple[Motion, Finding | None]:
    """Positions against velocities: units."""
    r = ratios(motion)
    if not np.isfinite(r.way) or 1 / LIMITS.unit < r.way < LIMITS.unit:
        return motion, None
    speed, length = unit_of(1.0 / r.way, SPEEDS), unit_of(r.way, LENGTHS)
    if length and not speed:
        text = f"x and y are {r.way:.4g} times the integrated velocity: {LENGTHS[length]}?"
        finding = _error("position_scale", ("x", "y"), text, r.way, Advice.correct("position", scale=1.0 / length))
        return motion.with_(x=motion.x / length, y=motion.y / length), finding
    if not speed and r.way < FARTHEST:
        text = f"x and y are {r.way:.3g} times the integrated velocity: latitude and longitude? Metres are expected"
        advice = Advice("look", "project latitude and longitude to east and north")
        return motion.with_(x=motion.x / r.way, y=motion.y / r.way), _error(
            "position_scale", ("x", "y"), text, r.way, advice)
    factor = speed or 1.0 / r.way
    unit = f": {SPEEDS[speed]}?" if speed else ""
    both = motion.with_(velocity_x=motion.velocity_x / factor, velocity_y=motion.velocity_y / factor)
    forward = motion.with_(velocity_x=motion.velocity_x / factor)
    alone = _misfit(forward) < TIE * _misfit(both)
    name, channel = ("velocity_x_scale", "velocity_x") if alone else ("velocity_scale", "velocity")
    channels = ("velocity_x",) if alone else ("velocity_x", "velocity_y")
    text = (f"{' and '.join(channels)} {'is' if alone else 'are'} {1.0 / r.way:.3g} times the rate of change of "
            f"positions{unit}")
    return (forward if alone else both), _error(name, channels, text, 1.0 / r.way,
                                                Advice.correct(channel, scale=1.0 / factor))


def _ways(motion: Motion, east: np.ndarray, north: np.ndarray) -> tuple[Windows, np.ndarray, np.ndarray]:
    """(windows of a second, change of position, integrated velocity): east + i north [m]."""
    over = windows(motion.time, 1.0)
    return (over, over.change(motion.x) + 1j * over.change(motion.y),
            over.change(integral(motion.time, east)) + 1j * over.change(integral(motion.time, north)))


def _misfit(motion: Motion) -> float:
    """Median distance [m] between change of position and integrated velocity over a second, best turn removed."""
    over, measured, derived = _ways(motion, *motion.velocity_map)
    turn = np.sum(measured * np.conj(derived))
    return float(np.median(np.abs(measured - derived * turn / max(abs(turn), 1e-300)))) if len(over) else 0.0


def _velocity_axes(motion: Motion) -> tuple[Motion, Finding | None]:
    """Velocities in the map frame, which positions follow without rotation by yaw, or exchanged."""
    over, measured, of_map = _ways(motion, motion.velocity_x, motion.velocity_y)
    if len(over) < LEAST_WINDOWS:
        return motion, None
    way, unchanged = float(np.median(np.abs(measured))), _misfit(motion)
    swapped = motion.with_(velocity_x=motion.velocity_y, velocity_y=motion.velocity_x)
    most = ALONG * way  # of velocities in the right frame
    misfit = float(np.median(np.abs(measured - of_map)))
    if np.ptp(motion.yaw) > LEAST_FOLLOWED and misfit <= most and misfit < ALONG * unchanged:
        body = (motion.velocity_x + 1j * motion.velocity_y) * np.exp(-1j * motion.yaw)
        text = "velocity_x and velocity_y are in the map frame, east and north: the body frame is expected"
        advice = Advice("look", "rotate them by yaw: velocity_x = cos(yaw) east + sin(yaw) north, "
                        "velocity_y = cos(yaw) north - sin(yaw) east")
        motion = motion.with_(velocity_x=body.real, velocity_y=body.imag)
    elif way > 0.0 and sideways(motion) and float(
            np.median(np.abs(measured - _ways(swapped, *swapped.velocity_map)[2]))) <= most:
        text = "velocity_x and velocity_y are exchanged (x is forward, y left)"
        columns = {"velocity_x": "velocity_y", "velocity_y": "velocity_x"}
        advice = Advice("run.yaml", f"columns: {columns}".replace("'", ""), {"columns": columns})
        motion = swapped
    else:
        return motion, None
    return motion, _error("velocity_axes", ("velocity_x", "velocity_y"), text, None, advice)


def _turned(motion: Motion) -> tuple[Motion, Finding | None]:
    """Yaw against the direction of travel: north for east, or reversed."""
    over, measured, derived = _ways(motion, *motion.velocity_map)
    total, size = np.sum(derived * np.conj(measured)), float(np.abs(measured * derived).sum())
    if len(over) < LEAST_WINDOWS or size < LEAST_WAY or abs(total) < 0.5 * size or abs(np.angle(total)) < 0.35:
        return motion, None
    angle = float(np.angle(total))
    quarter = np.round(angle / (np.pi / 2)) * np.pi / 2
    if abs(quarter) == np.pi and np.median(motion.velocity_x) < 0.0:  # a whole drive in reverse is rarer than a sign
        return motion.with_(velocity_x=-motion.velocity_x), _error(
            "velocity_x_scale", ("velocity_x",), "velocity_x counts the other way (forward is positive)", -1.0,
            Advice.correct("velocity_x", scale=-1.0))
    exact = quarter if abs(angle - quarter) < 0.1 else angle
    turns: dict[float, str] = {
        1.0: ": is it counted from north?", -1.0: ": is it counted from north or south?",
        2.0: ": does it point backwards?", -2.0: ": does it point backwards?"}
    words = turns.get(round(exact / (np.pi / 2), 3), "")
    text = f"yaw is {angle:+.2f} rad ({angle * DEGREE:+.0f} deg) off the direction in which positions move{words}"
    finding = replace(_error("yaw_offset", ("yaw",), text, angle, Advice.correct("yaw", add=-float(exact))), unit="rad")
    return motion.with_(yaw=motion.yaw - exact), finding
