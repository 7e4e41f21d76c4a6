"""Discovery on drives simulated with the models themselves, plus sensor noise: tests the arithmetic of the search.

Independent plants, the sealed cases and raw files are in bench/plants, bench/discovery and st_cli/test.
"""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from discovery_drives import linear_problem, recorded
from st_core.discovery import BUDGET_PARTS, OUTCOMES, DiscoverySettings, Limits, discover
from st_core.discovery.decision import judge_necessity, list_alternatives
from st_core.discovery.discover import fit_effects
from st_core.discovery.evidence import Evidence
from st_core.discovery.library_fit import apply_clock_corrections
from st_core.discovery.partitions import MIN_RUNS
from st_core.discovery.result import Reason
from st_core.discovery.search import Search, SearchState
from st_core.discovery.space import Space
from st_core.discovery.windows import Windows
from st_core.effects import EFFECTS, load_folder
from st_core.errors import ConfigurationError, StCoreError
from st_core.log import DriveLog

SETTINGS = DiscoverySettings(locate_errors=False)
FEW = replace(SETTINGS, effects=("steering_offset", "steering_ratio", "mass"), windows=50)
PAIR = ("lateral_acceleration_bias", "heading_misalignment")
OFFSET = {"steering_offset": {"angle": 0.006}}
INTEGRATION_ERROR = 0.002  # relative error of a value: the drives use half the integration step of the predictions


def effect_names(found) -> list[str]:
    return [e.name for e in found.effects]


def interval_covers(parameter, value: float) -> bool:
    low, high = parameter.interval
    margin = INTEGRATION_ERROR * abs(value - parameter.null)
    return low - margin <= value <= high + margin


@pytest.fixture
def library(monkeypatch):
    """library(*names): restricts the library to a few effects, because the kernel of all effects takes half a minute to
    compile for a base model or a library that no other test has."""
    def restrict(*names: str) -> None:
        space = sys.modules[Space.__module__]
        monkeypatch.setattr(space, "find_applicable_effects", lambda model: tuple(sorted(names)))
    return restrict


@pytest.fixture(scope="module")
def offset_runs(leaf) -> list[DriveLog]:
    return recorded(leaf, OFFSET, 1)


@pytest.fixture(scope="module")
def offset_result(leaf, offset_runs):
    """(result, calls of progress)."""
    calls = []
    return discover(offset_runs, leaf, settings=FEW, progress=lambda *call: calls.append(call)), calls


# No fault


@pytest.mark.slow
def test_exact_base_model_has_no_missing_effect(leaf):
    found = discover(recorded(leaf, {}, 1), leaf, settings=SETTINGS)
    assert (found.outcome, found.effects, found.minor, found.varying, found.steps) == ("none", (), (), (), ())
    assert found.model is None and found.start == "vehicle file"
    error = found.errors["position_5s"]
    assert error.base == error.augmented < 2.0 * error.floor
    assert {"drag", "grade"} <= {n.name for n in found.not_testable}


@pytest.mark.slow
def test_steering_clock_errors_that_differ_between_runs_are_not_reported_as_an_effect(leaf):
    exact = recorded(leaf, {}, 1, ("lane_change", "slalom", "sweep", "slalom"))
    early = dict(zip([run.name for run in exact], (0.025, -0.015, 0.01, -0.02), strict=True))
    runs = apply_clock_corrections(exact, {name: -error for name, error in early.items()})
    found = discover(runs, leaf, settings=SETTINGS, clocks=dict.fromkeys(early, 0.02))
    assert found.outcome == "none" and "by -2" in found.warnings[0]
    common = np.mean([found.clock_errors[name] - error for name, error in early.items()])
    assert found.clock_errors == pytest.approx({name: error + common for name, error in early.items()}, abs=0.003)
    assert abs(common) < 0.01
    without = discover(runs, leaf, settings=SETTINGS)  # no uncertainty of the clocks
    assert without.outcome != "none" and without.errors["position_5s"].augmented > found.errors["position_5s"].augmented
    other_clock = discover(exact[:2], leaf, settings=replace(FEW, effects=("steering_offset",)), clocks={"other": 0.02})
    assert other_clock.clock_errors == {} and not any("clock" in text for text in other_clock.warnings)


