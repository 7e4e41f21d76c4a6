"""The command st evaluate on drives with known errors, and on invalid files."""

import hashlib
import json
import re

import pytest
from command_line import st
from drives import weave, write_drive, write_vehicle
from support import LEAF

MODES = ("forecast", "hindsight")
HOSTILE = "<script>alert(1)</script> & [bold]x"


def evaluate(*arguments):
    return st("evaluate", *arguments, columns=80)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    base = tmp_path_factory.mktemp("evaluate")
    write_drive(base / "data" / "weave.csv", weave())
    write_drive(base / "data" / f"{HOSTILE.replace('/', '-')}.csv", weave(8.0, 6.0))
    (base / "data" / "notes.odt").write_text("nothing")
    write_drive(base / "data" / "short.csv", weave(3.0))
    (base / "data" / "labels.run.yaml").write_text(
        "name: labelled\ncsv: weave.csv\nlabels: [{name: slalom, start: 1, end: 9}]\n")
    car = write_vehicle(base / "car.yaml", LEAF)
    result = evaluate(base / "data", base / "no such file", "--vehicle", car, "--output", base / "out")
    return base, result


@pytest.mark.slow
def test_unusable_runs_are_reported_and_the_others_evaluated(folder):
    base, result = folder
    assert result.exit_code == 1
    assert "no such file" in result.output and "the horizon of 5 s" in result.output
    assert "st calibrate RUN… --vehicle FILE --output bands.yaml" in " ".join(result.output.split())
    content = json.loads((base / "out" / "evaluation.json").read_text())
    assert set(content["failed"]) == {"short", "no such file"} and len(content["runs"]) == 2


def test_evaluation_json_schema(folder):
    base, _ = folder
    content = json.loads((base / "out" / "evaluation.json").read_text())
    assert content["schema"] == 3 and set(content["runs"]["labelled"]) == {"kinematic", "linear", "nonlinear"}
    for modes in content["runs"]["labelled"].values():
        assert set(modes) == set(MODES)
        for entry in modes.values():
            assert entry["n_starts"] == 89 and entry["n_incomplete"] == 50
            for part in (entry, entry["samples"]):
                for axis in ("longitudinal", "lateral"):
                    assert set(part[axis]) == {"mean", "max", "rmse"}
                    assert 0.0 <= part[axis]["rmse"] <= part[axis]["max"]
    files = content["about"]["labelled"]["provenance"]["files"]
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in files.values())


def test_kinematic_car_has_almost_no_error_of_the_kinematic_model(folder):
    base, _ = folder
    models = json.loads((base / "out" / "evaluation.json").read_text())["runs"]["labelled"]
    hindsight = {model: modes["hindsight"]["lateral"]["rmse"] for model, modes in models.items()}
    assert hindsight["kinematic"] < 0.005 and hindsight["linear"] > 0.1
    assert models["kinematic"]["forecast"]["lateral"]["rmse"] > 0.1  # the steering angle varies within the horizon


def test_labels_and_bins_count_their_starts(folder):
    base, _ = folder
    content = json.loads((base / "out" / "evaluation.json").read_text())
    (part,) = content["manoeuvres"]["labelled"]
    assert (part["name"], part["models"]["linear"]["hindsight"]["n_starts"]) == ("slalom", 64)
    counts = {}
    for one in content["bins"]["labelled"]:
        entry = one["models"]["kinematic"]["hindsight"]
        counts[one["quantity"]] = counts.get(one["quantity"], 0) + entry["n_starts"]
    assert counts == dict.fromkeys(("speed", "lateral acceleration", "steering rate", "direction"), 89)


def test_page_is_one_file_that_loads_nothing_and_escapes_names(folder):
    base, _ = folder
    text = (base / "out" / "report.html").read_text()
    assert len(text.encode()) < 5_000_000
    assert "<script" not in text and "&lt;script&gt;alert(1)" in text
    assert not re.findall(r'(?:src|href)="(?!#|data:)[^"]+"|url\((?!#)|@import', text)
    assert "prefers-color-scheme: dark" in text
    for setting in ("causal, as in the car", "interpolated within a step", "over the horizon means", "Nissan Leaf"):
        assert setting in text
    assert "short" in text and text.count("<figure>") == 5


def test_tables_and_figures_are_written(folder):
    base, _ = folder
    for name in ("table.csv", "table.tex", "seconds.csv", "bins.csv", "manoeuvres.csv", "overview.png", "overview.pdf"):
        assert (base / "out" / name).stat().st_size > 200, name
    one = base / "out" / "runs" / "labelled"
    figures = {"segments", "horizon_means", "slip_and_forces", "error_against_horizon"}
    assert {p.stem for p in one.glob("*.png")} == {p.stem for p in one.glob("*.pdf")} == figures
    rows = (one / "starts.csv").read_text().splitlines()
    assert len(rows) == 1 + 139 and "linear_hindsight_lateral_mean" in rows[0]


