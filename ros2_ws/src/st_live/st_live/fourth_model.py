"""A model file beside the three models of the paper: read and checked before a node starts."""

from pathlib import Path

from st_core.effects import load_folder
from st_core.errors import StCoreError
from st_core.model_file import ModelFile
from st_core.models import MODELS, Model
from st_core.vehicle import VehicleParameters
from st_recordings.car import read_vehicle

from .suite import Parameters, SuiteError


def fourth_model(model: Path | None, effects: Path | None, vehicle: Path) -> Parameters:
    """Parameters of predictor and evaluator for a model file; nothing without one.

    effects: folder of own effects the file uses. Raises SuiteError, StCoreError and RunError, one line, for a file that
    is no model, or one that was found with another car than the vehicle file.
    """
    if model is None and effects is None:
        return {}
    known_model(model, effects, read_vehicle(vehicle), str(vehicle))
    assert model is not None  # or effects would have been too much
    chosen = {"model_file": str(model.absolute()), "effects_directory": str(effects.absolute()) if effects else ""}
    return {"predictor": chosen, "evaluator": chosen}


def known_model(model: Path | None, effects: Path | None, car: VehicleParameters, origin: str) -> Model:
    """The model of a model file, nonlinear without one; effects: folder of own effects it uses.

    origin: of the car. Raises SuiteError and StCoreError, one line, for a file that is no model or was found with
    another car, and for effects that nothing uses.
    """
    if model is None:
        if effects is not None:
            raise SuiteError(f"--effects {effects}: only a --model uses effects; give one")
        return MODELS["nonlinear"]
    try:
        if effects is not None:
            load_folder(str(effects.absolute()))
        file = ModelFile.from_yaml(model.read_text(encoding="utf-8"), str(model))
    except (OSError, UnicodeDecodeError) as error:
        raise SuiteError(f"{model}: cannot be read: {error}") from None
    try:
        file.check_vehicle(car, origin)
    except StCoreError as error:
        raise SuiteError(f"{model}: {error}") from None
    return file.model()
