"""Registration of effects: validation, and user effects loaded from a folder."""

import textwrap
from dataclasses import replace

import numpy as np
import pytest
from batched import predict_batch
from effect_registry import restored
from st_core import effects
from st_core.augmented import augment
from st_core.effects import EFFECTS, Effect, Parameter, find_confounded_effects, get_effect, load_folder, register
from st_core.errors import ConfigurationError, StCoreError
from st_core.prediction import predict
from st_core.types import ControlInput, InputSequence, VehicleState

GAIN = Parameter("gain", "1", null=0.0, initial=1.0, bounds=(0.0, 2.0), source="theory: 1", meaning="share")
STATE = VehicleState(0.0, 0.0, 12.0, 0.0, 0.0, 0.1)

MAPPED_BANK = '''
    """Gravity along body y on a banked road, the bank from a map: a_y = -gain g sin(bank)."""

    from st_core.effects import Effect, Parameter, register
    from st_core.ops import sin
    from st_core.tyres import GRAVITY


    @register
    class MappedBank(Effect):
        name = "{name}"
        physics = "a_y = -gain g sin(bank_angle)"
        excited_by = "a road whose bank is known"
        kind, slot = "environment", "body"
        signals = ("bank_angle",)
        parameters = (
            Parameter("gain", "1", null=0.0, initial=1.0, bounds=(0.0, 2.0), meaning="share", source="theory: 1"),
        )

        @staticmethod
        def acceleration(instant, prepared, theta):
            a_y = -theta.gain * GRAVITY * sin(prepared[0])
            return 0.0 * a_y, a_y, 0.0 * a_y
'''


registry = pytest.fixture(autouse=True)(restored)


def write(folder, file, text):
    (folder / file).write_text(textwrap.dedent(text))


def make_effect(**attributes):
    body = {"name": "trial", "physics": "it does something", "excited_by": "driving of any kind", "kind": "physics",
            "slot": "body", "parameters": (GAIN,),
            "inputs": staticmethod(lambda angle, acceleration, signals, theta: (angle, acceleration))}
    return type("Trial", (Effect,), {k: v for k, v in {**body, **attributes}.items() if v is not None})


def test_complete_effect_is_registered():
    assert register(make_effect()) is get_effect("trial")


def test_kind_of_earlier_versions_has_its_new_name():
    assert register(make_effect(kind="surroundings")).kind == "environment"


def test_effect_without_a_name_and_a_tuple_has_the_name_of_its_file_and_one_parameter():
    effect = register(make_effect(name=None, parameters=None, parameter=GAIN))
    assert effect is get_effect("test_effects_registry") and effect.parameters == (GAIN,)


@pytest.mark.parametrize(("attributes", "message"), [
    ({"name": "Trial Effect"}, "must be a subclass of Effect with a name"),
    ({"name": "friction"}, r"effect friction: already registered by .*friction\.py"),
    ({"axle_force": staticmethod(len)}, "effect trial: unknown attribute axle_force, did you mean axle_forces?"),
    ({"twins": ("road_bank",)}, "unknown attribute twins: remove it, or look for its new name in CHANGELOG.md"),
    ({"acceleration": lambda instant, prepared, theta: (0.0, 0.0, 0.0)},
     "effect trial: acceleration must be a @staticmethod"),
    ({"physics": ""}, "effect trial: physics is missing"),
    ({"kind": None}, "effect trial: kind is missing; choose one of sensors, vehicle param.*, environment"),
    ({"kind": "sensor"}, "effect trial: kind 'sensor' is not one of sensors, vehicle parameters, physics, envi"),
    ({"slot": None}, "effect trial: slot is missing; choose one of steering, front axle, .*, acceleration"),
    ({"slot": "front"}, "effect trial: slot 'front' is not one of steering"),
    ({"needs": "yaw"}, "effect trial: needs must be a tuple of names"),
    ({"needs": ("velocity_x",)}, "effect trial: needs may only name velocity_y, yaw_rate, .*, position"),
    ({"members": ("friction",)}, "effect trial: members must name two or more other effects"),
    ({"members": ("trial", "friction")}, "effect trial: members must name two or more other effects"),
    ({"inputs": None, "fold": staticmethod(lambda vehicle, theta: vehicle)}, "it has no hook"),
    ({"parameters": GAIN}, "effect trial: parameters must be a tuple; declare one parameter by parameter ="),
    ({"parameters": ()}, "effect trial: it has no parameter that can be fitted"),
    ({"parameters": (GAIN, GAIN)}, "a name is used twice"),
    ({"applies_to": frozenset(("bicycle",))}, "applies_to must name one or more of kinematic, linear, nonlinear"),
    ({"extra_states": ("z",)}, "extra_states and rates must be declared together"),
    ({"prepared": ("z",)}, "prepare and prepared, the names of its results"),
    ({"correct": staticmethod(lambda measured, theta: measured)}, "correct is the inverse of observe, which"),
    ({"inputs": None}, "it has no hook"),
])
def test_incomplete_effect_is_rejected(attributes, message):
    before = set(EFFECTS)
    with pytest.raises(ConfigurationError, match=message):
        register(make_effect(**attributes))
    assert set(EFFECTS) == before


