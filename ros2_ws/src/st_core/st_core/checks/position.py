"""Positions against velocity and yaw: an identity that holds for any vehicle parameters.

    p(t2) - p(t1) = integral of R(yaw) v dt

over windows of a second. Its residual is explained by at most a few causes, each linear in its size:

    x or y scale s        p = s p_true                           s - 1 times the derived way along that axis
    map shear h           x = x_true + h y_true                  h times the way north, in x
    yaw offset a          yaw = yaw_true + a                     -a times the way, turned to the left
    position lag T        p(t) = p_true(t - T)                   -T (V2 - V1),  V = R(yaw) v
    velocity lag T        v(t) = v_true(t - T), body axes        +T integral of R(yaw) dv/dt dt
    reference a           p is of a point a ahead                (R(yaw2) - R(yaw1)) (a, 0)
    velocity bias b       v = v_true + b, one body axis          -integral of R(yaw) b dt
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .finding import HORIZON, LIMITS, WHEEL_SCALE, Advice, Finding, Identity, Severity
from .motion import Motion, integral, several_speeds, windows
from .regression import Estimate, Regression, matters, with_systematic

WINDOW = 1.0  # s
LEAST = 10  # windows
ROUNDS = 3
MOST, NEARLY_ALL = 0.5, 0.25  # largest residual share of the lag of positions; a yaw that leads is rare
CLEARLY = 1.1  # ratio of losses from which the scale of one axis is preferred to that of the velocity
LEAST_GAIN = 0.01  # m; least reduction of the misfit over a second by another sign: RTK noise is 1 cm
LEAST_ACROSS = 0.02  # m/s root mean square of velocity_y
SPHERE = 0.005  # a map projected with one radius of the earth is wrong by up to half a per cent per axis
LEAST_BIAS = 0.05  # m/s; velocities of an INS are known to 0.03
AXES = {"x_scale", "y_scale"}
# Causes that look alike on a drive at one speed, of which one is fitted; a bias only where it explains clearly more.
BIASES = {"velocity_x_bias": {*AXES, "velocity_scale"}, "velocity_y_bias": {"yaw_offset"}}
TWINS = {"velocity_scale": {*AXES, "velocity_x_bias"}, "yaw_offset": {"velocity_y_bias"}, **BIASES,
         **{axis: {"velocity_scale", "velocity_x_bias"} for axis in AXES}}
TEXT = {
    "x_scale": "x is {value:.4f} ± {half:.4f} times the integrated velocity: scaled by the cosine of another latitude?",
    "y_scale": "y is {value:.4f} ± {half:.4f} times the integrated velocity: another earth radius or scale?",
    "sphere": "{axis} is {value:.4f} ± {half:.4f} times the integrated velocity: projected on a spherical earth?",
    "map_shear": "x {grows} by {size:.4f} ± {half:.4f} m for each metre north: projected far from its origin?",
    "velocity_scale": "velocity is {value:.4f} ± {half:.4f} times the rate of change of positions",
    "yaw_offset": "yaw is {size:.4f} ± {half:.4f} rad ({degrees:.2f} deg) too far {side} for positions and velocities",
    "position_lag": "positions {lag} velocity and yaw by {size:.3f} ± {half:.3f} s",
    "velocity_lag": "velocities {lag} positions and yaw by {size:.3f} ± {half:.3f} s",
    "position_reference": "positions are of a point {size:.2f} ± {half:.2f} m {ahead} the one velocities are of",
    "velocity_x_bias": "velocity_x is {size:.2f} ± {half:.2f} m/s too {high} for positions, at every speed",
    "velocity_y_bias": "velocity_y is {size:.2f} ± {half:.2f} m/s too {high} for positions and yaw, at every speed",
}
UNIT = {"yaw_offset": "rad", "position_lag": "s", "velocity_lag": "s", "position_reference": "m",
        **dict.fromkeys(BIASES, "m/s")}
CHANNELS = {"x_scale": ("x",), "y_scale": ("y",), "map_shear": ("x",), "yaw_offset": ("yaw",),
            "velocity_scale": ("velocity_x", "velocity_y"), "position_lag": ("x", "y"),
            "velocity_lag": ("velocity_x", "velocity_y"),
            "position_reference": ("x", "y"), "velocity_x_bias": ("velocity_x",), "velocity_y_bias": ("velocity_y",)}


def regression(motion: Motion) -> Regression:
    """Regression of the identity's residual over windows on the effects of each cause."""
    over = windows(motion.time, WINDOW)
    east, north = motion.velocity_map
    cosine, sine, rate = np.cos(motion.yaw), np.sin(motion.yaw), motion.yaw_rate
    way = [over.change(integral(motion.time, v)) for v in (east, north)]
    faster = [over.change(v) for v in (east, north)]
    turning = [over.change(integral(motion.time, v)) for v in (-north * rate, east * rate)]
    along = [over.change(integral(motion.time, v)) for v in (cosine, sine)]
    zero = np.zeros(len(over))
    columns = {
        "x_scale": (way[0], zero), "y_scale": (zero, way[1]), "map_shear": (way[1], zero), "velocity_scale": way,
        "yaw_offset": (way[1], -way[0]),
        "position_lag": (-faster[0], -faster[1]),
        "velocity_lag": (faster[0] - turning[0], faster[1] - turning[1]),
        "position_reference": (over.change(cosine), over.change(sine)),
        "velocity_x_bias": (-along[0], -along[1]), "velocity_y_bias": (along[1], -along[0]),
    }
    measured = np.stack([over.change(motion.x) - way[0], over.change(motion.y) - way[1]], axis=1)
    return Regression(over.time, measured, {name: np.stack(c, axis=1) for name, c in columns.items()})


