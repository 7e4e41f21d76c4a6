"""Bands for a live run or a replay: read and checked before a node starts."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from st_core.bands import Bands
from st_core.errors import StCoreError
from st_core.log_evaluation import EvaluationSettings
from st_core.model_file import ModelFile
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters

from .suite import Parameters, SuiteError


def with_bands(suite: Parameters, bands: Path | None) -> dict[str, dict[str, Any]]:
    """Parameters of the nodes, as the suite has them, with those bands around every prediction; as they are without.

    Raises SuiteError, one line, for a file that is none, or that holds for another car, model or configuration than the
    predictor is to be started with.
    """
    parameters = {node: {**values} for node, values in suite.items()}
    if bands is None:
        return parameters
    predictor = parameters["predictor"]
    try:
        file = Bands.from_yaml(bands.read_text(encoding="utf-8"), str(bands))
        vehicle = Path(predictor["vehicle_file"])
        car = VehicleParameters.from_yaml(vehicle.read_text(encoding="utf-8"), str(vehicle))
    except (OSError, UnicodeDecodeError) as error:
        raise SuiteError(f"--bands {bands}: cannot be read: {error}") from None
    except StCoreError as error:
        raise SuiteError(f"--bands {error}") from None
    settings = {name: predictor[name] for name in PredictionSettings.__dataclass_fields__ if name in predictor}
    try:
        file.check(car, _models(predictor), EvaluationSettings(PredictionSettings(**settings)))
    except StCoreError as error:
        raise SuiteError(f"--bands {bands}: {error}") from None
    recorder = parameters["recorder"]
    files = [*recorder["configuration_files"], str(bands.absolute())]
    return parameters | {"predictor": predictor | {"bands_file": str(bands.absolute())},
                         "recorder": recorder | {"configuration_files": files}}


def _models(predictor: Mapping[str, Any]) -> dict[str, str]:
    """Hash of the model file by model, "" for one of the paper's."""
    found = dict.fromkeys(predictor["models"], "")
    if name := predictor.get("model_file"):
        file = ModelFile.from_yaml(Path(name).read_text(encoding="utf-8"), name)
        found[file.model().name] = file.hash
    return found