# One fault, no reference


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
    assert effect.name == name and interval_covers(effect.parameters[parameter], value)
    assert effect.parameters[parameter].value == pytest.approx(value, rel=0.03)
    assert found.model.values[name][parameter] == pytest.approx(effect.parameters[parameter].value)
    error = found.errors["position_5s"]
    assert error.augmented < 0.2 * error.base and error.interval[0] > 0.0
    assert effect.position_5s_increase == pytest.approx(error.base - error.augmented, rel=0.5)
    verdicts = {c.name: c.verdict for c in found.candidates}
    assert verdicts[name] == "named" and set(verdicts) == set(Space("nonlinear", SETTINGS).hypotheses)
    assert all(c.reason for c in found.candidates)
    assert ("rear-wheel steering" in effect.other_causes) == (name == "steering_ratio")


@pytest.mark.slow
def test_ratio_and_ins_position_of_rear_wheels_that_steer_are_not_named(leaf, library):
    """Rear wheels that steer by -0.06 times the front angle act like a ratio of 1 / 1.06 and an INS further back."""
    library("steering_ratio", "sensor_lever_arm", "steering_offset")
    truth = {"steering_ratio": {"factor": 1.0 / 1.06},
             "sensor_lever_arm": {"x": leaf.wheelbase * (1.0 / 1.06 - 1.0), "y": 0.0}}
    found = discover(recorded(leaf, truth, 4, ("lane_change", "slalom", "circle")), leaf, settings=SETTINGS)
    assert not found.effects and {e.name for e in found.minor} == set(truth)
    assert any("rear wheels that steer by -0.06" in warning for warning in found.warnings)


@pytest.mark.slow
def test_tyre_saturation_is_found_for_a_linear_base_at_the_handling_limit(leaf, library):
    library("tyre_saturation", "front_stiffness", "steering_ratio", "mass")
    found = discover(recorded(leaf, {}, 6, ("circle", "ramp_to_limit")), leaf, "linear", settings=SETTINGS)
    assert effect_names(found)[:1] == ["tyre_saturation"]
    assert found.errors["position"].augmented < 0.6 * found.errors["position"].base


# Two faults


TWO_EFFECTS = {"steering_offset": {"angle": 0.006}, "rear_stiffness": {"factor": 0.85}}


@pytest.mark.slow
def test_two_effects_are_both_found(leaf):
    found = discover(recorded(leaf, TWO_EFFECTS, 4), leaf, settings=SETTINGS)
    assert found.outcome == "several"
    assert set(effect_names(found)) == set(TWO_EFFECTS) == {s.effect for s in found.steps}
    for effect in found.effects:
        (parameter, value), = TWO_EFFECTS[effect.name].items()
        assert interval_covers(effect.parameters[parameter], value)


@pytest.mark.slow
def test_forward_only_effects_are_excluded_when_the_search_starts_from_the_whole_library(leaf, monkeypatch):
    starts, prune = [], Search._prune

    def recorded_prune(self, vector, names):
        starts.append(set(names))
        return prune(self, vector, names)

    monkeypatch.setattr(Search, "_prune", recorded_prune)
    discover(recorded(leaf, OFFSET, 4), leaf, settings=replace(FEW, effects=("steering_offset", "mass", "sensor_roll")))
    assert [EFFECTS[name].forward_only for name in ("mass", "sensor_roll")] == [False, True]
    assert len(starts) == 2 and "mass" in starts[1] and not any("sensor_roll" in names for names in starts)


@pytest.mark.parametrize(("heading", "expected"), [(1.0, ("road_bank",)), (-1.0, ("heading_misalignment", PAIR[0]))])
def test_one_effect_replaces_two_only_if_it_explains_as_much(heading, expected):
    problem = linear_problem([*PAIR, "road_bank"], {PAIR[0]: 1.0, PAIR[1]: heading}, seed=1)
    signatures, index = problem.errors.signatures, problem.space.indices
    signatures[index("road_bank")] = signatures[index(PAIR[0])] + signatures[index(PAIR[1])]
    problem.update_design_effect(problem.start)
    fit = problem.fit(PAIR, problem.all_sensitivities(problem.start))
    found = Search(problem, Limits(), {}, {})._exchange_until_accepted(SearchState(fit))
    assert sorted(found.fit.names) == sorted(expected)


