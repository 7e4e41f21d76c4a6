"""Discovery on drives that the models drive themselves, noise added: the arithmetic, not the difficulty of real cars.

A plant of its own, the sealed cases and raw files are in bench/discovery and st_cli/test.
"""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from discovery_drives import linear_problem, recorded
from st_core.discovery import OUTCOMES, PARTS, DiscoverySettings, Limits, discover
from st_core.discovery.clocks import apply_clock_corrections
from st_core.discovery.discover import fit_effects
from st_core.discovery.partitions import MIN_RUNS
from st_core.discovery.result import Reason
from st_core.discovery.search import Search, SearchState
from st_core.discovery.space import Space
from st_core.effects import EFFECTS, load_folder
from st_core.errors import ConfigurationError, StCoreError
from st_core.log import DriveLog

SETTINGS = DiscoverySettings(where=False)
FEW = replace(SETTINGS, effects=("steering_offset", "steering_ratio", "mass"), windows=50)
PAIR = ("lateral_acceleration_bias", "heading_misalignment")
OFFSET = {"steering_offset": {"angle": 0.006}}
STEP_OF_THE_SIMULATION = 0.002  # share of a value: that of the drives is half that of the predictions


def names(found) -> list[str]:
    return [e.name for e in found.effects]


def in_a_set(found) -> set[str]:
    return {n for e in found.effects for n in (e.name, *e.alternatives)}


def holds(parameter, value: float) -> bool:
    low, high = parameter.interval
    room = STEP_OF_THE_SIMULATION * abs(value - parameter.null)
    return low - room <= value <= high + room


# Nothing wrong


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_exact_base_lacks_nothing(leaf, seed):
    found = discover(recorded(leaf, {}, seed), leaf, settings=SETTINGS)
    assert (found.outcome, found.effects, found.minor, found.varying, found.steps) == ("none", (), (), (), ())
    assert found.model is None and found.start == "vehicle file"
    error = found.errors["position_5s"]
    assert error.base == error.augmented < 2.0 * error.floor
    assert {"drag", "grade"} <= {n.name for n in found.not_testable}


@pytest.mark.slow
def test_steering_clocks_that_differ_between_runs_are_no_effect(leaf):
    exact = recorded(leaf, {}, 1, ("lane_change", "slalom", "sweep", "slalom"))
    early = dict(zip([run.name for run in exact], (0.025, -0.015, 0.01, -0.02), strict=True))
    runs = apply_clock_corrections(exact, {name: -error for name, error in early.items()})
    found = discover(runs, leaf, settings=SETTINGS, clocks=dict.fromkeys(early, 0.02))
    assert found.outcome == "none" and "by -2" in found.warnings[0]
    common = np.mean([found.clock_errors[name] - error for name, error in early.items()])
    assert found.clock_errors == pytest.approx({name: error + common for name, error in early.items()}, abs=0.003)
    assert abs(common) < 0.01
    without = discover(runs, leaf, settings=SETTINGS)
    assert without.outcome != "none" and without.errors["position_5s"].augmented > found.errors["position_5s"].augmented
    exactly = discover(exact[:2], leaf, settings=replace(FEW, effects=("steering_offset",)), clocks={"other": 0.02})
    assert exactly.clock_errors == {} and not any("clock" in text for text in exactly.warnings)


# One thing wrong, no reference


