"""What the figures of one run share: what they are made from, the starts they show, their legend."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from st_core.log_evaluation import LogEvaluation
from st_core.log_signals import LogSignals
from st_core.models import Model
from st_core.palette import MODEL_COLOUR, MODEL_LINE
from st_core.vehicle import VehicleParameters

from .drawing import TEXT, Place


@dataclass(frozen=True)
class Drawing:
    """What the figures of a run are made from, and where they go. starts: times [s] to look at closely."""

    evaluation: LogEvaluation
    models: Sequence[Model]
    vehicle: VehicleParameters
    signals: LogSignals
    starts: Sequence[float]
    place: Place

    @property
    def name(self) -> str:
        return self.evaluation.name

    def colour(self, model: str) -> str:
        return MODEL_COLOUR.get(model, TEXT)

    def line(self, model: str) -> dict[str, Any]:
        """How matplotlib draws the line of a model."""
        return {"color": self.colour(model), "ls": MODEL_LINE.get(model, "solid")}


def complete_in_all(evaluation: LogEvaluation) -> np.ndarray:
    """Which starts every model completed in hindsight."""
    return np.all([e.complete for (_, mode), e in evaluation.errors.items() if mode == "hindsight"], axis=0)


def chosen_starts(evaluation: LogEvaluation, wanted: Sequence[float], count: int = 4) -> np.ndarray:
    """Rows of the complete starts nearest to the wanted times [s], or `count` of them spread over the run."""
    complete = np.flatnonzero(complete_in_all(evaluation))
    if not len(complete):
        return complete
    if wanted:
        rows = [complete[np.abs(evaluation.time[complete] - t).argmin()] for t in wanted]
    else:
        # Not the very first and last: they say least about the drive.
        rows = complete[np.linspace(0, len(complete) - 1, count + 2).round().astype(int)[1:-1]]
    return np.unique(rows)


def legend(figure: plt.Figure, drawing: Drawing, extra: Sequence[Line2D], solid: bool = False,
           models: Sequence[Model] | None = None) -> None:
    """Below the figure: the models, and what else it shows. solid: whether all models are drawn as whole lines."""
    handles = [Line2D([], [], **drawing.line(m.name) | ({"ls": "solid"} if solid else {}), label=m.name)
               for m in (drawing.models if models is None else models)]
    figure.legend(handles=[*handles, *extra], loc="outside lower left", ncols=6)