def position(motion: Motion) -> tuple[Motion, list[Finding], dict[str, Estimate]]:
    """(motion with the causes removed, the findings, estimates of every cause as values of its finding)."""
    found: dict[str, Estimate] = {}
    corrected = motion
    for _ in range(ROUNDS):  # the nonlinear part of a large cause is removed in the next round
        problem = regression(corrected)
        if len(problem.time) < LEAST:
            return motion, [], {}
        effects = {name: max(problem.effect(name, 1.0, HORIZON, WINDOW), 1e-9) for name in problem.columns}
        least = {name: max(LIMITS.min_reported_effect / effect, _least(name)) for name, effect in effects.items()}
        # A large cause biases the estimates of the others until it is removed in the next round.
        refined = _refined(problem, found, least, several_speeds(motion.velocity_x))
        found = {name: one for name, one in refined.items() if matters(one, least[name])}
        corrected = _corrected(motion, found)
        if not found:
            break
    findings = [_finding(name, one, problem) for name, one in found.items()  # systematic uncertainty included
                if not _shown(name, one).covers(1.0 if name.endswith("_scale") else 0.0)]
    return corrected, findings, _all(regression(corrected), found)


def scale_of_positions(motion: Motion, findings: list[Finding], estimates: dict[str, Estimate],
                       wheel: Estimate) -> tuple[Motion, list[Finding]]:
    """(motion, findings) with a scale of the velocity turned into one of the positions, if the wheel speed agrees with
    the velocity as recorded rather than with the positions. wheel: its scale against that velocity."""
    wrong = next((one for one in findings if one.name == "velocity_scale"), None)
    if wrong is None or not wrong.value or abs(wheel.value - 1.0) > 0.5 * abs(wrong.value - 1.0) or (
            abs(wrong.value - 1.0) < WHEEL_SCALE):
        return motion, findings
    scale, factor = estimates["position_scale"], wrong.value
    text = (f"x and y are {scale.value:.4f} ± {scale.half:.4f} times the integrated velocity, with which the wheel "
            "speed agrees: scale of the projection?")
    found = replace(wrong, name="position_scale", channels=("x", "y"), text=text, value=scale.value,
                    interval=scale.interval, advice=Advice.correct("position", scale=float(f"{1.0 / scale.value:.5g}")))
    moved = {name: factor * getattr(motion, name) for name in ("x", "y", "velocity_x", "velocity_y")}
    return motion.with_(**moved), [found if one is wrong else one for one in findings]


def misfit(motion: Motion) -> float:
    """Median distance over a second between positions and integrated velocity [m], scales of the map removed."""
    problem = regression(motion)
    return problem.fit(("x_scale", "y_scale"))[1] if len(problem.time) >= LEAST else np.inf