@pytest.mark.slow
@pytest.mark.parametrize(("name", "parameter", "value", "driven"), [
    ("steering_offset", "angle", 0.006, ("lane_change", "slalom", "circle")),
    ("steering_ratio", "factor", 0.93, ("lane_change", "slalom", "circle")),
    ("heading_misalignment", "angle", 0.01, ("lane_change", "slalom", "circle")),
    ("steering_lag", "time_constant", 0.12, ("lane_change", "slalom", "circle")),
    ("friction", "factor", 0.75, ("ramp_to_limit", "slalom")),
])
def test_hidden_effect_is_named_with_its_value(leaf, name, parameter, value, driven):
    found = discover(recorded(leaf, {name: {parameter: value}}, 4, driven), leaf, settings=SETTINGS)
    assert found.outcome in {"named", "ambiguous"} and len(found.effects) == 1
    effect, = found.effects
    assert name in in_a_set(found)
    assert effect.name == name and holds(effect.parameters[parameter], value)
    assert effect.parameters[parameter].value == pytest.approx(value, rel=0.03)
    assert found.model.values[name][parameter] == pytest.approx(effect.parameters[parameter].value)
    error = found.errors["position_5s"]
    assert error.augmented < 0.2 * error.base and error.interval[0] > 0.0
    assert effect.position_5s_increase == pytest.approx(error.base - error.augmented, rel=0.5)
    verdicts = {c.name: c.verdict for c in found.candidates}
    assert verdicts[name] == "named" and set(verdicts) == set(Space("nonlinear", SETTINGS).hypotheses)
    assert all(c.why for c in found.candidates)


@pytest.mark.slow
def test_linear_base_at_the_limit_lacks_saturation(leaf):
    # Few effects: the kernel of the whole library for this base would be compiled for this test alone.
    settings = replace(SETTINGS, effects=("tyre_saturation", "front_stiffness", "rear_stiffness", "steering_ratio",
                                          "steering_offset", "steering_lag", "mass", "yaw_rate_scale"))
    found = discover(recorded(leaf, {}, 6, ("circle", "ramp_to_limit")), leaf, "linear", settings=settings)
    assert names(found)[:1] == ["tyre_saturation"]
    assert found.errors["position"].augmented < 0.6 * found.errors["position"].base


# Two things wrong


TWO = {"steering_offset": {"angle": 0.006}, "rear_stiffness": {"factor": 0.85}}


@pytest.mark.slow
def test_two_effects_are_both_found(leaf):
    found = discover(recorded(leaf, TWO, 4), leaf, settings=SETTINGS)
    assert found.outcome == "several"
    assert set(names(found)) == set(TWO) == {s.effect for s in found.steps}
    for effect in found.effects:
        (parameter, value), = TWO[effect.name].items()
        assert holds(effect.parameters[parameter], value)


def test_an_effect_of_forward_steps_is_in_no_start_from_the_library(leaf, monkeypatch):
    starts, prune = [], Search._prune

    def recorded_prune(self, vector, names):
        starts.append(set(names))
        return prune(self, vector, names)

    monkeypatch.setattr(Search, "_prune", recorded_prune)
    discover(recorded(leaf, OFFSET, 4), leaf, settings=replace(FEW, effects=("steering_offset", "mass", "sensor_roll")))
    assert [EFFECTS[name].forward_only for name in ("mass", "sensor_roll")] == [False, True]
    assert len(starts) == 2 and "mass" in starts[1] and not any("sensor_roll" in names for names in starts)


@pytest.mark.parametrize(("heading", "left"), [(1.0, ("road_bank",)), (-1.0, ("heading_misalignment", PAIR[0]))])
def test_one_effect_takes_the_place_of_two_only_where_it_explains_as_much(heading, left):
    problem = linear_problem([*PAIR, "road_bank"], {PAIR[0]: 1.0, PAIR[1]: heading}, seed=1)
    signatures, of = problem.errors.signatures, problem.space.indices
    signatures[of("road_bank")] = signatures[of(PAIR[0])] + signatures[of(PAIR[1])]
    problem.update_design_effect(problem.start)
    fit = problem.fit(PAIR, problem.all_sensitivities(problem.start))
    found = Search(problem, Limits(), {}, {})._exchange_until_accepted(SearchState(fit, list(PAIR)))
    assert sorted(found.fit.names) == sorted(left)


def test_refused_effects_leave_the_residual_scale_as_it_was():
    problem = linear_problem([PAIR[0], "road_bank"], {PAIR[0]: 3.0}, seed=1)
    signatures, of = problem.errors.signatures, problem.space.indices
    signatures[of("road_bank")] = signatures[of(PAIR[0])]  # two contenders, compared at the scale of the better one
    scales, rescale = [problem.loss.scale], problem.loss.rescale
    problem.loss.rescale = lambda vector: (rescale(vector), scales.append(problem.loss.scale))
    search = Search(problem, Limits(), {}, {}, judge=lambda e, limits: Reason("refused", e.name, {}, ""))
    found = search._step_from(problem.fit((), problem.all_sensitivities(problem.start)))
    assert found.fit.names == () and len(scales) > 1 and problem.loss.scale is scales[0]