@pytest.mark.parametrize(("replaced_by", "rival", "alternatives", "named"), [
    (PAIR, "lateral_acceleration_bias and heading_misalignment", (), False),
    (PAIR[:1], "", PAIR[:1], True),  # a single effect is an alternative; nothing else replaces both
    ((), "", (), True),
])
def test_effect_is_named_only_if_no_other_set_explains_the_errors(replaced_by, rival, alternatives, named):
    """As of a minibus whose stiffer front tyres a roll steer described; a second effect was needed to replace it."""
    problem = linear_problem([*PAIR, "road_bank"], {"road_bank": 3.0}, seed=1)
    signatures, index = problem.errors.signatures, problem.space.indices
    if replaced_by:
        signatures[index("road_bank")] = sum(signatures[index(name)] for name in replaced_by)
    problem.update_design_effect(problem.start)
    search = Search(problem, Limits(), {}, {})
    fit = problem.fit(("road_bank",), problem.all_sensitivities(problem.start))
    state = SearchState(search._rescale(fit))
    search._drop_rejected(state)
    best = search.find_best_rival(state, "road_bank")
    assert best.name == rival and list_alternatives(state.rivals["road_bank"], Limits()) == alternatives
    assert (judge_necessity(best, Limits()) is None) == named


def test_p_value_of_the_best_rival_is_corrected_for_two_tests(monkeypatch):
    problem = linear_problem(PAIR[:1], {PAIR[0]: 3.0}, seed=1)
    search = Search(problem, Limits(), {}, {})
    state = SearchState(problem.fit(PAIR[:1], problem.all_sensitivities(problem.start)))
    search._drop_rejected(state)
    monkeypatch.setattr("st_core.discovery.search.p_no_worse", lambda difference: 0.03)
    monkeypatch.setattr("scipy.stats.wilcoxon", lambda *_, **__: SimpleNamespace(pvalue=0.04))
    assert search.find_best_rival(state, PAIR[0]).p_no_worse == 0.06


def test_sets_found_from_other_starts_widen_the_intervals():
    """If the residual is far above the noise and their loss is similar, as of an SUV with three optima."""
    problem = linear_problem(PAIR, {PAIR[0]: 3.0}, seed=1)
    sensitivities = problem.all_sensitivities(problem.start)
    search = Search(problem, Limits(), {}, {})
    selected = search._select([SearchState(problem.fit(names, sensitivities)) for names in (PAIR[:1], PAIR)])
    selected.evidence = {PAIR[0]: Evidence(PAIR[0], 0.5, 0.001, noise_ratio=5.0)}
    near = search._find_near_sets(selected)
    assert [names for names, _ in near] == [PAIR[:1], PAIR]
    selected.evidence = {PAIR[0]: Evidence(PAIR[0], 0.5, 0.001, noise_ratio=1.0)}
    assert search._find_near_sets(selected) == []


def test_residual_scale_is_unchanged_when_all_effects_are_rejected():
    problem = linear_problem([PAIR[0], "road_bank"], {PAIR[0]: 3.0}, seed=1)
    signatures, index = problem.errors.signatures, problem.space.indices
    signatures[index("road_bank")] = signatures[index(PAIR[0])]  # two equal candidates
    scales, rescale = [problem.loss.scale], problem.loss.rescale
    problem.loss.rescale = lambda vector: (rescale(vector), scales.append(problem.loss.scale))
    search = Search(problem, Limits(), {}, {}, judge=lambda e, limits: Reason("refused", e.name, {}, ""))
    found = search._step_from(problem.fit((), problem.all_sensitivities(problem.start)))
    assert found.fit.names == () and len(scales) > 1 and problem.loss.scale is scales[0]


