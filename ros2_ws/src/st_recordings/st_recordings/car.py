"""Loads the description of a car from its folder: vehicle file, CAN bus, and sign and delay of the steering sensor."""

from dataclasses import dataclass
from pathlib import Path

from canedge_bridge.yaml_reader import read_text
from st_core.errors import ConfigurationError
from st_core.model_file import ModelFile
from st_core.models import MODELS, Model, get_model
from st_core.vehicle import VehicleParameters

from .paths import config
from .runs.errors import RunError
from .runs.run_file import read_yaml_mapping

STEERING_DEFAULTS = {"steering_sign": 1, "steering_latency": 0.0}
"""Keys of car.yaml and their defaults; the latency is in seconds."""
STABILITY_SPEEDS = tuple(0.5 * k for k in range(1, 81))
"""Speeds [m/s] at which the numerical integration of the models must be stable."""


@dataclass(frozen=True)
class Car:
    """The folder of a car, and the sign and delay of its steering angle sensor.

    steering_sign: +1 if the decoded angle is positive to the left, else -1. steering_latency: delay from the motion of
    the steering wheel to the stamp of its CAN frame [s]. The files dbc and signals are optional.
    """

    folder: Path
    steering_sign: int
    steering_latency: float

    @property
    def vehicle(self) -> Path:
        return self.folder / "vehicle.yaml"

    @property
    def dbc(self) -> Path:
        return self.folder / "can.dbc"

    @property
    def signals(self) -> Path:
        return self.folder / "signals.yaml"


def load_car(name: str | Path) -> Car:
    """Loads a car by the name of its folder in config/car, or by the path of any folder. car.yaml is optional.

    Raises RunError for a file, for a folder that does not exist or has no vehicle file, and for a car.yaml with
    keys other than steering_sign (1 or -1) and steering_latency (0 to 1 s), or other values.
    """
    folder = Path(name) if "/" in str(name) or Path(name).is_dir() else config("car") / name
    if folder.is_file():
        parent = folder.absolute().parent
        alternative = f"--car {parent}, or " if (parent / "vehicle.yaml").is_file() else ""
        raise RunError(folder, "this is a file; a car is a folder",
                       f"give {alternative}--vehicle for a vehicle file alone")
    if not (folder / "vehicle.yaml").is_file():
        problem = "not a car folder: it contains no vehicle.yaml" if folder.is_dir() else "this car does not exist"
        raise RunError(folder, problem, f"known cars are {', '.join(list_cars())}; or name the folder of a car")
    file = folder / "car.yaml"
    table = read_yaml_mapping(file) if file.exists() else {}
    if unknown := sorted(table.keys() - STEERING_DEFAULTS.keys()):
        raise RunError(file, f"{', '.join(unknown)}: unknown", f"known keys are {', '.join(STEERING_DEFAULTS)}")
    values = STEERING_DEFAULTS | table
    if isinstance(values["steering_sign"], bool) or values["steering_sign"] not in (1, -1):
        raise RunError(file, f"steering_sign: {values['steering_sign']!r} is neither 1 nor -1")
    latency = values["steering_latency"]
    if isinstance(latency, bool) or not isinstance(latency, int | float) or not 0.0 <= latency <= 1.0:
        raise RunError(file, f"steering_latency: {latency!r} is not a number from 0 to 1 s")
    return Car(folder, int(values["steering_sign"]), float(latency))


def list_cars() -> list[str]:
    """The names of the cars in config/car."""
    return sorted(path.parent.name for path in config("car").glob("*/vehicle.yaml"))


def read_vehicle(file: Path) -> VehicleParameters:
    """Reads a vehicle file. Raises ConfigurationError if it cannot be read or is invalid."""
    return VehicleParameters.from_yaml(read_text(file), str(file))


def read_model(name: str, vehicle: VehicleParameters, origin: str,
               vehicle_is_given: bool = True) -> tuple[Model, VehicleParameters]:
    """(model with this name or from this model file, its vehicle: the one in the model file, else `vehicle`).

    origin: source of `vehicle`, for error messages. vehicle_is_given: whether the user named `vehicle`. Raises
    ConfigurationError for an unknown or invalid model, a model of a different car, or an unreadable file.
    """
    if not name.endswith((".yaml", ".yml")):
        if name not in MODELS:
            raise ConfigurationError(f"{name}: unknown model; use {', '.join(MODELS)} or a model file (.yaml)")
        return get_model(name), vehicle
    file = read_model_file(name)
    if vehicle_is_given or file.vehicle is None:
        file.check_vehicle(vehicle, origin, f"{name}: ")
    return file.model(), file.vehicle or vehicle


def read_model_file(name: str) -> ModelFile:
    """Reads a model file. Raises ConfigurationError if it cannot be read or is invalid."""
    return ModelFile.from_yaml(read_text(name), name)
