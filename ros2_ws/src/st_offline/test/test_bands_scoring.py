"""Scores of bands, for bands without a 90 % level too, and their figure."""

import numpy as np
from st_core.bands.calibration import RELIABILITY_LEVELS, Band
from st_offline.bands.bands_report import draw_bands, make_band_rows, sum_band_scores, summarise_bands
from st_offline.evaluation.drawing import FigureOutput

TIME = np.array([0.5, 1.0])


class ConstantScale:
    """A scale of 0.2 m, 0.3 m and 0.01 rad at two times, under all conditions."""

    time = TIME

    def __call__(self, conditions):
        return np.broadcast_to([0.2, 0.3, 0.01], (len(conditions), len(TIME), 3))


def test_bands_are_scored_at_their_highest_level():
    conditions = np.column_stack([np.full(400, 10.0), np.zeros((400, 3))])  # 10 m/s, straight
    errors = 0.1 * np.random.default_rng(2).standard_normal((400, len(TIME), 3)) * ConstantScale()(conditions)
    band = Band(ConstantScale(), {0.5: 0.2, 0.8: 0.4}, np.ones((3, len(RELIABILITY_LEVELS))))
    sums = sum_band_scores(band, conditions, errors)
    content = summarise_bands({"models": {"linear": {"hindsight": {**sums, "without_band": 0}}}})
    (row,) = make_band_rows(content)
    assert "80 % band" in row and "90 % band" not in row and row["worst cell"] != "-"
    assert content["models"]["linear"]["hindsight"]["worst_cell"]["starts"] == 400


def test_figure_names_a_coverage_of_zero_as_the_largest_deviation():
    score = {"starts": 10, "coverage": {"0.9": 0.8}, "reliability": {"0.9": 0.8}}
    content = {"models": {"linear": {"hindsight": score, "forecast": score | {"coverage": {"0.9": 0.0}}}}}
    (figure,) = draw_bands(content, FigureOutput(None, (), ""))
    assert "coverage furthest from 90 %: 0 %, linear, forecast" in figure.title
