"""The single-track models by name: kinematic, linear, nonlinear; one file each."""

from ..errors import ConfigurationError
from . import kinematic, linear_tyre, nonlinear_tyre
from ._base import Model, motion, slip_angles

MODELS: dict[str, Model] = {m.name: m for m in (kinematic.MODEL, linear_tyre.MODEL, nonlinear_tyre.MODEL)}
TYRE_MODELS = tuple(name for name, model in MODELS.items() if model.has_tyres)


def get_model(model: str | Model) -> Model:
    """The model with this name (a Model is returned unchanged). Raises ConfigurationError listing the known names."""
    if isinstance(model, Model):
        return model
    if model not in MODELS:
        raise ConfigurationError(f"unknown model {model!r}; known: {', '.join(MODELS)}")
    return MODELS[model]


__all__ = ["MODELS", "TYRE_MODELS", "Model", "get_model", "motion", "slip_angles"]
