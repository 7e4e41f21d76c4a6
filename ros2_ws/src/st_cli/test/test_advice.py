"""st evaluate --advise: the cheapest model and step within a tolerance."""

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
from command_line import st
from drives import weave, write_drive, write_vehicle
from rich.console import Console
from st_core.bands import ErrorSamples
from st_core.log_evaluation import EvaluationSettings
from st_core.prediction import PredictionSettings
from st_offline.evaluation.advice import (
    COST_KINDS,
    make_advice_rows,
    make_choice_rows,
    measure_accuracy,
    split_rows,
    vary_step,
)
from st_offline.terminal import make_table
from support import LEAF

SETTINGS = EvaluationSettings()
TIME = 0.05 * np.arange(1, 101)


def make_error_samples(count: int, size: float) -> list[ErrorSamples]:
    """Samples of `count` runs: normal errors with a standard deviation of `size` [m] at 5 s, proportional to time.

    Half of the starts are at 7 m/s, half at 13 m/s with errors four times as large.
    """
    samples = []
    for k in range(count):
        rng = np.random.default_rng([5, k])
        speed = np.repeat([7.0, 13.0], 100)
        conditions = np.stack([speed, *rng.uniform(0.1, 1.0, (3, 200))], axis=1)
        errors = rng.standard_normal((200, 1, 3)) * (TIME / 5.0)[:, None] * size
        errors[speed > 10.0] *= 4.0
        samples.append(ErrorSamples(f"run {k}", conditions, {("linear", "hindsight"): errors.astype(np.float32)}))
    return samples


def test_error_quantile_is_per_speed_bin_and_increases_with_time():
    accuracy = measure_accuracy(make_error_samples(10, 0.5), "linear", SETTINGS)
    assert accuracy.seconds == (1, 2, 3, 4, 5) and accuracy.level == 0.9
    assert set(accuracy.error_quantiles) == {6.0, 12.0}
    # 90 % of normal errors have a magnitude below 1.645 standard deviations. Both speeds pooled, the standard deviation
    # is sqrt((1 + 16) / 2) times the smaller one.
    assert accuracy.error_quantiles[6.0][4] == pytest.approx(1.645 * 0.5, rel=0.15)
    assert accuracy.error_quantiles[12.0][4] == pytest.approx(4.0 * 1.645 * 0.5, rel=0.15)
    assert accuracy.rms[4] == pytest.approx(0.5 * np.sqrt(8.5), rel=0.15)
    assert all(np.diff(values).min() >= 0.0 for values in accuracy.error_quantiles.values())
    # The band covers three axes and both speeds simultaneously: it is wider than the quantile of one axis.
    assert accuracy.half_widths[4] > 1.645 * 0.5 * 2.5


@pytest.mark.parametrize(("count", "level"), [(2, None), (3, 0.5), (8, 0.5), (9, 0.9)])
def test_band_level_is_limited_by_number_of_runs(count, level):
    accuracy = measure_accuracy(make_error_samples(count, 0.5), "linear", SETTINGS)
    assert accuracy.level == level and (accuracy.half_widths is None) == (level is None)


def test_cheapest_configuration_within_tolerance_is_chosen_or_none():
    good, bad = (measure_accuracy(make_error_samples(2, size), "linear", SETTINGS) for size in (0.1, 1.0))
    costs = {("slow", 0.05): {"interpreted": 9e-4, "compiled": 9e-5, "batch": 1e-5},
             ("quick", 0.1): {"interpreted": 1e-4, "compiled": 1e-5, "batch": 1e-6},
             ("floats", 0.1): {"interpreted": 2e-3, "batch": 1e-6}}  # the most expensive, because it is not compiled
    accuracies = {("slow", 0.05): good, ("quick", 0.1): bad, ("floats", 0.1): good}
    rows = make_choice_rows(costs, accuracies, 0.5)
    assert rows[0] == {"speed": "6 to 9 m/s", "1 s": "quick, 0.1 s", **{f"{k} s": "slow, 0.05 s" for k in range(2, 6)}}
    assert rows[1]["5 s"] == "none"


