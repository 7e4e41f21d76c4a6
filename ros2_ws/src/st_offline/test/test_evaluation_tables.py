"""Tables of errors: best values, rounding, LaTeX, CSV; and pooling of runs."""

import csv
import io

import numpy as np
import pytest
from rich.console import Console
from st_core.checks import Finding, Severity
from st_core.clock_types import Alignment
from st_core.log_evaluation import MODES, ModelErrors
from st_core.vehicle import VehicleParameters
from st_offline.evaluation import tables
from st_offline.evaluation.evaluation_command import make_summary, pool_bins
from st_offline.evaluation.work import RunReport, Task, to_file_name
from st_recordings.runs.run_types import summarise_alignment
from support import LEAF


def make_errors(mean: np.ndarray, seed: int = 0) -> ModelErrors:
    """Errors whose means over a horizon are the rows of `mean`, with random samples; NaN rows are incomplete."""
    rng = np.random.default_rng(seed)
    samples = mean[:, None, :] + rng.normal(0.0, 0.3, (len(mean), 101, 3))
    samples += (mean - samples.mean(axis=1))[:, None]
    complete = np.isfinite(mean).all(axis=1)
    profile = np.full((101, 3), np.nan)
    return ModelErrors(complete, samples.mean(axis=1), np.square(samples).mean(axis=1), np.abs(samples).max(axis=1),
                       samples[:, 20::20], profile)


def make_statistics(longitudinal, lateral) -> dict:
    """Statistics of one model: (mean, max, rmse) of each axis."""
    axes = {axis: dict(zip(tables.STATISTICS, v, strict=True)) for axis, v in
            (("longitudinal", longitudinal), ("lateral", lateral), ("yaw", (0.0, 0.0, 0.0)))}
    one = {"n_starts": 7, "n_incomplete": 1, **axes, "samples": {"n_starts": 7, **axes}}
    return dict.fromkeys(MODES, one)


PAPER_S1 = {  # the first row of the paper's table
    "kinematic": make_statistics((0.10, 0.19, 0.12), (-0.09, 0.49, 0.33)),
    "linear": make_statistics((0.02, 0.07, 0.04), (-0.06, 0.26, 0.13)),
    "nonlinear": make_statistics((0.01, 0.07, 0.04), (-0.06, 0.26, 0.13)),
}


def make_report(name: str, models: dict) -> RunReport:
    return RunReport(name, models=models)


def test_latex_row_equals_that_of_the_paper():
    text = tables.make_latex_table([make_report("S$_1$", PAPER_S1)], "means", "Leaf_ZE0, 100 %.")
    rows = [line for line in text.splitlines() if line.endswith(r"\\") and "m$_" in line]
    assert rows == [
        r"\multirow[c]{3}{*}{S\$\_1\$} & m$_{1}$ & $\phantom{-}0.10 \mid 0.19 \mid 0.12$ & "
        r"$-0.09 \mid 0.49 \mid 0.33$ \\",
        r"& m$_{2}$ & $\phantom{-}0.02 \mid \mathbf{0.07} \mid \mathbf{0.04}$ & "
        r"$\mathbf{-0.06} \mid \mathbf{0.26} \mid \mathbf{0.13}$ \\",
        r"& m$_{3}$ & $\phantom{-}\mathbf{0.01} \mid \mathbf{0.07} \mid \mathbf{0.04}$ & "
        r"$\mathbf{-0.06} \mid \mathbf{0.26} \mid \mathbf{0.13}$ \\",
    ]
    assert r"Leaf\_ZE0, 100 \%." in text and text.count(r"\begin{") == text.count(r"\end{")


def test_best_value_is_chosen_by_printed_magnitude_and_may_be_shared():
    models = {"a": make_statistics((0.004, 1.0, 1.0), (0.0, 1.0, 1.0)),
              "b": make_statistics((-0.0049, 1.0, 2.0), (0.006, 1.0, 1.0))}
    best = {(model, axis): [is_best for _, is_best in tables.list_statistics(models, model, axis, "means")]
            for model in models for axis in ("longitudinal", "lateral")}
    assert best == {("a", "longitudinal"): [True, True, True], ("b", "longitudinal"): [True, True, False],
                    ("a", "lateral"): [True, True, True], ("b", "lateral"): [False, True, True]}


@pytest.mark.parametrize(("value", "text"), [(-0.004, "0.00"), (-0.006, "-0.01"), (None, "-"), (12.346, "12.35")])
def test_errors_are_printed_to_the_centimetre(value, text):
    assert tables.format_error(value) == text


