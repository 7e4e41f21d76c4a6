"""Single-track vehicle models, prediction and evaluation. Pure Python: no ROS, no clock, no files in the equations.

The paper cited in docstrings: Aertssen et al., Short-Horizon Position Accuracy of Single-Track Models, AVEC 2026."""

__version__ = "0.2.0"
