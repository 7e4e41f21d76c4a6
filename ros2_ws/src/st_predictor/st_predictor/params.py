"""Parameters of the nodes predictor, evaluator, recorder, markers and identifier, and the files they name."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import TypeVar

from st_core import errors as core_errors
from st_core.effects import load_folder
from st_core.model_file import ModelFile
from st_core.models import MODELS as MODELS_BY_NAME
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters
from st_ros.parameters import ConfigurationError, Parameter

T = TypeVar("T")

MODELS = list(MODELS_BY_NAME)
_DEFAULTS = PredictionSettings()

_VEHICLE_FILE = Parameter("vehicle_file", "", "vehicle parameters, a file of config/vehicle/; required")
_MODEL_FILE = Parameter("model_file", "", "model.yaml of an additional model, named augmented; empty: none")
_EFFECTS_DIRECTORY = Parameter("effects_directory", "", "folder of user-defined effects of model_file; empty: none")
_BANDS_FILE = Parameter("bands_file", "", "bands.yaml of st calibrate for this car, models and settings; empty: none")
_COURSE_FILE = Parameter("course_file", "", "course.yaml of st course build for this site; empty: none")
_ADAPTIVE = Parameter("adaptive_bands", True, "adapt the bands to the errors of this run; without bands_file the first "
                      "bands appear after two minutes of driving; false: only the bands of bands_file, unchanged")
_MAP_FRAME = Parameter("map_frame", "map", "required frame of the odometry; odometry in other frames is not used")
_MAXIMUM_GAP = Parameter(
    "maximum_gap", _DEFAULTS.maximum_gap, "longest interval between samples for interpolation", "s", 0.001, 10.0)
_FILTER_CUTOFF = Parameter(
    "filter_cutoff", _DEFAULTS.filter_cutoff, "low-pass cutoff before v_x is differentiated", "Hz", 0.01, 1000.0)

PREDICTOR = (
    _VEHICLE_FILE,
    Parameter("models", MODELS, "models to predict with, in this order"),
    _MODEL_FILE, _EFFECTS_DIRECTORY, _BANDS_FILE, _ADAPTIVE, _COURSE_FILE,
    Parameter("horizon", _DEFAULTS.horizon, "duration of a prediction; a whole number of steps", "s", 0.01, 60.0),
    Parameter("step", _DEFAULTS.step, "integration step and spacing of the published points", "s", 0.001, 1.0),
    Parameter("rate", 10.0, "ticks per second, on the node's clock; at each tick, every model predicts", "Hz", 0.1,
              100.0),
    Parameter("sample_wait", 0.015, "maximum time that a tick waits after its due time for a new sample of each "
              "input; at most half a period; not used in simulated time; 0: no wait", "s", 0.0, 0.1),
    Parameter("compiled", True, "models as machine code if numba is installed; false: interpreted Python"),
    Parameter("minimum_speed", _DEFAULTS.minimum_speed, "no prediction below this speed", "m/s", 0.0, 50.0),
    Parameter("stale_after", _DEFAULTS.stale_after, "no prediction from inputs older than this", "s", 0.001, 10.0),
    _MAXIMUM_GAP, _FILTER_CUTOFF, _MAP_FRAME,
    Parameter("plan_frame", "base_link", "required frame of plans on plan/inputs; plans in other frames are not used"),
)

_NUMBER_IF_EXISTS = Parameter(
    "number_if_exists", False, "record into NAME_2 if the directory contains files; false: stop")

EVALUATOR = (
    _VEHICLE_FILE,
    Parameter("models", MODELS, "models to score"),
    _MODEL_FILE, _EFFECTS_DIRECTORY, _MAXIMUM_GAP, _FILTER_CUTOFF, _MAP_FRAME,
    Parameter("output_directory", "", 'new or empty directory of the bag of errors; "": no bag'),
    _NUMBER_IF_EXISTS,
)

_COMMON_TOPICS = ["plan/inputs", "predictor/*", "evaluator/*", "identifier/*", "/tf", "/tf_static", "/diagnostics",
                  "/rosout"]
# Raw packets and frames, topics that cannot be derived from them, and topics that external viewers and tools expect.
TOPICS = ["ins/ncom", "ins/odometry", "ins/status", "ins/trigger", "ins/origin", "vehicle/steering", "can/frames",
          *_COMMON_TOPICS]
ALL_TOPICS = ["ins/*", "vehicle/*", "can/*", *_COMMON_TOPICS]
RECORDER = (
    Parameter("output_directory", "", "new or empty directory of the bag; required"),
    _NUMBER_IF_EXISTS,
    Parameter("topics", TOPICS, "topics to record; * is any text, ? any character; relative to the node's namespace"),
    Parameter("configuration_files", [], "files stored as text in the bag: vehicle, node parameters"),
    Parameter("metadata_json", "", 'further metadata of the bag: {"record": {"key": "text"}}'),
)

MARKERS = (
    _VEHICLE_FILE,
    Parameter("models", [*MODELS, "augmented"], "models whose predictions are drawn"),
    Parameter("rate", 10.0, "updates per second", "Hz", 0.1, 50.0),
    _MAP_FRAME,
)

IDENTIFIER = (_VEHICLE_FILE, _MAP_FRAME)


def load_vehicle(values: SimpleNamespace, parse: Callable[[str, str], VehicleParameters] = VehicleParameters.from_yaml,
                 ) -> VehicleParameters:
    """The vehicle of the parameter `vehicle_file`. Raises ConfigurationError if it is not set or cannot be used."""
    vehicle = read_file(values, "vehicle_file", parse)
    if vehicle is None:
        raise ConfigurationError(f"{values.message_prefix}vehicle_file: not set; give a file of config/vehicle/")
    return vehicle


def load_model(values: SimpleNamespace, vehicle: VehicleParameters) -> ModelFile | None:
    """The model in `model_file`, with the effects in `effects_directory`; None without a model file. Raises
    ConfigurationError naming the file and the key, also if the model belongs to a car other than `vehicle`."""
    if values.effects_directory:
        translate_errors(values, lambda: load_folder(values.effects_directory), "effects_directory: ")
    file = read_file(values, "model_file", ModelFile.from_yaml)
    if file is not None:
        prefix = f"model_file: {values.model_file}: "
        translate_errors(values, lambda: file.check_vehicle(vehicle, values.vehicle_file), prefix)
    return file


def read_file(values: SimpleNamespace, parameter: str, parse: Callable[[str, str], T]) -> T | None:
    """Parsed content of the file that a parameter names; None for an empty name. Raises ConfigurationError."""
    name = getattr(values, parameter)
    if not name:
        return None
    return translate_errors(values, lambda: parse(read_text(values, parameter, name), name), f"{parameter}: ")


def read_text(values: SimpleNamespace, parameter: str, name: str) -> str:
    """Text of a file that a parameter names. Raises ConfigurationError naming both."""
    try:
        return Path(name).read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not text in UTF-8"
        raise ConfigurationError(f"{values.message_prefix}{parameter}: {name}: {reason}") from None


def read_prediction_settings(values: SimpleNamespace) -> PredictionSettings:
    """Prediction settings from a node's parameters, else defaults. Raises ConfigurationError if inconsistent."""
    names = PredictionSettings.__dataclass_fields__.keys() & vars(values).keys()
    return translate_errors(values, lambda: PredictionSettings(**{name: getattr(values, name) for name in names}))


def translate_errors(values: SimpleNamespace, make: Callable[[], T], prefix: str = "") -> T:
    """Result of `make`; a ConfigurationError of st_core becomes one of st_ros, with `prefix`, for exit status 2."""
    try:
        return make()
    except core_errors.ConfigurationError as error:
        raise ConfigurationError(f"{values.message_prefix}{prefix}{error}") from None