@pytest.mark.slow
def test_softer_rear_tyres_may_be_a_load(leaf):
    found = discover(recorded(leaf, {"rear_stiffness": {"factor": 0.8}}, 3, noise=4.0), leaf, "nonlinear")
    (rear,) = found.effects
    load = next(c for c in found.candidates if c.name == "load")
    assert rear.name == "rear_stiffness" and rear.alternatives == ("load",) and holds(rear.parameters["factor"], 0.8)
    assert load.parameters["mass"] in (75.0, 250.0)  # not excluded by the drives


@pytest.mark.slow
def test_a_load_has_axle_forces_of_the_laden_car(leaf):
    found = discover(recorded(leaf, {"load": {"mass": 250.0}}, 3), leaf, "nonlinear")
    load = next(c for c in found.candidates if c.name == "load")
    assert load.parameters["mass"] == pytest.approx(250.0, abs=25.0)
    assert load.verdict != "refuted by the axle forces"


@pytest.mark.slow
def test_no_more_effects_than_the_limit_says(leaf):
    """Of the same runs."""
    found = discover(recorded(leaf, TWO, 4), leaf, settings=replace(SETTINGS, limits=Limits(max_effects=1)))
    assert len(found.steps) <= 1


# What is refused


@pytest.mark.slow
@pytest.mark.parametrize(("said", "outcome"), [((0.0, -3e-4, 3e-4), "unknown"), ((0.01, 0.0097, 0.0103), "named")])
def test_sensors_have_a_say_in_what_is_a_sensor_error(leaf, said, outcome):
    found = discover(recorded(leaf, {"yaw_rate_bias": {"bias": 0.01}}, 5), leaf, settings=SETTINGS,
                     sensor_estimates={"yaw_rate_bias": said})
    verdict = {c.name: c.verdict for c in found.candidates}["yaw_rate_bias"]
    assert found.outcome == outcome
    assert names(found) == (["yaw_rate_bias"] if outcome == "named" else [])
    assert verdict == ("named" if outcome == "named" else "refuted by the sensors")


def shifted(log: DriveLog, angle: float, after: float = 0.0) -> DriveLog:
    """The steering read that much too far right after a share of the drive."""
    later = np.linspace(0.0, 1.0, len(log.road_wheel_angle)) >= after
    return replace(log, road_wheel_angle=log.road_wheel_angle - angle * later)


@pytest.mark.slow
def test_offset_that_differs_from_run_to_run_is_varying(leaf):
    runs = recorded(leaf, {}, 4, ("lane_change", "slalom", "circle") * 2)
    angles = (0.006, 0.002, -0.003, 0.008, 0.0, -0.001)
    found = discover([shifted(r, a) for r, a in zip(runs, angles, strict=True)], leaf, settings=SETTINGS)
    assert found.outcome == "varying" and found.effects == ()
    assert any("steering_offset" in b.resembles and b.varies_with == "run" for b in found.varying)


@pytest.mark.slow
def test_offset_of_the_second_half_is_not_named(leaf):
    """It came on the way: told, whatever it resembles, and no property of the car."""
    runs = [shifted(r, 0.006, 0.5) for r in recorded(leaf, {}, 3)]
    found = discover(runs, leaf, settings=SETTINGS)
    assert found.outcome in {"varying", "unknown"} and found.effects == ()


@pytest.mark.slow
def test_offset_of_one_run_is_not_named(leaf):
    runs = recorded(leaf, {}, 4, ("lane_change", "slalom", "circle") * 2)
    found = discover([shifted(runs[0], 0.006), *runs[1:]], leaf, settings=SETTINGS)
    assert found.outcome in {"varying", "unknown"} and found.effects == ()