@pytest.mark.parametrize(("change", "message"), [
    ({"null": 3.0}, "null is outside the bounds"), ({"initial": -1.0}, "initial is outside the bounds"),
    ({"theory": 3.0}, "theory is outside the bounds"), ({"initial": 0.0}, "initial equals null"),
    ({"bounds": (1.0, 0.0)}, "not finite and increasing"),
    ({"bounds": (0.0, np.inf)}, "not finite and increasing"), ({"source": " "}, "source is empty"),
    ({"unit": ""}, "unit is empty"),
])
def test_contradictory_parameter_is_rejected(change, message):
    with pytest.raises(ConfigurationError, match=message):
        replace(GAIN, **change)


def test_unknown_name_suggests_the_nearest():
    with pytest.raises(ConfigurationError, match=r"unknown effect 'frction', did you mean friction\?"):
        get_effect("frction")


def test_effects_of_a_folder_are_loaded_and_predict(tmp_path, leaf):
    write(tmp_path, "mapped_bank.py", MAPPED_BANK.format(name="mapped_bank"))
    write(tmp_path, "_helper.py", "raise RuntimeError('helpers are not imported unless asked for')")
    assert load_folder(tmp_path) == ("mapped_bank",)
    assert load_folder(tmp_path) == ("mapped_bank",)  # not loaded a second time
    assert effects.find_source_file(get_effect("mapped_bank")) == str(tmp_path / "mapped_bank.py")
    model = augment("linear", ["mapped_bank"])
    assert model.signals == ("bank_angle",)
    bank = np.full(201, 0.03)
    zero = np.zeros(201)
    path = predict(model, leaf, STATE, InputSequence(zero, zero, {"bank_angle": bank}))
    constant = predict(augment("linear", {"road_bank": {"angle": 0.03}}), leaf, STATE, ControlInput(0.0, 0.0))
    np.testing.assert_allclose(path.states, constant.states, rtol=1e-13, atol=1e-13)
    batch = predict_batch(model, leaf, np.array([STATE.as_tuple()] * 2), np.zeros(2), np.zeros(2),
                          signals={"bank_angle": np.array([0.03, 0.0])})
    np.testing.assert_allclose(batch[0], path.states, rtol=1e-12, atol=1e-12)
    assert np.abs(batch[1] - batch[0]).max() > 0.1
    for inputs in (ControlInput(0.0, 0.0), InputSequence(zero, zero)):
        with pytest.raises(StCoreError, match="needs the signal bank_angle"):
            predict(model, leaf, STATE, inputs)


def test_modules_of_a_folder_can_share_a_helper(tmp_path):
    write(tmp_path, "_common.py", "NAME = 'shared_bank'")
    text = MAPPED_BANK.replace('"{name}"', "NAME")
    text = text.replace("from st_core.ops", "from ._common import NAME\n    from st_core.ops")
    write(tmp_path, "first.py", text)
    assert load_folder(tmp_path) == ("shared_bank",)


@pytest.mark.parametrize(("files", "message"), [
    ({}, "contains no effect"),
    ({"a.py": "import no_such_module"}, r"a\.py: cannot be loaded: ModuleNotFoundError: .*no_such_module"),
    ({"a.py": "def f(:"}, r"a\.py: cannot be loaded: SyntaxError"),
    ({"a.py": "x = 1"}, r"a\.py: registers no effect"),
    ({"a.py": MAPPED_BANK.format(name="friction")}, r"a\.py: effect friction: already registered"),
    ({"a.py": MAPPED_BANK.format(name="twice"), "b.py": MAPPED_BANK.format(name="twice")},
     r"b\.py: effect twice: already registered by .*a\.py"),
    ({"a.py": MAPPED_BANK.format(name="mine").replace("kind,", 'confounded_with = ("road_banc",)\n        kind,')},
     "effect mine: confounded_with: unknown effect road_banc, did you mean road_bank"),
])
def test_folder_that_does_not_load_raises_and_registers_nothing(tmp_path, files, message):
    before = set(EFFECTS)
    for file, text in files.items():
        write(tmp_path, file, text)
    for _ in range(2):  # a second attempt gives the same message
        with pytest.raises(ConfigurationError, match=message):
            load_folder(tmp_path)
        assert set(EFFECTS) == before


def test_confounded_effects_are_symmetric(tmp_path):
    """A user effect that names a built-in effect as confounded is listed for the built-in one too."""
    text = MAPPED_BANK.replace("kind, slot", 'confounded_with = ("road_bank",)\n        kind, slot')
    write(tmp_path, "a.py", text.format(name="mine"))
    assert "mine" not in find_confounded_effects("road_bank")
    load_folder(tmp_path)
    assert find_confounded_effects("mine") == {"road_bank"} and "mine" in find_confounded_effects("road_bank")
    assert "road_bank" not in find_confounded_effects("road_bank")


def test_missing_folder_is_rejected(tmp_path):
    with pytest.raises(ConfigurationError, match="nowhere: not a folder"):
        load_folder(tmp_path / "nowhere")
