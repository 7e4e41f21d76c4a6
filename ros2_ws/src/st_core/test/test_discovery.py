"""Discovery on drives that the models drive themselves, noise added: the arithmetic, not the difficulty of real cars.

A plant of its own, the sealed cases and raw files are in bench/discovery and st_offline/test.
"""

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.discovery import DiscoverySettings, choice, discover, gap, several
from st_core.discovery.choice import unsure
from st_core.discovery.floor import noisier
from st_core.discovery.manoeuvres import CATALOGUE, drive
from st_core.discovery.study import Study
from st_core.effects import EFFECTS, load_folder
from st_core.errors import ConfigurationError, StCoreError
from st_core.log import DriveLog

HEALTHY = {"steered_drive_force": {"share": 1.0}, "steering_lag": {"time_constant": 0.03},
           "tyre_relaxation": {"length": 0.3}}
DRIVEN = ("sweep", "brake_in_turn", "step")
NOISE = {"x": 0.003, "y": 0.003, "yaw": 0.0003, "velocity_x": 0.003, "velocity_y": 0.005, "yaw_rate": 0.002,
         "acceleration_y": 0.06}


def recorded(leaf, effects, seed: int, names=DRIVEN, base: str = "nonlinear", noise: float = 1.0) -> list[DriveLog]:
    """Drives of a car that is the model with these effects, as sensors with noise record them."""
    rng = np.random.default_rng(seed)
    model = augment(base, effects)
    logs = []
    for name in names:
        log = drive(next(m for m in CATALOGUE if m.name == name), model, leaf)
        noisy = {key: getattr(log, key) + noise * size * rng.standard_normal(len(log.x)) for key, size in NOISE.items()}
        logs.append(replace(log, **noisy))
    return logs


@cache
def reference(leaf) -> tuple[DriveLog, ...]:
    """Each manoeuvre twice: a run that is like no other tells how a manoeuvre looks that was never driven before."""
    return (*recorded(leaf, HEALTHY, 1), *recorded(leaf, HEALTHY, 11))


def settings(**others) -> DiscoverySettings:
    return DiscoverySettings(where=False, **others)


@pytest.mark.slow
def test_healthy_car_gives_none(leaf):
    found = discover(recorded(leaf, HEALTHY, 2), leaf, reference=reference(leaf), settings=settings())
    assert found.outcome == "none"
    assert found.effects == ()
    assert found.model is None
    assert found.p > 0.01
    assert {"drag", "grade"} <= {n.name for n in found.not_testable}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "parameter", "change"), [
    ("steering_lag", "time_constant", 0.05),
    ("rear_stiffness", "factor", -0.12),
    ("road_bank", "angle", 0.015),
])
def test_hidden_effect_is_named_with_its_value(leaf, name, parameter, change):
    null = {"steering_lag": 0.0, "rear_stiffness": 1.0, "road_bank": 0.0}[name]
    before = HEALTHY.get(name, {}).get(parameter, null)
    runs = recorded(leaf, {**HEALTHY, name: {parameter: before + change}}, 3)
    found = discover(runs, leaf, reference=reference(leaf), settings=settings())
    assert found.outcome == "named"
    assert [e.name for e in found.effects] == [name]
    value = found.effects[0].parameters[parameter]
    assert value.interval[0] <= null + change <= value.interval[1]
    assert abs(value.value - null - change) < 0.2 * abs(change)
    gap = found.gap["yaw_rate"]
    assert gap.augmented < 0.8 * gap.base
    assert found.document()["effects"][0]["parameters"][parameter]["value"] == value.value