@pytest.mark.slow
def test_load_is_an_alternative_to_softer_rear_tyres(leaf):
    found = discover(recorded(leaf, {"rear_stiffness": {"factor": 0.8}}, 3, noise=4.0), leaf, "nonlinear")
    (rear,) = found.effects
    load = next(c for c in found.candidates if c.name == "load")
    assert rear.name == "rear_stiffness" and rear.alternatives == ("load",)
    assert interval_covers(rear.parameters["factor"], 0.8)
    assert load.parameters["mass"] in (75.0, 250.0)  # not excluded by the drives
    assert rear.parameters["factor"].interval[1] > 0.95  # with this load, the tyres are stiffer


@pytest.mark.slow
def test_load_is_not_refuted_by_the_axle_forces_of_the_laden_car(leaf):
    found = discover(recorded(leaf, {"load": {"mass": 250.0}}, 3), leaf, "nonlinear")
    load = next(c for c in found.candidates if c.name == "load")
    assert load.parameters["mass"] == pytest.approx(250.0, abs=25.0)
    assert load.verdict != "refuted by the axle forces"


@pytest.mark.slow
def test_number_of_effects_is_limited(leaf):
    runs, settings = recorded(leaf, TWO_EFFECTS, 4), replace(FEW, effects=tuple(TWO_EFFECTS))
    assert len(discover(runs, leaf, settings=settings).steps) == 2
    assert len(discover(runs, leaf, settings=replace(settings, limits=Limits(max_effects=1))).steps) == 1


# Effects that are not named


@pytest.mark.slow
@pytest.mark.parametrize(("sensor_estimate", "outcome"), [((0.0, -3e-4, 3e-4), "unknown"),
                                                          ((0.01, 0.0097, 0.0103), "named")])
def test_sensor_estimate_confirms_or_refutes_a_yaw_rate_bias(leaf, sensor_estimate, outcome):
    found = discover(recorded(leaf, {"yaw_rate_bias": {"bias": 0.01}}, 5), leaf, settings=SETTINGS,
                     sensor_estimates={"yaw_rate_bias": sensor_estimate})
    verdict = {c.name: c.verdict for c in found.candidates}["yaw_rate_bias"]
    assert found.outcome == outcome
    assert effect_names(found) == (["yaw_rate_bias"] if outcome == "named" else [])
    assert verdict == ("named" if outcome == "named" else "refuted by the sensors")


def with_steering_offset(log: DriveLog, angle: float, after: float = 0.0) -> DriveLog:
    """The steering reads `angle` [rad] too far right from the fraction `after` of the drive on."""
    later = np.linspace(0.0, 1.0, len(log.road_wheel_angle)) >= after
    return replace(log, road_wheel_angle=log.road_wheel_angle - angle * later)


@pytest.mark.slow
def test_steering_offset_that_varies_between_runs_is_reported_as_varying(leaf):
    runs = recorded(leaf, {}, 4, ("lane_change", "slalom", "circle") * 2)
    angles = (0.006, 0.002, -0.003, 0.008, 0.0, -0.001)
    found = discover([with_steering_offset(r, a) for r, a in zip(runs, angles, strict=True)], leaf, settings=SETTINGS)
    assert found.outcome == "varying" and found.effects == ()
    assert any("steering_offset" in b.resembles and b.varies_with == "run" for b in found.varying)


@pytest.mark.slow
def test_steering_offset_in_the_second_half_only_is_not_named(leaf):
    """It appears during the drive, so it is reported, but not as a property of the car."""
    runs = [with_steering_offset(r, 0.006, 0.5) for r in recorded(leaf, {}, 3)]
    found = discover(runs, leaf, settings=SETTINGS)
    assert found.outcome in {"varying", "unknown"} and found.effects == ()


@pytest.mark.slow
def test_steering_offset_in_one_run_only_is_not_named(leaf):
    runs = recorded(leaf, {}, 4, ("lane_change", "slalom", "circle") * 2)
    found = discover([with_steering_offset(runs[0], 0.006), *runs[1:]], leaf, settings=SETTINGS)
    assert found.outcome in {"varying", "unknown"} and found.effects == ()


# With a reference


HEALTHY = {"steering_lag": {"time_constant": 0.03}, "tyre_relaxation": {"length": 0.3},
           "steering_ratio": {"factor": 0.97}}