def test_costs_are_relative_to_the_lowest_and_missing_values_are_dashes():
    costs = {("a", 0.05): {"interpreted": 3e-4, "batch": 2e-5},
             ("b", 0.05): {"interpreted": 1e-4, "compiled": 1e-5, "batch": 1e-5}}
    accuracy = measure_accuracy(make_error_samples(1, 0.1), "linear", SETTINGS)
    first, second = make_advice_rows(costs, {("b", 0.05): accuracy})
    assert (first["interpreted, µs (x)"], first["compiled, µs (x)"], first["error 5 s, m"]) == ("300 (3.0)", "-", "-")
    assert second["batch, µs (x)"] == "10 (1.0)" and second["band 5 s, m"] == "-"


def test_title_states_why_there_are_no_bands():
    costs = {("linear", 0.05): dict.fromkeys(COST_KINDS, 1e-4)}
    two_runs = {("linear", 0.05): measure_accuracy(make_error_samples(2, 0.1), "linear", SETTINGS)}
    for accuracies, reason in ((two_runs, "(no bands: fewer than 3 runs)"), ({}, "(none could be measured)")):
        _, title = split_rows(make_advice_rows(costs, accuracies), accuracies)
        assert title == f"Lateral RMS error with measured inputs, m {reason}"


def test_tables_of_advice_fit_into_80_columns():
    console = Console(width=80, record=True, file=io.StringIO())
    costs = {("nonlinear", 0.025): dict.fromkeys(COST_KINDS, 1.23e-2),
             ("kinematic", 0.05): dict.fromkeys(COST_KINDS, 1e-4)}
    accuracies = {("nonlinear", 0.025): measure_accuracy(make_error_samples(4, 0.1), "linear", SETTINGS)}
    for title, rows in split_rows(make_advice_rows(costs, accuracies), accuracies).items():
        console.print(make_table(rows, title))
    lines = [" ".join(line.split()) for line in console.export_text().splitlines()]
    assert "model step, s interpreted compiled batch" in lines and "model step, s 1 s 2 s 3 s 4 s 5 s" in lines
    assert "nonlinear 0.025 12300 (123.0) 12300 (123.0) 12300 (123.0)" in lines


def test_only_steps_that_divide_one_second_and_the_horizon_are_tried():
    assert list(vary_step(SETTINGS)) == [0.05, 0.1, 0.2]
    odd = replace(SETTINGS, prediction=PredictionSettings(horizon=5.0, step=0.25))
    assert list(vary_step(odd)) == [0.25, 0.5, 1.0]
    short = replace(SETTINGS, prediction=PredictionSettings(horizon=0.5, step=0.05))
    assert list(vary_step(short)) == [0.05, 0.1]


@pytest.mark.slow
def test_evaluate_writes_advice_table(tmp_path):
    for k in range(2):
        write_drive(tmp_path / "runs" / f"weave_{k}.csv", weave(14.0, 7.0 + 0.2 * k, 0.02))
    write_vehicle(tmp_path / "car.yaml", LEAF)
    result = st("evaluate", tmp_path / "runs", "--vehicle", tmp_path / "car.yaml", "--model", "kinematic", "--model",
                "linear", "--advise", "0.5", "--figures", "", "--output", tmp_path / "o", columns=240)
    assert result.exit_code == 0, result.output
    assert "step with a lateral error within 0.5 m" in result.output and "6 to 9 m/s" in result.output
    with (tmp_path / "o" / "advice.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["model"], row["step, s"]) for row in rows] == [
        (model, step) for model in ("kinematic", "linear") for step in ("0.05", "0.1", "0.2")]
    assert all(float(row["error 5 s, m"]) > 0.0 for row in rows)
    assert all(float(row[f"{kind}, µs"]) > 0.0 for kind in COST_KINDS if f"{kind}, µs" in rows[0] for row in rows)
    assert not any("(" in cell or cell == "-" for row in rows for cell in (*row, *row.values()))


def test_zero_tolerance_is_rejected(tmp_path):
    write_drive(tmp_path / "long.csv", weave(16.0))
    result = st("evaluate", tmp_path / "long.csv", "--advise", "0")
    assert result.exit_code == 2 and "--advise" in result.output