# With a reference


HEALTHY = {"steering_lag": {"time_constant": 0.03}, "tyre_relaxation": {"length": 0.3},
           "steering_ratio": {"factor": 0.97}}


@pytest.mark.slow
def test_what_the_healthy_car_differs_by_is_not_stated(leaf):
    found = discover(recorded(leaf, HEALTHY, 12), leaf, reference=recorded(leaf, HEALTHY, 11), settings=SETTINGS)
    assert found.outcome == "not_testable" and found.effects == () and found.unseparated_combinations == ()
    assert found.model is None and found.start == "reference"
    assert [r.role for r in found.runs] == ["suspect"] * 3 + ["reference"] * 3


@pytest.mark.slow
def test_what_has_changed_since_the_reference_is_stated(leaf):
    """By how much, from the reference on; not from the vehicle file."""
    late = {**HEALTHY, "steering_lag": {"time_constant": 0.09}}
    found = discover(recorded(leaf, late, 13), leaf, reference=recorded(leaf, HEALTHY, 11), settings=SETTINGS)
    assert names(found) == ["steering_lag"]
    value = found.effects[0].parameters["time_constant"]
    assert holds(value, 0.06) and value.value == pytest.approx(0.06, abs=0.012)
    assert found.model.values["steering_lag"]["time_constant"] == pytest.approx(0.09, abs=0.02)


# What takes part


def test_channels_that_were_not_measured_are_not_used(leaf):
    blind = [replace(log, velocity_y=0.0 * log.velocity_y, acceleration_y=None)
             for log in recorded(leaf, {"steering_ratio": {"factor": 0.93}}, 5)]
    found = discover(blind, leaf, settings=FEW)
    assert names(found) == ["steering_ratio"]
    assert found.effects[0].parameters["factor"].value == pytest.approx(0.93, abs=0.005)
    assert not {"velocity_y", "acceleration_y"} & set(found.errors)
    assert any("velocity_y, acceleration_y: not measured in every run" in text for text in found.warnings)


def test_without_a_lateral_velocity_no_ins_position_or_misalignment_is_searched():
    """Yaw may then be the course over ground, which has no sideslip at any place of the INS."""
    channels = tuple(c for c in SETTINGS.channels if c != "velocity_y")
    everything, without = (Space("nonlinear", settings).hypotheses
                           for settings in (SETTINGS, replace(SETTINGS, channels=channels)))
    assert {*everything} - {*without} == {"sensor_lever_arm", "sensor_roll", "heading_misalignment"}


FLYWHEEL = '''"""A flywheel that stabilises the car: r_dot = r_dot - gain r v_y^2."""

from st_core.effects import Effect, Parameter, register


@register
class Flywheel(Effect):
    name = "flywheel"
    physics = "r_dot = r_dot - gain r v_y^2"
    excited_by = "turning with sideslip"
    kind, slot = "physics", "body"
    parameters = (
        Parameter("gain", "s/m^2", null=0.0, initial=1.5, bounds=(-10.0, 10.0), meaning="damps", source="a guess"),
    )

    @staticmethod
    def acceleration(instant, prepared, theta):
        zero = 0.0 * instant.yaw_rate
        return zero, zero, -theta.gain * instant.yaw_rate * instant.velocity_y * instant.velocity_y
'''


@pytest.fixture
def flywheel(tmp_path):
    before, modules = dict(EFFECTS), set(sys.modules)
    (tmp_path / "flywheel.py").write_text(FLYWHEEL)
    load_folder(tmp_path)
    yield
    EFFECTS.clear()
    EFFECTS.update(before)
    for name in [m for m in sys.modules if m.startswith("st_effects_") and m not in modules]:
        del sys.modules[name]


@pytest.mark.slow
def test_own_effect_of_a_folder_is_found(leaf, flywheel):
    # Few others: the kernel is compiled for this test alone.
    settings = replace(SETTINGS, effects=("flywheel", "front_stiffness", "rear_stiffness", "steering_ratio",
                                          "steering_offset", "steering_lag", "yaw_inertia", "yaw_rate_scale"))
    found = discover(recorded(leaf, {"flywheel": {"gain": 5.0}}, 10), leaf, settings=settings)
    assert names(found) == ["flywheel"]
    assert holds(found.effects[0].parameters["gain"], 5.0)