@pytest.mark.slow
def test_effects_that_the_reference_drives_also_have_are_not_reported(leaf):
    found = discover(recorded(leaf, HEALTHY, 12), leaf, reference=recorded(leaf, HEALTHY, 11), settings=SETTINGS)
    assert found.outcome == "not_testable" and found.effects == () and found.unseparated_combinations == ()
    assert found.model is None and found.start == "reference"
    assert [r.role for r in found.runs] == ["suspect"] * 3 + ["reference"] * 3


@pytest.mark.slow
def test_change_since_the_reference_is_reported(leaf):
    """The value is the difference from the reference, not from the vehicle file."""
    slower = {**HEALTHY, "steering_lag": {"time_constant": 0.09}}
    found = discover(recorded(leaf, slower, 13), leaf, reference=recorded(leaf, HEALTHY, 11), settings=SETTINGS)
    assert effect_names(found) == ["steering_lag"]
    value = found.effects[0].parameters["time_constant"]
    assert interval_covers(value, 0.06) and value.value == pytest.approx(0.06, abs=0.012)
    assert found.model.values["steering_lag"]["time_constant"] == pytest.approx(0.09, abs=0.02)


# Channels and effects in use


@pytest.mark.slow
def test_channels_that_were_not_measured_are_not_used(leaf):
    runs = [replace(log, velocity_y=0.0 * log.velocity_y, acceleration_y=None)
             for log in recorded(leaf, {"steering_ratio": {"factor": 0.93}}, 5)]
    found = discover(runs, leaf, settings=FEW)
    assert effect_names(found) == ["steering_ratio"]
    assert found.effects[0].parameters["factor"].value == pytest.approx(0.93, abs=0.005)
    assert not {"velocity_y", "acceleration_y"} & set(found.errors)
    assert any("velocity_y, acceleration_y: not measured in every run" in text for text in found.warnings)


def test_without_lateral_velocity_neither_ins_position_nor_misalignment_is_tried():
    """Yaw may then be the course over ground, which shows no sideslip wherever the INS is mounted."""
    channels = tuple(c for c in SETTINGS.channels if c != "velocity_y")
    with_velocity_y, without = (Space("nonlinear", settings).hypotheses
                           for settings in (SETTINGS, replace(SETTINGS, channels=channels)))
    assert {*with_velocity_y} - {*without} == {"sensor_lever_arm", "sensor_roll", "heading_misalignment"}


