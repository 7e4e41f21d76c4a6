"""Requirements on an effect: the library meets them all, and each violation is detected."""


import numpy as np
import pytest
from effect_registry import restored
from st_core.contract import REQUIREMENTS, check_effect
from st_core.effects import DYNAMIC, EFFECTS, Effect, Parameter, load_file, register
from st_core.errors import ConfigurationError

QUICK = ("steering_lag", "road_bank", "yaw_rate_bias", "tyre_slip")
NAMES = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in sorted(EFFECTS)]
GAIN = Parameter("gain", "1", null=0.0, initial=1.0, bounds=(0.0, 2.0), source="theory: 1", meaning="share")


registry = pytest.fixture(autouse=True)(restored)


def broken(effect, leaf) -> dict[str, str]:
    return {text: problem for text, problem in check_effect(effect, leaf).items() if problem}


def made(parameter=GAIN, **hooks):
    texts = {"name": "tried", "physics": "y = gain u", "excited_by": "driving", "kind": "physics", "slot": "body",
             "applies_to": DYNAMIC, "parameters": (parameter,)}
    return register(type("Tried", (Effect,), texts | {k: staticmethod(f) for k, f in hooks.items()}))


@pytest.mark.parametrize("name", NAMES)
def test_the_library_meets_every_requirement(leaf, name):
    assert broken(EFFECTS[name], leaf) == {}


def of(acceleration):
    return lambda instant, prepared, theta: (
        0.0 * instant.yaw_rate, 0.0 * instant.yaw_rate, acceleration(instant, theta))


@pytest.mark.parametrize(("acceleration", "requirement", "words"), [
    (lambda at, t: (1e-9 + t.gain) * at.yaw_rate, "at null it changes nothing", "to the last bit"),
    (lambda at, t: 0.0 * at.yaw_rate, "at its initial values it changes something", "it changes nothing"),
    (lambda at, t: -t.gain * at.yaw_rate / at.velocity_x, "finite at its bounds", "division by zero"),
    (lambda at, t: t.gain * np.float32(at.yaw_rate), "equal on floats", "numpy"),
    (lambda at, t: 0.1 * t.gain + 0.0 * at.yaw_rate, "left and right are mirror images", "odd=True"),
    (lambda at, t: 20.0 * t.gain * at.yaw_rate, "it does not make the car unstable", "grows at"),
    (lambda at, t: -99.0 * t.gain * at.yaw_rate, "it does not make the car unstable", "too fast for steps"),
])
def test_a_violated_requirement_is_named(leaf, acceleration, requirement, words):
    found = broken(made(acceleration=of(acceleration)), leaf)
    kept = next(what for what in REQUIREMENTS if what.startswith(requirement))
    assert words in found[kept]


def test_a_declared_sign_is_no_violation(leaf):
    push = Parameter("gain", "rad/s^2", null=0.0, initial=0.1, bounds=(-1.0, 1.0), source="theory", meaning="left +",
                     odd=True)
    assert broken(made(push, acceleration=of(lambda at, t: t.gain + 0.0 * at.yaw_rate)), leaf) == {}


def test_a_sensor_that_is_not_undone(leaf):
    def shown(measured, theta):
        return measured._replace(yaw_rate=measured.yaw_rate * (1.0 + theta.gain))

    found = broken(made(observe=shown, correct=shown), leaf)
    assert list(found) == ["correct() inverts observe()"]


def test_one_file_of_a_folder_is_loaded_and_the_others_are_left_alone(tmp_path, leaf):
    (tmp_path / "broken.py").write_text("import nothing_of_this_name\n")
    (tmp_path / "good.py").write_text('''
from st_core.effects import Effect, Parameter, register


@register
class Good(Effect):
    name = "good"
    physics = "r_dot = -gain r"
    excited_by = "turning"
    kind, slot = "physics", "body"
    parameters = (Parameter("gain", "1/s", null=0.0, initial=0.5, bounds=(0.0, 5.0), meaning="damping", source="t"),)

    @staticmethod
    def acceleration(instant, prepared, theta):
        return 0.0 * instant.yaw_rate, 0.0 * instant.yaw_rate, -theta.gain * instant.yaw_rate
''')
    effect, = load_file(str(tmp_path), "good")
    assert broken(effect, leaf) == {"the equation is written in the file": "no docstring; write one with the equation, "
                                    "units and signs"}
    with pytest.raises(ConfigurationError, match=r"broken.py: cannot be loaded"):
        load_file(str(tmp_path), "broken")