# The document


def test_answer_is_the_same_twice_and_all_of_it_is_json(leaf):
    runs, ticks = recorded(leaf, OFFSET, 1), []
    first, second = (discover(runs, leaf, settings=FEW, progress=lambda *tick: ticks.append(tick)).document()
                     for _ in range(2))
    assert json.dumps(first) == json.dumps(second)
    assert json.loads(json.dumps(first)) == first
    assert first["outcome"] in OUTCOMES and {line["part"] for line in first["budget"]} <= set(PARTS)
    assert first["effects"][0]["parameters"]["angle"]["unit"] == "rad"
    assert [r["name"] for r in first["runs"]] == ["lane_change 1", "slalom 2", "circle 3"]
    assert first["reasons"][0]["subject"] == "outcome" and first["reasons"][0]["rule"] == first["outcome"]
    assert {stage for stage, *_ in ticks} >= {"searching", "explaining"}
    assert all(0 < done <= total for _, done, total in ticks)


def test_threads_do_not_change_the_answer(leaf):
    runs = recorded(leaf, OFFSET, 1)
    one, two = (discover(runs, leaf, settings=FEW, parallel=n).effects[0].parameters["angle"].value for n in (1, 2))
    assert one == pytest.approx(two, rel=1e-12)


# Little or bad input


def straight(leaf, seed: int) -> DriveLog:
    """Straight on at 14 m/s."""
    rng = np.random.default_rng(seed)
    log = recorded(leaf, {}, seed, ("weave",))[0]
    n = len(log.x)
    return replace(log, name=f"straight {seed}", road_wheel_angle=0.0 * log.road_wheel_angle,
                   x=14.0e-9 * log.ins_time_ns + 0.01 * rng.standard_normal(n), y=0.01 * rng.standard_normal(n),
                   yaw=1e-4 * rng.standard_normal(n), yaw_rate=0.002 * rng.standard_normal(n),
                   velocity_x=14.0 + 0.003 * rng.standard_normal(n), velocity_y=0.003 * rng.standard_normal(n),
                   acceleration_y=0.05 * rng.standard_normal(n))


def test_straight_driving_is_said_to_show_little(leaf):
    found = discover([straight(leaf, seed) for seed in range(3)], leaf, settings=FEW)
    assert found.effects == () and found.outcome in {"none", "not_testable"}
    assert any("driving is straight: tyres, steering ratio and mass are not identifiable" in text
               for text in found.warnings)
    assert {"steering_ratio", "mass"} <= {n.name for n in found.not_testable}


def test_one_bend_is_said(leaf):
    log = recorded(leaf, {}, 1, ("circle",))[0]
    half = log.slice(log.start_ns, log.start_ns + 13_000_000_000)
    found = discover([replace(half, name=f"left {k}") for k in range(2)], leaf, settings=FEW)
    assert any("turns to one side only" in text for text in found.warnings)
    both = discover([log], leaf, settings=FEW)
    assert not any("turns to one side" in text for text in both.warnings)


@pytest.mark.parametrize(("count", "text"), [(1, "one run only"), (2, "2 runs only"), (MIN_RUNS - 1, "4 runs only"),
                                             (MIN_RUNS, "")])
def test_few_runs_are_named_in_a_warning(leaf, count, text):
    runs = [replace(log, name=f"{log.name}, {seed}") for seed in (1, 2) for log in recorded(leaf, OFFSET, seed)]
    found = discover(runs[:count], leaf, settings=FEW)
    warnings = [warning for warning in found.warnings if "instead of whole runs" in warning]
    assert len(warnings) == bool(text) and all(warning.startswith(text) for warning in warnings)
    assert not text or any("tests have little power" in warning for warning in found.warnings)
    assert len(found.runs) == count and all(r.windows > 0 for r in found.runs)