FLYWHEEL = '''"""A flywheel that stabilises the car: r_dot = r_dot - gain r v_y^2."""

from st_core.effects import Effect, Parameter, register


@register
class Flywheel(Effect):
    name = "flywheel"
    physics = "r_dot = r_dot - gain r v_y^2"
    excited_by = "turning with sideslip"
    kind, slot = "physics", "body"
    parameters = (
        Parameter("gain", "s/m^2", null=0.0, initial=1.5, bounds=(-10.0, 10.0), meaning="damping", source="example"),
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
def test_user_defined_effect_from_a_folder_is_found(leaf, flywheel, library):
    library("flywheel", "rear_stiffness", "yaw_inertia", "yaw_rate_scale")
    found = discover(recorded(leaf, {"flywheel": {"gain": 5.0}}, 10), leaf, settings=SETTINGS)
    assert effect_names(found) == ["flywheel"]
    assert interval_covers(found.effects[0].parameters["gain"], 5.0)


# The result document


@pytest.mark.slow
def test_result_is_reproducible_and_json_serialisable(leaf, offset_runs, offset_result):
    result, calls = offset_result
    first, second = (found.document() for found in (result, discover(offset_runs, leaf, settings=FEW)))
    assert json.dumps(first) == json.dumps(second)
    assert json.loads(json.dumps(first)) == first
    assert first["outcome"] in OUTCOMES and {line["part"] for line in first["budget"]} <= set(BUDGET_PARTS)
    assert first["effects"][0]["parameters"]["angle"]["unit"] == "rad"
    assert [r["name"] for r in first["runs"]] == ["lane_change 1", "slalom 2", "circle 3"]
    assert first["reasons"][0]["subject"] == "outcome" and first["reasons"][0]["rule"] == first["outcome"]
    assert {stage for stage, *_ in calls} >= {"searching", "decomposing the errors"}
    assert all(0 < done <= total for _, done, total in calls)


@pytest.mark.slow
def test_result_does_not_depend_on_the_number_of_threads(leaf, offset_runs, offset_result):
    found = (offset_result[0], discover(offset_runs, leaf, settings=FEW, parallel=2))
    one, two = (each.effects[0].parameters["angle"].value for each in found)
    assert one == pytest.approx(two, rel=1e-12)


# Insufficient or invalid input


def straight(leaf, seed: int) -> DriveLog:
    """A straight drive at 14 m/s with sensor noise."""
    rng = np.random.default_rng(seed)
    log = recorded(leaf, {}, seed, ("weave",))[0]
    n = len(log.x)
    return replace(log, name=f"straight {seed}", road_wheel_angle=0.0 * log.road_wheel_angle,
                   x=14.0e-9 * log.ins_time_ns + 0.01 * rng.standard_normal(n), y=0.01 * rng.standard_normal(n),
                   yaw=1e-4 * rng.standard_normal(n), yaw_rate=0.002 * rng.standard_normal(n),
                   velocity_x=14.0 + 0.003 * rng.standard_normal(n), velocity_y=0.003 * rng.standard_normal(n),
                   acceleration_y=0.05 * rng.standard_normal(n))


@pytest.mark.slow
def test_straight_driving_gives_a_warning_and_effects_that_are_not_testable(leaf):
    found = discover([straight(leaf, seed) for seed in range(3)], leaf, settings=FEW)
    assert found.effects == () and found.outcome in {"none", "not_testable"}
    assert any("driving is straight: tyres, steering ratio and mass are not identifiable" in text
               for text in found.warnings)
    assert {"steering_ratio", "mass"} <= {n.name for n in found.not_testable}


@pytest.mark.slow
def test_driving_in_left_bends_only_gives_a_warning(leaf, offset_result):
    log = recorded(leaf, {}, 1, ("circle",))[0]
    half = log.slice(log.start_ns, log.start_ns + 13_000_000_000)
    found = discover([replace(half, name=f"left {k}") for k in range(2)], leaf, settings=FEW)
    assert any("nearly all turns are to one side" in text for text in found.warnings)
    assert not any("turns to one side" in text for text in offset_result[0].warnings)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "text"), [(1, "one run only"), (MIN_RUNS - 1, "4 runs only"), (MIN_RUNS, "")])
def test_warning_gives_the_number_of_runs_below_the_minimum(leaf, count, text):
    runs = [replace(log, name=f"{log.name}, {seed}") for seed in (1, 2) for log in recorded(leaf, OFFSET, seed)]
    found = discover(runs[:count], leaf, settings=FEW)
    warnings = [warning for warning in found.warnings if "instead of whole runs" in warning]
    assert len(warnings) == bool(text) and all(warning.startswith(text) for warning in warnings)
    assert not text or any("tests have little power" in warning for warning in found.warnings)
    assert len(found.runs) == count and all(r.windows > 0 for r in found.runs)


@pytest.mark.slow
def test_driving_at_one_site_only_gives_a_warning(leaf, offset_runs, offset_result):
    two_sites = [*offset_runs[:2], replace(offset_runs[2], x=offset_runs[2].x + 2000.0)]
    for found, expected in ((offset_result[0], True), (discover(two_sites, leaf, settings=FEW), False)):
        assert any("all driving is at one site" in text for text in found.warnings) == expected


@pytest.mark.slow
def test_effect_with_a_value_at_its_bound_is_not_named(leaf):
    driven = ("lane_change", "slalom", "circle", "sweep", "step", "weave")
    logs = [replace(log, yaw_rate=1.4 * log.yaw_rate) for log in recorded(leaf, {}, 1, driven)]
    found = discover(logs, leaf, settings=replace(FEW, effects=("yaw_rate_scale",), channels=("yaw_rate", "position")))
    assert found.outcome == "unknown" and found.effects == ()
    (candidate,) = found.candidates
    assert candidate.verdict == "on a bound" and "its value is at a bound" in candidate.reason
    assert candidate.parameters["factor"] == pytest.approx(1.25)


@pytest.mark.slow
def test_short_run_is_left_out_with_a_warning(leaf):
    runs = recorded(leaf, {}, 1)
    short = replace(runs[0].slice(runs[0].start_ns, runs[0].start_ns + 4_000_000_000), name="stub")
    found = discover([short, *runs[1:]], leaf, settings=FEW)
    assert any("run stub: not used, INS and steering overlap" in text for text in found.warnings)
    assert [r.name for r in found.runs] == ["slalom 2", "circle 3"]


def test_discovery_without_a_run_that_is_long_enough_is_rejected(leaf):
    short = [log.slice(0, 2_000_000_000) for log in recorded(leaf, {}, 8, ("step",))]
    for runs in (short, []):
        with pytest.raises(StCoreError, match="no run is long enough: a run needs 7 s of driving"):
            discover(runs, leaf, settings=FEW)


def test_effects_cannot_be_fitted_without_drives(leaf):
    with pytest.raises(StCoreError, match="drives: none given; at least one is needed"):
        fit_effects([], leaf, "linear", ("steering_ratio",))


def test_two_runs_with_the_same_name_are_rejected(leaf):
    (run,) = recorded(leaf, {}, 9, ("step",))
    for call in (lambda runs: discover(runs, leaf, "linear"), lambda runs: fit_effects(runs, leaf, "linear", ())):
        with pytest.raises(StCoreError, match="duplicate name; give each drive once"):
            call([run, run])


@pytest.mark.parametrize(("base", "names", "reason"), [
    ("linear", ("steering_ration",), "unknown effect 'steering_ration', did you mean steering_ratio"),
    ("kinematic", "friction", "effects: friction does not apply to this base model"),
])
def test_effect_that_cannot_be_fitted_is_rejected(leaf, base, names, reason):
    with pytest.raises(ConfigurationError, match=reason):
        fit_effects([], leaf, base, names)


def test_run_at_standstill_is_rejected(leaf):
    log = recorded(leaf, {}, 9, ("step",))[0]
    stationary = replace(log, velocity_x=0.0 * log.velocity_x)
    with pytest.raises(StCoreError, match=r"drive longer, faster than 1\.5 m/s"):
        discover([stationary], leaf, settings=FEW)
    with pytest.raises(StCoreError, match=r"drive longer, faster than 1\.5 m/s"):
        discover([stationary, replace(stationary, name="2")], leaf, settings=SETTINGS,
                 clocks={log.name: 0.02, "2": 0.02})


def test_run_within_one_block_is_rejected(leaf):
    """Several predictions, but no other block to hold out: no effect could be significant."""
    log = recorded(leaf, {}, 9, ("step",))[0]
    log = log.slice(log.start_ns, log.start_ns + 12_000_000_000)
    assert len(Windows([log], leaf, SETTINGS)) > 3
    with pytest.raises(StCoreError, match=r"fewer than two blocks of 10 s contain a prediction of 5 s: drive longer"):
        discover([log], leaf, settings=SETTINGS)


@pytest.mark.parametrize(("effects", "message"), [(("steering_lagg",), "steering_lag"),
                                                  (("tyre_slip",), "does not apply")])
def test_unknown_or_inapplicable_effect_is_rejected(effects, message):
    with pytest.raises(StCoreError, match=message):
        Space("nonlinear", replace(SETTINGS, effects=effects))


def test_effect_whose_channel_is_not_selected_is_rejected():
    settings = replace(SETTINGS, effects=("lateral_acceleration_bias",), channels=("yaw_rate",))
    with pytest.raises(ConfigurationError, match="none is usable with this base model"):
        Space("nonlinear", settings)


@pytest.mark.parametrize(("key", "value"), [("channels", ("sideslip",)), ("channels", ()), ("horizon", 0.1),
                                            ("horizon", 20.0), ("windows", 3), ("block", 0.0)])
def test_error_of_a_setting_out_of_range_contains_the_key(key, value):
    with pytest.raises(ConfigurationError, match=key):
        DiscoverySettings(**{key: value})