@pytest.mark.slow
def test_without_sideslip_nothing_of_it_is_used(leaf):
    effects = {**HEALTHY, "steering_ratio": {"factor": 1.06}}
    blind = [replace(log, velocity_y=0.0 * log.velocity_y) for log in recorded(leaf, effects, 4)]
    healthy = tuple(replace(log, velocity_y=0.0 * log.velocity_y) for log in reference(leaf))
    channels = ("yaw_rate", "acceleration_y", "yaw", "position")
    found = discover(blind, leaf, reference=healthy, settings=settings(channels=channels))
    assert "steering_ratio" in {n for e in found.effects for n in (e.name, *e.alternatives)}
    assert "sensor_lever_arm" not in {e.name for e in found.effects}


@pytest.mark.slow
@pytest.mark.parametrize("late_runs", [3, 1])
def test_each_run_must_show_what_is_stated(leaf, monkeypatch, late_runs):
    """A lag in one run only: the others, predicted with what it says, deny it."""
    late = recorded(leaf, {**HEALTHY, "steering_lag": {"time_constant": 0.12}}, 3)
    runs = [*late[:late_runs], *recorded(leaf, HEALTHY, 3)[late_runs:]]
    studies, excess = [], several.excess
    monkeypatch.setattr(several, "excess", lambda study, *others: (studies.append(study), excess(study, *others))[1])
    found = discover(runs, leaf, reference=reference(leaf), settings=settings())
    study = studies[0]
    assert study.floor.restless == 0.0
    assert gap.shrinks({}, study, study.fit(("steering_lag",))) == (late_runs == 3)
    assert [e.name for e in found.effects] == ["steering_lag"] * (late_runs == 3)


@pytest.mark.slow
@pytest.mark.parametrize("from_", [0.45, 0.0])
def test_an_effect_in_one_part_only_is_told_from_one_that_nothing_explains(leaf, monkeypatch, from_):
    """A lag from a moment on; and one that is there all the time, though the whole is held to be explained by nothing:
    both halves show it."""
    lagged = recorded(leaf, {**HEALTHY, "steering_lag": {"time_constant": 0.12}}, 3)
    runs = [replace(log, **{key: np.where(np.linspace(0.0, 1.0, len(log.x)) < from_, getattr(log, key),
                                          getattr(later, key)) for key in NOISE})
            for log, later in zip(recorded(leaf, HEALTHY, 3), lagged, strict=True)]
    unexplained, whole = several.unexplained, iter([from_ == 0.0])
    monkeypatch.setattr(several, "unexplained", lambda *others: next(whole, False) or unexplained(*others))
    found = discover(runs, leaf, reference=reference(leaf), settings=settings())
    assert found.outcome == ("named" if from_ else "unknown")
    assert [e.name for e in found.effects] == ["steering_lag"] * (from_ > 0.0)
    assert any("in the later part of the runs only" in text for text in found.warnings) == (from_ > 0.0)


@pytest.mark.slow
def test_two_effects_are_both_found(leaf):
    effects = {**HEALTHY, "steering_offset": {"angle": 0.006}, "yaw_inertia": {"factor": 1.25}}
    found = discover(recorded(leaf, effects, 5), leaf, reference=reference(leaf), settings=settings())
    assert found.outcome == "several"
    assert {e.name for e in found.effects} == {"steering_offset", "yaw_inertia"}


@pytest.mark.slow
def test_a_part_in_which_the_car_stands_does_not_take_the_answer_away(leaf, monkeypatch):
    logs = recorded(leaf, {**HEALTHY, "steering_lag": {"time_constant": 0.12}}, 3)
    runs = [replace(log, velocity_x=np.where(np.linspace(0.0, 1.0, len(log.x)) < 0.4, 0.0, log.velocity_x))
            for log in logs]
    unexplained, whole = several.unexplained, iter([True])
    monkeypatch.setattr(several, "unexplained", lambda *others: next(whole, False) or unexplained(*others))
    found = discover(runs, leaf, reference=reference(leaf), settings=settings())
    assert [e.name for e in found.effects] == ["steering_lag"]
    assert any("in the later part of the runs only" in text for text in found.warnings)


