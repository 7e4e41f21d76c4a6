"""st evaluate --advise: the cheapest model and step within a tolerance."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from drives import weave, write_drive, write_vehicle
from st_cli.cli import app
from st_core.bands import ErrorSamples
from st_core.log_evaluation import EvaluationSettings
from st_core.prediction import PredictionSettings
from st_offline.evaluation.advice import (
    Cost,
    find_cheapest,
    get_processor_time,
    make_advice_rows,
    make_choice_rows,
    measure_accuracy,
    vary_step,
)
from support import ROOT
from typer.testing import CliRunner

SETTINGS = EvaluationSettings()
TIME = 0.05 * np.arange(1, 101)


def runs(count: int, size: float) -> list[ErrorSamples]:
    """Random errors across that grow to `size` at 5 s; half of the starts at 7 m/s, half at 13, four times larger."""
    found = []
    for k in range(count):
        draw = np.random.default_rng([5, k])
        speed = np.repeat([7.0, 13.0], 100)
        conditions = np.stack([speed, *draw.uniform(0.1, 1.0, (3, 200))], axis=1)
        errors = draw.standard_normal((200, 1, 3)) * (TIME / 5.0)[:, None] * size
        errors[speed > 10.0] *= 4.0
        found.append(ErrorSamples(f"run {k}", conditions, {("linear", "hindsight"): errors.astype(np.float32)}))
    return found


def test_the_error_that_most_starts_stay_below_is_by_speed_and_never_falls_with_time():
    found = measure_accuracy(runs(10, 0.5), "linear", SETTINGS)
    assert found.second == (1, 2, 3, 4, 5) and found.level == 0.9
    assert set(found.within) == {6.0, 12.0}
    # 90 % of a normal error lie below 1.645 of its deviation; both speeds pooled: sqrt((1 + 16) / 2) of it.
    assert found.within[6.0][4] == pytest.approx(1.645 * 0.5, rel=0.15)
    assert found.within[12.0][4] == pytest.approx(4.0 * 1.645 * 0.5, rel=0.15)
    assert found.rms[4] == pytest.approx(0.5 * np.sqrt(8.5), rel=0.15)
    assert all(np.diff(values).min() >= 0.0 for values in found.within.values())
    # Three axes at once, both speeds: wider than one point of one axis asks for.
    assert found.width[4] > 1.645 * 0.5 * 2.5


@pytest.mark.parametrize(("count", "level"), [(1, None), (2, None), (3, 0.5), (8, 0.5), (9, 0.9)])
def test_the_band_is_the_one_that_so_many_runs_can_promise(count, level):
    found = measure_accuracy(runs(count, 0.5), "linear", SETTINGS)
    assert found.level == level and (found.width is None) == (level is None)


def test_the_cheapest_that_is_good_enough_is_chosen_and_none_where_none_is():
    good, bad = (measure_accuracy(runs(2, size), "linear", SETTINGS) for size in (0.1, 1.0))
    costs = {("slow", 0.05): Cost(9e-4, 9e-5, 1e-5), ("quick", 0.1): Cost(1e-4, 1e-5, 1e-6),
             ("floats", 0.1): Cost(2e-3, None, 1e-6)}
    assert get_processor_time(costs["floats", 0.1]) == 2e-3
    accuracies = {("slow", 0.05): good, ("quick", 0.1): bad, ("floats", 0.1): good}
    chosen = find_cheapest(costs, accuracies, 0.5)
    assert chosen[6.0] == (("quick", 0.1), *[("slow", 0.05)] * 4)
    assert chosen[12.0][4] is None
    shown = make_choice_rows(chosen)
    assert shown[0] == {"speed": "6 to 9 m/s", "1 s": "quick, 0.1 s", **{f"{k} s": "slow, 0.05 s" for k in range(2, 6)}}
    assert shown[1]["5 s"] == "none"


def test_costs_stand_beside_the_least_and_what_failed_is_a_dash():
    costs = {("a", 0.05): Cost(3e-4, None, 2e-5), ("b", 0.05): Cost(1e-4, 1e-5, 1e-5)}
    first, second = make_advice_rows(costs, {("b", 0.05): measure_accuracy(runs(1, 0.1), "linear", SETTINGS)})
    assert (first["floats, µs (x)"], first["compiled, µs (x)"], first["error 5 s, m"]) == ("300 (3.0)", "-", "-")
    assert second["batch, µs (x)"] == "10 (1.0)" and second["band 5 s, m"] == "-"


def test_only_steps_that_divide_a_second_and_the_horizon_are_tried():
    assert [one.prediction.step for one in vary_step(SETTINGS)] == [0.05, 0.1, 0.2]
    odd = replace(SETTINGS, prediction=PredictionSettings(horizon=5.0, step=0.25))
    assert [one.prediction.step for one in vary_step(odd)] == [0.25, 0.5, 1.0]
    short = replace(SETTINGS, prediction=PredictionSettings(horizon=0.5, step=0.05))
    assert [one.prediction.step for one in vary_step(short)] == [0.05, 0.1]


def test_evaluate_advises(tmp_path):
    for k in range(2):
        write_drive(tmp_path / "runs" / f"weave_{k}.csv", weave(24.0, 7.0 + 0.2 * k, 0.02))
    write_vehicle(tmp_path / "car.yaml", ROOT / "config" / "vehicle" / "leaf.yaml")
    words = ["evaluate", tmp_path / "runs", "--vehicle", tmp_path / "car.yaml", "--model", "kinematic", "--model",
             "linear", "--advise", "0.5", "--figures", "", "--output", tmp_path / "o"]
    result = CliRunner().invoke(app, list(map(str, words)), env={"COLUMNS": "240"})
    assert result.exit_code == 0, result.output
    assert "step with a lateral error within 0.5 m" in result.output and "6 to 9 m/s" in result.output
    with (tmp_path / "o" / "advice.csv").open(newline="", encoding="utf-8") as stream:
        found = list(csv.DictReader(stream))
    assert [(row["model"], row["step, s"]) for row in found] == [
        (model, step) for model in ("kinematic", "linear") for step in ("0.05", "0.1", "0.2")]
    assert all(float(row["error 5 s, m"]) > 0.0 for row in found)


def test_a_tolerance_of_zero_is_refused(tmp_path):
    write_drive(tmp_path / "long.csv", weave(16.0))
    result = CliRunner().invoke(app, ["evaluate", str(tmp_path / "long.csv"), "--advise", "0"])
    assert result.exit_code == 2 and "--advise" in result.output