def test_one_site_is_said(leaf):
    logs = recorded(leaf, OFFSET, 1)
    elsewhere = [*logs[:2], replace(logs[2], x=logs[2].x + 2000.0)]
    for runs, said in ((logs, True), (elsewhere, False)):
        found = discover(runs, leaf, settings=FEW)
        assert any("all driving is at one site" in text for text in found.warnings) == said


def test_value_on_a_bound_is_no_name(leaf):
    driven = ("lane_change", "slalom", "circle", "sweep", "step", "weave")
    logs = [replace(log, yaw_rate=1.4 * log.yaw_rate) for log in recorded(leaf, {}, 1, driven)]
    found = discover(logs, leaf, settings=replace(FEW, effects=("yaw_rate_scale",), channels=("yaw_rate", "position")))
    assert found.outcome == "unknown" and found.effects == ()
    (candidate,) = found.candidates
    assert candidate.verdict == "on a bound" and "its value is at a bound" in candidate.why
    assert candidate.parameters["factor"] == pytest.approx(1.25)


def test_short_run_is_left_out_in_words(leaf):
    runs = recorded(leaf, {}, 1)
    short = replace(runs[0].slice(runs[0].start_ns, runs[0].start_ns + 4_000_000_000), name="a stub")
    found = discover([short, *runs[1:]], leaf, settings=FEW)
    assert any("run a stub: shorter than" in text for text in found.warnings)
    assert [r.name for r in found.runs] == ["slalom 2", "circle 3"]


def test_runs_too_short_are_refused_in_words(leaf):
    short = [log.slice(0, 2_000_000_000) for log in recorded(leaf, {}, 8, ("step",))]
    for runs in (short, []):
        with pytest.raises(StCoreError, match="no run is long enough: a run needs 7 s of driving"):
            discover(runs, leaf, settings=FEW)


def test_two_drives_of_one_name_are_refused_in_words(leaf):
    (run,) = recorded(leaf, {}, 9, ("step",))
    for call in (lambda runs: discover(runs, leaf, "linear"), lambda runs: fit_effects(runs, leaf, "linear", ())):
        with pytest.raises(StCoreError, match="duplicate name; give each drive once"):
            call([run, run])


def test_car_that_stands_is_refused_in_words(leaf):
    log = recorded(leaf, {}, 9, ("step",))[0]
    stands = replace(log, velocity_x=0.0 * log.velocity_x)
    with pytest.raises(StCoreError, match="drive longer, above walking speed"):
        discover([stands], leaf, settings=FEW)
    with pytest.raises(StCoreError, match="drive longer, above walking speed"):
        discover([stands, replace(stands, name="2")], leaf, settings=SETTINGS, clocks={log.name: 0.02, "2": 0.02})


def test_log_with_nan_is_refused_in_words(leaf):
    log = recorded(leaf, {}, 9, ("step",))[0]
    holes = log.velocity_y.copy()
    holes[300:400] = np.nan
    with pytest.raises(StCoreError, match="step 1: velocity_y has values that are not finite"):
        replace(log, velocity_y=holes)


@pytest.mark.parametrize(("effects", "said"), [(("steering_lagg",), "steering_lag"),
                                               (("tyre_slip",), "does not apply")])
def test_effect_that_cannot_take_part_is_refused(effects, said):
    with pytest.raises(StCoreError, match=said):
        Space("nonlinear", replace(SETTINGS, effects=effects))


def test_effects_without_their_channel_are_refused():
    settings = replace(SETTINGS, effects=("lateral_acceleration_bias",), channels=("yaw_rate",))
    with pytest.raises(ConfigurationError, match="none of those requested can be tried"):
        Space("nonlinear", settings)


@pytest.mark.parametrize(("key", "value"), [("channels", ("sideslip",)), ("channels", ()), ("horizon", 0.1),
                                            ("horizon", 20.0), ("windows", 3), ("block", 0.0)])
def test_settings_out_of_range_name_the_key(key, value):
    with pytest.raises(ConfigurationError, match=key):
        DiscoverySettings(**{key: value})
