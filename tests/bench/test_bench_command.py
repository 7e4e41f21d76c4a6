"""The command `st bench`: the file of a result, and benchmarks that write their own results."""

import json
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from tools.__main__ import app


def test_json_file_contains_the_result_and_the_computer(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("tools.bench._import_module", lambda path: SimpleNamespace(run=lambda: {"error": 1.5}))
    file = tmp_path / "result.json"
    assert CliRunner().invoke(app, ["bench", "tick", "--json", str(file)]).exit_code == 0
    content = json.loads(file.read_text())
    assert content["bench"] == "tick" and content["result"] == {"error": 1.5} and "python" in content["machine"]


@pytest.mark.parametrize("name", ["checks", "discovery", "relations", "strangers"])
def test_json_file_is_rejected_for_a_benchmark_that_writes_its_own_results(name, tmp_path) -> None:
    file = tmp_path / "result.json"
    result = CliRunner().invoke(app, ["bench", name, "--json", str(file)])
    assert result.exit_code == 2 and f"st bench {name}: --json is not available" in result.output
    assert not file.exists()