def positions_confirm_yaw_lag(motion: Motion, earlier: Motion, late: float) -> bool:
    """Whether yaw lags by `late` [s] rather than the positions; earlier: the motion with that lag corrected.

    At a constant speed both fit; then it is the yaw if its correction reduces the lag of the positions to a small part.
    """
    fits = [regression(one) for one in (motion, earlier)]
    if len(fits[0].time) < LEAST:
        return False
    (theta, scale, _), (corrected, rest, _) = (one.fit(("x_scale", "y_scale", "position_lag")) for one in fits)
    taken = abs(corrected["position_lag"]) < (MOST if late > 0.0 else NEARLY_ALL) * abs(theta["position_lag"])
    return CLEARLY**2 * rest < scale or (taken and rest < CLEARLY * scale)


def lateral_sign(motion: Motion) -> tuple[Motion, list[Finding]]:
    """(motion, finding) with the sign of velocity_y reversed where that fits positions better than any other cause."""
    if float(np.sqrt(np.mean(motion.velocity_y**2))) < LEAST_ACROSS:
        return motion, []
    mirrored = motion.with_(velocity_y=-motion.velocity_y)
    problem = regression(motion)
    if len(problem.time) < LEAST:
        return motion, []
    twice = -2.0 * float(motion.velocity_y @ motion.yaw_rate) / max(float(motion.yaw_rate @ motion.yaw_rate), 1e-12)
    rivals = []
    for name in (name for name in problem.columns if name not in (*AXES, *BIASES, "velocity_scale")):
        theta, scale, _ = problem.fit(("x_scale", "y_scale", name))
        # The lateral velocity is mostly distance times yaw rate: its wrong sign looks like a point twice that far away.
        if name != "position_reference" or not 0.75 * abs(twice) < theta[name] * np.sign(twice) < 1.33 * abs(twice):
            rivals.append(scale)
    if not misfit(mirrored) < min(0.8 * min(rivals), min(rivals) - LEAST_GAIN):
        return motion, []
    text = "velocity_y counts the other way (left is positive)"
    return mirrored, [Finding("velocity_y_scale", Severity.ERROR, ("velocity_y",), text, -1.0,
                              advice=Advice.correct("velocity_y", scale=-1.0))]


def _refined(problem: Regression, found: dict[str, Estimate], least: dict[str, float],
             speed_varies: bool) -> dict[str, Estimate]:
    """Refined values of the previous causes, and further causes."""
    excluded = {*found, *(twin for name in found for twin in TWINS.get(name, ()))}
    free = {name: value for name, value in least.items() if name not in excluded}
    more = _further(problem, {k: v for k, v in free.items() if k not in BIASES}, tuple(found))
    _, scale, _ = problem.fit((*found, *more))
    loss = problem.loss((*found, *more), scale)
    for bias, twins in BIASES.items():
        if bias in free and twins & {*more} and speed_varies:
            instead = _further(problem, {k: v for k, v in free.items() if k not in twins and (
                k == bias or k not in BIASES)}, tuple(found))
            if bias in instead and CLEARLY * problem.loss((*found, *instead), scale) < loss:
                more = instead
    finer = problem.estimates((*found, *more))
    return {name: one.shifted(found[name].value) if name in found else one for name, one in finer.items()}


def _further(problem: Regression, free: dict[str, float], always: tuple[str, ...]) -> tuple[str, ...]:
    """Names of further significant causes among those that are free."""
    causes = problem.causes({k: v for k, v in free.items() if k != "velocity_scale"}, always,
                            () if "velocity_scale" in always else ("x_scale", "y_scale"))
    return _one_scale(problem, causes, always) if "velocity_scale" in free else tuple(causes)


