"""Single-track vehicle models, prediction and evaluation. Pure Python: no ROS, no clock, no files in the equations."""

__version__ = "0.2.0"
