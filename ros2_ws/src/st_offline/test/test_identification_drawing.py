"""Figures and terminal output of identification."""

import numpy as np
import pytest
from st_core.identification.result import Identification, ParameterEstimate
from st_core.vehicle import VehicleParameters
from st_offline.evaluation.drawing import FigureOutput
from st_offline.identification.driving import draw_prediction, draw_stiffness
from st_offline.identification.experiment import make_estimate_rows
from st_offline.identification.identify_command import print_results
from st_recordings.runs.errors import log_warnings
from support import LEAF


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


def test_stiffness_that_is_not_identified_is_marked_in_the_title(tmp_path):
    estimates = tuple(
        ParameterEstimate(f"cornering_stiffness_{axle}", 390e3, "N/rad", 65e3, (259e3, 521e3), "fit", ("a",), "",
                          status)
        for axle, status in (("front", "unidentifiable"), ("rear", "identified")))
    names = tuple(e.parameter for e in estimates)
    outcome = Identification("stiffness", estimates, ("a",), figure={"names": names, "covariance": np.eye(2) * 65e3**2})
    figure = draw_stiffness(outcome, FigureOutput(tmp_path, ("png",)))
    assert figure.title == ("Cornering stiffness front 390 ± 130 kN/rad (95 %, unidentifiable), rear 390 ± 130 kN/rad "
                            "(95 %) by prediction")
    vehicle = VehicleParameters.from_yaml(LEAF.read_text().replace("value: 70000.0", "value: 130000.0"))
    rows = make_estimate_rows(outcome, vehicle)
    assert rows[0][5] == "130000"


def test_warning_that_was_logged_is_not_printed_again(capsys):
    text = "drive_7.csv: 3 of 90 rows are not used"
    log_warnings([text])
    outcome = Identification("steering", (), ("a",), warnings=(text, "mass is exact"))
    print_results((outcome,), VehicleParameters.from_yaml(LEAF.read_text()), [])
    output = capsys.readouterr().out
    assert "mass is exact" in output and "drive_7.csv" not in output