def _one_scale(problem: Regression, causes: dict[str, Estimate], always: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the causes; equal scales of both axes, or that of the only axis driven, are attributed to velocity.

    Positions come from satellites; one factor in both of their axes is far rarer than a wrong speed.
    """
    axes = [name for name in ("x_scale", "y_scale") if name in causes]
    if not axes or max(abs(causes[name].value) for name in axes) < SPHERE:
        return tuple(causes)
    others = [name for name in causes if name not in axes]
    if len(axes) == 2:
        one = abs(causes["x_scale"].value - causes["y_scale"].value) < SPHERE
    else:
        _, scale, _ = problem.fit([*always, *causes])
        # On a drive along one axis, the motion along the other decides between them.
        one = (problem.loss([*always, *others, "velocity_scale"], scale)
               <= CLEARLY * problem.loss([*always, *causes], scale))
    return (*others, "velocity_scale") if one else tuple(causes)


def _all(problem: Regression, found: dict[str, Estimate]) -> dict[str, Estimate]:
    """Estimate of each cause, fitted with those found, as value of its finding."""
    findings = {}
    for name in problem.columns:
        alongside = tuple(k for k in found if k != name and k not in TWINS.get(name, ()))
        one = problem.estimates((*alongside, name))[name]
        findings[name] = _shown(name, one.shifted(found[name].value) if name in found else one)
    # By which positions would have to be wrong, if velocity is not.
    findings["position_scale"] = findings["velocity_scale"].inverse()
    return findings


def _least(name: str) -> float:
    return {"s": LIMITS.lag, "m": LIMITS.mounting, "m/s": LEAST_BIAS}.get(UNIT.get(name, "1"), 0.0)


def _finding(name: str, one: Estimate, problem: Regression) -> Finding:
    effect = problem.effect(name, one.value, HORIZON, WINDOW)
    shown = _shown(name, one)
    more = shown.value > 0.0
    small = name in AXES and abs(one.value) < SPHERE
    text = TEXT["sphere" if small else name].format(
        axis=name[0], value=shown.value, size=abs(shown.value), half=shown.half, degrees=np.rad2deg(abs(shown.value)),
        side="left" if more else "right", lag="lag" if more else "lead", ahead="ahead of" if more else "behind",
        grows="grows" if more else "shrinks", high="high" if more else "low")
    severity = LIMITS.severity(effect, UNIT.get(name) == "s" and abs(one.value) >= LIMITS.grave_lag)
    return Finding(name, severity, CHANNELS[name], text, shown.value, UNIT.get(name, "1"),
                   shown.interval, (), effect, _advice(name, shown.value))


def _shown(name: str, one: Estimate) -> Estimate:
    """A cause as value of its finding: a correct channel has scale 1."""
    if name == "velocity_scale":
        return with_systematic(name, one.shifted(1.0).inverse())
    return with_systematic(name, one.shifted(1.0) if name.endswith("_scale") else one)


def _advice(name: str, value: float) -> Advice:
    if name == "map_shear":
        return Advice("look", "project latitude and longitude with an origin near the drive")
    channel, entry = {
        "x_scale": ("x", {"scale": 1.0 / value}), "y_scale": ("y", {"scale": 1.0 / value}),
        "velocity_scale": ("velocity", {"scale": 1.0 / value}), "yaw_offset": ("yaw", {"add": -value}),
        "position_lag": ("position", {"earlier": value}), "velocity_lag": ("velocity", {"earlier": value}),
        "position_reference": ("position", {"ahead": -value}),
        **{bias: (bias.removesuffix("_bias"), {"add": -value}) for bias in BIASES},
    }[name] if value else ("", {})
    return Advice.correct(channel, **{key: float(f"{number:.5g}") for key, number in entry.items()})


def _corrected(motion: Motion, found: dict[str, Estimate]) -> Motion:
    value = {name: found[name].value if name in found else 0.0 for name in CHANNELS}
    ahead, faster, time = value["position_reference"], 1.0 + value["velocity_scale"], motion.time
    y = motion.y / (1.0 + value["y_scale"])
    x = motion.x / (1.0 + value["x_scale"]) - value["map_shear"] * y
    fields = {"x": x - ahead * np.cos(motion.yaw), "y": y - ahead * np.sin(motion.yaw),
              "yaw": motion.yaw - value["yaw_offset"],
              "velocity_x": motion.velocity_x * faster - value["velocity_x_bias"],
              "velocity_y": motion.velocity_y * faster - value["velocity_y_bias"]}
    for cause in {"position_lag", "velocity_lag"} & found.keys():
        fields |= {name: np.interp(time + value[cause], time, fields[name]) for name in CHANNELS[cause]}
    return motion.with_(**fields)


def identity(motion: Motion, before: Mapping[str, float]) -> Identity:
    """Distance per second for a figure. before: units that were divided out; the figure shows values as recorded."""
    over = windows(motion.time, WINDOW)
    east, north = motion.velocity_map
    derived = np.hypot(*(over.change(integral(motion.time, v)) for v in (east, north)))
    measured = np.hypot(over.change(motion.x), over.change(motion.y))
    return Identity("position", "distance per second: positions against velocity", "m", "from x, y",
                    "from velocity and yaw", over.time, measured * before.get("position_scale", 1.0),
                    derived * abs(before.get("velocity_scale", before.get("velocity_x_scale", 1.0))),
                    (*TEXT, "position_scale", "velocity_x_scale", "velocity_y_scale"))