@pytest.mark.slow
def test_evaluation_settings_change_the_result_and_are_printed(folder, tmp_path):
    base, _ = folder
    drive = base / "data" / "weave.csv"
    result = evaluate(drive, "--vehicle", base / "car.yaml", "--output", tmp_path / "o", "--figures", "",
                      "--acceleration", "zero-phase", "--inputs", "hold", "--table", "samples",
                      "--model", "kinematic", "--at", "1,4.5")
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "o" / "evaluation.json").read_text())
    settings = content["settings"]
    assert (settings["acceleration"], settings["inputs"], settings["table_over"]) == ("zero_phase", "hold", "samples")
    assert "zero-phase" in result.output and "held over each step" in result.output and "all samples" in result.output
    before = json.loads((base / "out" / "evaluation.json").read_text())["runs"]["labelled"]["kinematic"]["hindsight"]
    after = content["runs"]["weave"]["kinematic"]["hindsight"]
    # Held inputs delay the steering by 25 ms on average, which increases the lateral error by some centimetres.
    assert 0.01 < after["lateral"]["rmse"] - before["lateral"]["rmse"] < 0.1
    assert not list((tmp_path / "o").rglob("*.png"))


@pytest.mark.parametrize(("arguments", "fragment"), [
    (["--model", "wrong"], "unknown model 'wrong'"),
    (["--horizon", "5.02"], "not a whole number of steps"),
    (["--figures", "gif"], "gif is not one of"),
    (["--at", "soon"], "expected comma-separated"),
    (["--interval", "0"], "interval"),
])
def test_wrong_options_are_rejected_in_one_line(folder, tmp_path, arguments, fragment):
    base, _ = folder
    result = evaluate(base / "data" / "weave.csv", "--output", tmp_path / "o", *arguments)
    assert result.exit_code == 2 and fragment in result.output and not (tmp_path / "o").exists()


@pytest.mark.parametrize(("run", "fragment"), [
    ("none.csv", "none.csv: the file or folder does not exist"),
    ("empty", "this folder contains no recording"),
    ("data/notes.odt", "recordings with the extension .odt are not supported"),
])
def test_missing_or_unsupported_input_writes_nothing(folder, tmp_path, run, fragment):
    base, _ = folder
    (base / "empty").mkdir(exist_ok=True)
    result = evaluate(base / run, "--output", tmp_path / "o")
    assert result.exit_code == 2 and fragment in result.output and result.output.count("\n") == 1
    assert not (tmp_path / "o").exists()


def test_unusable_run_writes_no_report(folder, tmp_path):
    base, _ = folder
    result = evaluate(base / "data" / "short.csv", "--output", tmp_path / "o")
    assert result.exit_code == 2 and "no run can be used: " in result.output and "the horizon of 5 s" in result.output
    assert not (tmp_path / "o").exists()


def test_output_folder_is_not_overwritten(folder):
    base, _ = folder
    result = evaluate(base / "data" / "weave.csv", "--output", base / "out")
    assert result.exit_code == 2 and "not empty" in result.output


@pytest.mark.slow
def test_model_file_is_evaluated_as_the_augmented_model(folder, tmp_path):
    base, _ = folder
    model = tmp_path / "model.yaml"
    digest = hashlib.sha256((base / "data" / "weave.csv").read_bytes()).hexdigest()
    model.write_text(
        'base: kinematic\neffects:\n  steering_offset:\n    angle: {value: 0.02, unit: "rad", source: "x"}\n'
        f'provenance:\n  data: {{"weave: weave.csv": "{digest}"}}\n')
    result = evaluate(base / "data", "--vehicle", base / "car.yaml", "--output", tmp_path / "o",
                      "--model", "kinematic", "--model", model, "--figures", "")
    content = json.loads((tmp_path / "o" / "evaluation.json").read_text())
    models = content["runs"]["labelled"]
    assert list(models) == ["kinematic", "augmented"]
    assert abs(models["augmented"]["hindsight"]["lateral"]["mean"]) > 0.3
    assert result.exit_code == 1  # due to the short drive
    assert [run for run in content["runs"] if "fitted" in str(content["about"][run]["warnings"])] == ["labelled"]


@pytest.mark.slow
def test_worker_processes_give_equal_results_and_tolerate_an_unusable_run(folder, tmp_path):
    base, _ = folder
    result = evaluate(base / "data", "--vehicle", base / "car.yaml", "--output", tmp_path / "o", "--figures", "",
                      "--workers", "2")
    assert result.exit_code == 1, result.output
    content, alone = (json.loads((path / "evaluation.json").read_text()) for path in (tmp_path / "o", base / "out"))
    assert set(content["failed"]) == {"short"} and list(content["runs"]) == list(alone["runs"])
    for run, models in alone["runs"].items():
        for model, modes in models.items():
            for mode in MODES:
                parallel = content["runs"][run][model][mode]
                assert parallel["n_starts"] == modes[mode]["n_starts"]
                assert parallel["lateral"] == pytest.approx(modes[mode]["lateral"], abs=1e-9)


def test_unreachable_scheduler_is_reported_in_one_line(folder, tmp_path, monkeypatch):
    import distributed

    base, _ = folder
    monkeypatch.setattr(distributed, "Client", lambda at, timeout, whole=distributed.Client: whole(at, timeout="1s"))
    result = evaluate(base / "data" / "weave.csv", "--output", tmp_path / "o", "--scheduler", "tcp://127.0.0.1:9")
    assert result.exit_code == 2 and "no Dask scheduler at tcp://127.0.0.1:9" in result.output
