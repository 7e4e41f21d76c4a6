"""One look for every figure and table: the colour of each model, and matplotlib settings for print."""

from .palette import MEASURED_COLOUR, MODEL_COLOUR

__all__ = ["MEASURED_COLOUR", "MODEL_COLOUR", "MODEL_LINE", "RC"]

MODEL_LINE = {"kinematic": (0, (6, 2)), "linear": "solid", "nonlinear": (0, (2, 1)), "augmented": (0, (6, 1, 1, 1))}

RC = {
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