@pytest.mark.slow
def test_three_changes_at_once_are_held_for_one_that_the_library_lacks(leaf):
    effects = {**HEALTHY, "steering_offset": {"angle": 0.01}, "yaw_inertia": {"factor": 1.3},
               "steering_lag": {"time_constant": 0.12}}
    found = discover(recorded(leaf, effects, 5), leaf, reference=reference(leaf), settings=settings())
    assert found.outcome == "unknown"
    assert found.model is None
    words, = (text for text in found.warnings if "likelier than so many at once" in text)
    assert {"steering_offset", "yaw_inertia", "steering_lag"} == set(words.split(" together")[0].split(", "))


@pytest.mark.slow
def test_kinematic_base_lacks_tyre_slip(leaf):
    runs = recorded(leaf, {"steered_drive_force": {"share": 1.0}}, 6, ("circle", "step"))
    found = discover(runs, leaf, "kinematic", settings=settings())
    assert [e.name for e in found.effects][:1] == ["tyre_slip"]
    assert any("no reference" in text for text in found.warnings)


@pytest.mark.slow
def test_linear_base_at_the_limit_lacks_saturation(leaf):
    car = {"steered_drive_force": {"share": 1.0}, "friction": {"factor": 0.85}}
    found = discover(recorded(leaf, car, 6, ("circle", "ramp_to_limit")), leaf, "linear", settings=settings())
    assert [e.name for e in found.effects] == ["tyre_saturation"]
    assert found.gap["position"].augmented < 0.6 * found.gap["position"].base


@pytest.mark.slow
def test_gentle_driving_cannot_show_friction(leaf):
    runs = [log.slice(0, 20_000_000_000) for log in recorded(leaf, HEALTHY, 7, ("lane_change", "lane_change"))]
    runs = [replace(log, name=f"{log.name} {i}") for i, log in enumerate(runs)]
    found = discover(runs, leaf, reference=reference(leaf), settings=settings())
    assert not found.effects
    assert {"friction", "combined_slip"} <= {n.name for n in found.not_testable}


def test_runs_too_short_are_refused_in_words(leaf):
    short = [log.slice(0, 2_000_000_000) for log in recorded(leaf, HEALTHY, 8, ("step",))]
    with pytest.raises(StCoreError, match="no run is long enough"):
        discover(short, leaf, settings=settings())


def test_car_that_stands_is_refused_in_words(leaf):
    log = recorded(leaf, HEALTHY, 9, ("step",))[0]
    standing = replace(log, velocity_x=0.0 * log.velocity_x)
    with pytest.raises(StCoreError, match="fast enough"):
        discover([standing], leaf, settings=settings())


def test_noise_of_the_runs_is_seen_whatever_they_drive(leaf):
    same = recorded(leaf, HEALTHY, 16, ("sweep", "lane_change"))
    more = recorded(leaf, HEALTHY, 17, ("circle", "brake_in_turn"), noise=1.5)
    assert noisier(same, reference(leaf)) == 1.0
    assert noisier(more, reference(leaf)) == pytest.approx(1.5**2, rel=0.1)
    assert noisier(recorded(leaf, HEALTHY, 18, ("step",), noise=9.0), reference(leaf)) == 4.0
    half = [replace(log, acceleration_x=None, **{name: getattr(log, name)[::2] for name in ("ins_time_ns", *NOISE)})
            for log in reference(leaf)]
    assert noisier(same, half) == 1.0 and noisier(half, same) == 1.0  # the rate is no noise


def test_twins_need_a_clearer_difference():
    assert unsure("steering_compliance", "front_stiffness") == unsure("front_stiffness", "steering_compliance") > 0.05
    assert unsure("crosswind", "combined_slip") == 0.02


