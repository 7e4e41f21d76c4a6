"""Requirements on an effect: built-in effects meet them all, and each violation is detected."""

import numpy as np
import pytest
from effect_registry import restored
from st_core import contract
from st_core.contract import REQUIREMENTS, check_effect
from st_core.effects import EFFECTS, Effect, Parameter, load_file, register
from st_core.errors import ConfigurationError

QUICK = ("steering_lag", "road_bank", "yaw_rate_bias", "tyre_slip")
NAMES = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in sorted(EFFECTS)]
GAIN = Parameter("gain", "1", null=0.0, initial=1.0, bounds=(0.0, 2.0), source="theory: 1", meaning="share")


registry = pytest.fixture(autouse=True)(restored)


def find_violations(effect, leaf) -> dict[str, str]:
    return {text: problem for text, problem in check_effect(effect, leaf).items() if problem}


def register_effect(parameter=GAIN, **hooks):
    texts = {"name": "trial", "physics": "y = gain u", "excited_by": "driving", "kind": "physics", "slot": "body",
             "applies_to": frozenset(("linear",)), "parameters": (parameter,)}
    return register(type("Trial", (Effect,), texts | {k: staticmethod(f) for k, f in hooks.items()}))


@pytest.mark.parametrize("name", NAMES)
def test_built_in_effect_meets_every_requirement(leaf, name):
    assert find_violations(EFFECTS[name], leaf) == {}


def yaw_acceleration(equation):
    """Hook `acceleration` with equation(gain, r, v_x) -> yaw acceleration [rad/s^2]."""
    return lambda instant, prepared, theta: (
        0.0 * instant.yaw_rate, 0.0 * instant.yaw_rate, equation(theta.gain, instant.yaw_rate, instant.velocity_x))


@pytest.mark.parametrize(("equation", "requirement", "message"), [
    (lambda gain, r, v_x: (1e-9 + gain) * r, "null values leave predictions bit-identical", "must be bit-identical"),
    (lambda gain, r, v_x: 0.0 * r, "initial values change a prediction", "change nothing"),
    (lambda gain, r, v_x: -gain * r / v_x, "predictions are finite", "division by zero"),
    (lambda gain, r, v_x: gain * np.float32(r), "results are equal", "numpy"),
    (lambda gain, r, v_x: 0.1 * gain + 0.0 * r, "left and right are mirror images", "odd=True"),
    (lambda gain, r, v_x: 20.0 * gain * r, "it does not make the car unstable", "has a growth rate of"),
    (lambda gain, r, v_x: -99.0 * gain * r, "it does not make the car unstable", "too fast for steps"),
], ids=["null", "no change", "standstill", "backends", "mirror", "growing mode", "fast mode"])
def test_violated_requirement_is_named(leaf, monkeypatch, equation, requirement, message):
    key = next(text for text in REQUIREMENTS if text.startswith(requirement))
    monkeypatch.setattr(contract, "REQUIREMENTS", {key: REQUIREMENTS[key]})  # saves compiling kernels six times
    assert message in check_effect(register_effect(acceleration=yaw_acceleration(equation)), leaf)[key]


def test_parameter_declared_odd_violates_nothing(leaf):
    push = Parameter("gain", "rad/s^2", null=0.0, initial=0.1, bounds=(-1.0, 1.0), source="theory", meaning="left +",
                     odd=True)
    effect = register_effect(push, acceleration=yaw_acceleration(lambda gain, r, v_x: gain + 0.0 * r))
    assert find_violations(effect, leaf) == {}


def test_correct_that_does_not_invert_observe_is_named(leaf):
    def scale_yaw_rate(measured, theta):
        return measured._replace(yaw_rate=measured.yaw_rate * (1.0 + theta.gain))

    found = find_violations(register_effect(observe=scale_yaw_rate, correct=scale_yaw_rate), leaf)
    assert list(found) == ["correct() inverts observe()"]


def test_load_file_loads_only_that_file(tmp_path, leaf):
    (tmp_path / "broken.py").write_text("import nothing_of_this_name\n")
    (tmp_path / "good.py").write_text('''
from st_core.effects import Effect, Parameter, register


@register
class Good(Effect):
    name = "good"
    physics = "r_dot = -gain r"
    excited_by = "turning"
    kind, slot = "physics", "body"
    applies_to = frozenset(("linear",))
    parameters = (Parameter("gain", "1/s", null=0.0, initial=0.5, bounds=(0.0, 5.0), meaning="damping", source="t"),)

    @staticmethod
    def acceleration(instant, prepared, theta):
        return 0.0 * instant.yaw_rate, 0.0 * instant.yaw_rate, -theta.gain * instant.yaw_rate
''')
    effect, = load_file(str(tmp_path), "good")
    assert find_violations(effect, leaf) == {
        "the effect or its file has a docstring": "no docstring; write one with the equation, units and signs"}
    with pytest.raises(ConfigurationError, match=r"broken.py: cannot be loaded"):
        load_file(str(tmp_path), "broken")
