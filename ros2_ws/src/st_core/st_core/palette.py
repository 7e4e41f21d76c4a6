"""Colour and line style of each model in all figures, distinguishable by colour-blind readers and in greyscale."""

from typing import Any

MODEL_COLOUR = {"kinematic": "#1f77b4", "linear": "#ff7f0e", "nonlinear": "#7e2f8e", "augmented": "#009e73"}
MODEL_LINE = {"kinematic": (0, (6, 2)), "linear": "solid", "nonlinear": (0, (2, 1)), "augmented": (0, (6, 1, 1, 1))}
MEASURED_COLOUR = "#7f7f7f"
OTHER_COLOUR = "#d55e00"  # any other model
# Time after the start at which the path of a model is labelled [s]; these differ so that the labels do not overlap.
LABEL_TIMES = {"kinematic": 5.0, "linear": 4.3, "nonlinear": 3.6, "augmented": 2.9}
OTHER_LABEL_TIME = 2.2
# Settings of matplotlib (rcParams) for all figures.
FIGURE_STYLE: dict[Any, Any] = {
    "figure.dpi": 100,
    "savefig.dpi": 160,
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


def get_model_colour(model: str) -> str:
    return MODEL_COLOUR.get(model, OTHER_COLOUR)


def rgb(colour: str, strength: float = 1.0) -> tuple[int, int, int]:
    """Red, green, blue (0 to 255) of "#rrggbb", mixed with white if strength < 1."""
    red, green, blue = (round(255 - strength * (255 - int(colour[i:i + 2], 16))) for i in (1, 3, 5))
    return red, green, blue


def get_label_index(model: str, step: float, points: int) -> int:
    """Index of the point at which the path of a model is labelled. points: number of points, `step` [s] apart."""
    return min(round(LABEL_TIMES.get(model, OTHER_LABEL_TIME) / step), points - 1)