@pytest.mark.slow
def test_reference_that_is_itself_faulty_is_doubted(leaf):
    faulty = {**HEALTHY, "steering_offset": {"angle": 0.025}}
    found = discover(recorded(leaf, HEALTHY, 12), leaf, reference=recorded(leaf, faulty, 11), settings=settings())
    assert any("steering_offset" in text and "is it healthy?" in text for text in found.warnings)
    assert [e.name for e in found.effects] == ["steering_offset"]
    assert found.effects[0].parameters["angle"].value == pytest.approx(-0.025, abs=0.002)


def test_log_with_nan_is_refused_in_words(leaf):
    log = recorded(leaf, HEALTHY, 9, ("step",))[0]
    holes = log.velocity_y.copy()
    holes[300:400] = np.nan
    with pytest.raises(StCoreError, match="step: velocity_y holds values that are not finite"):
        replace(log, velocity_y=holes)


@pytest.mark.slow
def test_base_that_diverges_is_said(leaf):
    base = augment("linear", {"rear_stiffness": {"factor": 0.3}})
    found = discover(recorded(leaf, HEALTHY, 14, ("step",)), leaf, base,
                     settings=settings(effects=("steering_lag", "steering_offset")))
    assert found.outcome == "unknown"
    assert any("the base model is lost in" in text for text in found.warnings)


def test_base_without_finite_predictions_is_refused_in_words(leaf, monkeypatch):
    log = recorded(leaf, HEALTHY, 15, ("step",))
    monkeypatch.setattr(sys.modules[discover.__module__], "row_errors",
                        lambda windows, *_: np.full((len(windows), 3), np.nan))
    with pytest.raises(StCoreError, match="no finite prediction for 100% of the windows"):
        discover(log, leaf, settings=settings())


@pytest.mark.parametrize(("beside", "outcomes"), [(np.inf, {"none"}), (-np.inf, {"unknown"})])
def test_a_gain_without_a_name_is_a_gap_only_when_it_stands_out(leaf, monkeypatch, beside, outcomes):
    monkeypatch.setattr(choice.Null, "threshold", lambda *_: 1e-9)
    monkeypatch.setattr(Study, "credible", lambda *_: False)
    monkeypatch.setattr(several, "SURELY", np.inf)
    monkeypatch.setattr(several, "UNKNOWN", beside)
    log, = recorded(leaf, {**HEALTHY, "steering_offset": {"angle": 0.01}}, 15, ("step",))
    found = discover([log.slice(log.start_ns, log.start_ns + 15_000_000_000)], leaf, settings=settings(
        effects=("steering_lag", "steering_offset"), maximum_effects=1))
    assert found.outcome in outcomes
    assert found.effects == ()
    assert found.model is None
    if found.outcome == "none":
        assert "chosen" not in {c.verdict for c in found.candidates}
        assert any("gains more" in text for text in found.warnings)


def test_unknown_effect_name_is_refused():
    with pytest.raises(ConfigurationError, match="steering_lag"):
        from st_core.discovery.space import Space
        Space("nonlinear", settings(effects=("steering_lagg",)))


@pytest.mark.parametrize(("key", "value"), [("channels", ("sideslip",)), ("channels", ()), ("horizon", 0.1),
                                            ("confidence", 1.0), ("maximum_effects", 0), ("resamples", 3)])
def test_settings_out_of_range_name_the_key(key, value):
    with pytest.raises(ConfigurationError, match=key):
        DiscoverySettings(**{key: value})


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
    def acceleration(at, given, theta):
        zero = 0.0 * at.yaw_rate
        return zero, zero, -theta.gain * at.yaw_rate * at.velocity_y * at.velocity_y
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
    theirs = {"steered_drive_force": {"share": 1.0}}
    known = recorded(leaf, theirs, 9)
    runs = recorded(leaf, {**theirs, "flywheel": {"gain": 5.0}}, 10)
    found = discover(runs, leaf, reference=known, settings=settings())
    assert found.outcome == "named"
    assert [e.name for e in found.effects] == ["flywheel"]
    gain = found.effects[0].parameters["gain"]
    assert gain.interval[0] <= 5.0 <= gain.interval[1]