def test_summary_lists_only_faults_that_bias_predictions():
    car = VehicleParameters.from_yaml(LEAF.read_text())
    metadata = {"duration": 60.0, "alignment": summarise_alignment(Alignment())}
    accelerometer = Finding("acceleration_y_bias", Severity.WARNING, ("acceleration_y",), "acceleration_y is too low")
    jumps = Finding("position_jumps", Severity.WARNING, ("x", "y"), "positions jump", effect=0.3)
    texts = [make_summary([RunReport("drive", metadata=metadata, models=PAPER_S1, findings=findings)], Task(car, {}))[1]
             for findings in ((accelerometer,), (accelerometer, jumps))]
    assert texts == ["The checks found nothing that biases these errors.",
                     "Faults in the recordings bias these errors: position_jumps in drive (shifts the position after "
                     "5 s by about 0.3 m)."]


def test_terminal_table_has_every_run_and_escapes_names():
    console = Console(width=110, record=True, file=io.StringIO())
    models = {"kinematic": make_statistics((0.1, 0.2, 0.3), (1, 2, 3)),
              "linear": make_statistics((None,) * 3, (None,) * 3)}
    console.print(tables.make_terminal_table([make_report("[red]day[/red]", models)], "samples", "A [b]title[/b]", 110))
    text = console.export_text()
    assert "[red]day[/red]" in text and "A [b]title[/b]" in text
    assert " 1.00 |  2.00 |  3.00" in text and "- |     - |     -" in text


def test_csv_has_one_row_per_run_model_and_mode(tmp_path):
    file = tmp_path / "table.csv"
    tables.write_csv(file, tables.make_csv_rows([make_report("S1", PAPER_S1), make_report("S,2", PAPER_S1)])["table"])
    rows = list(csv.DictReader(file.open()))
    assert len(rows) == 2 * 3 * 2 and {r["run"] for r in rows} == {"S1", "S,2"}
    assert float(rows[0]["lateral_rmse_m"]) == 0.33 and rows[0]["n_starts"] == "7"
    assert {r["mode"] for r in rows} == set(MODES)


def test_statistics_include_selected_complete_horizons_only():
    mean = np.array([[1.0, -2.0, 0.1], [3.0, 0.0, 0.1], [np.nan] * 3, [100.0, 0.0, 0.0]])
    found = tables.summarise_errors(make_errors(mean), np.array([True, True, True, False]))
    assert (found["n_starts"], found["n_incomplete"]) == (2, 1)
    assert found["longitudinal"] == pytest.approx({"mean": 2.0, "max": 3.0, "rmse": np.sqrt(5.0)})
    assert found["samples"]["longitudinal"]["mean"] == pytest.approx(2.0)
    assert found["samples"]["longitudinal"]["rmse"] > found["longitudinal"]["rmse"]
    nothing = tables.summarise_errors(make_errors(mean), np.zeros(4, bool))
    assert nothing["n_starts"] == 0 and nothing["lateral"] == {"mean": None, "max": None, "rmse": None}


def test_pooled_runs_equal_a_single_run():
    rng = np.random.default_rng(3)
    whole = make_errors(rng.normal(0.2, 1.0, (90, 3)))
    parts = [np.arange(90) < 20, (np.arange(90) >= 20) & (np.arange(90) < 75), np.arange(90) >= 75]
    documents = [{"linear": dict.fromkeys(MODES, tables.summarise_errors(whole, part))} for part in parts]
    empty = {"linear": dict.fromkeys(MODES, tables.summarise_errors(whole, np.zeros(90, bool)))}
    joined = tables.pool_models([*documents, empty])["linear"]["forecast"]
    expected = tables.summarise_errors(whole)
    assert joined["n_starts"] == 90
    for axis in ("longitudinal", "lateral", "yaw"):
        assert joined[axis] == pytest.approx(expected[axis])
        assert joined["samples"][axis] == pytest.approx(expected["samples"][axis])


def test_pooled_bins_are_ordered_by_quantity_and_value():
    def one(quantity, label, low):
        return {"quantity": quantity, "label": label, "low": low, "high": None, "models": PAPER_S1}

    first = RunReport("a", bins=[one("speed", "6 to 9", 6.0), one("direction", "right", None)])
    second = RunReport("b", bins=[one("speed", "3 to 6", 3.0), one("speed", "6 to 9", 6.0),
                                  one("direction", "left", 0.1), one("direction", "straight", -0.1)])
    found = [(e["label"], e["count"]) for e in pool_bins([first, second])]
    assert found == [("3 to 6", 1), ("6 to 9", 2), ("left", 1), ("straight", 1), ("right", 1)]


@pytest.mark.parametrize(("name", "file"), [("S6", "S6"), ("a/b c", "a_b_c"), ("../x", "_x"), ("", "run")])
def test_run_names_become_safe_file_names(name, file):
    assert to_file_name(name) == file
