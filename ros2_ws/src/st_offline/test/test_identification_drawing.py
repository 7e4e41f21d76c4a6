"""Figures of identification."""

import numpy as np
import pytest
from st_core.identification.result import Identification, ParameterEstimate
from st_offline.evaluation.drawing import FigureOutput
from st_offline.identification.driving import draw_prediction


@pytest.mark.parametrize("channels", [["yaw_rate"], ["velocity_y", "yaw_rate"]])
def test_residuals_are_drawn_with_and_without_measured_sideslip(channels, tmp_path):
    estimates = tuple(ParameterEstimate(name, value, unit, 0.1 * value, (0.8 * value, 1.2 * value), "fit", ("a",), "",
                                        "identified")
                      for name, value, unit in (("steering_ratio", 16.0, "1"), ("steering_wheel_offset", 0.01, "rad")))
    figure = {"residuals": dict.fromkeys(channels, np.zeros(60)), "residual_run": np.repeat([0, 1], 30),
              "residual_time": np.tile(np.arange(30.0), 2), "names": ("steering_ratio", "steering_wheel_offset"),
              "covariance": np.diag([1.0, 1e-6])}
    outcome = Identification("steering", estimates, ("a",), figure=figure)
    draw_prediction(outcome, FigureOutput(tmp_path, ("png",)))
    assert (tmp_path / "steering.png").is_file()
