"""Forbidden calls and imports, found in the syntax trees, and names in files that must not be used as paths."""

import ast
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from st_recordings.runs import find_runs
from support import ROOT

FOLDERS = ("ros2_ws/src", "bench", "examples")
MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "jsonpickle"}
CALLS = {"eval", "exec", "compile", "__import__", "os.system", "os.popen", "yaml.load", "yaml.unsafe_load",
         "yaml.full_load", "tempfile.mktemp", "subprocess.getoutput", "subprocess.getstatusoutput"}
LISTEN_ON_ALL_NETWORKS = {"ros2_ws/src/st_cli/st_cli/verbs/live.py", "ros2_ws/src/st_predictor/launch/car.launch.py",
                          "ros2_ws/src/oxts_bridge/oxts_bridge/node.py",
                          # An option of the passenger's page; the default is 127.0.0.1.
                          "ros2_ws/src/st_cli/st_cli/verbs/_options.py", "ros2_ws/src/st_live/st_live/page.py"}


def sources() -> list[Path]:
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if "test" not in path.parts]
    assert len(files) > 200
    return sorted(files)


@cache
def find_nodes() -> list[tuple[str, ast.AST]]:
    return [(f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}", node) for path in sources()
            for node in ast.walk(ast.parse(path.read_text(), str(path)))
            if isinstance(node, ast.Import | ast.ImportFrom | ast.Call | ast.Constant)]


def nodes_of(kind: type) -> Iterator[tuple[str, ast.AST]]:
    return (found for found in find_nodes() if isinstance(found[1], kind))


def test_no_source_imports_pickle_or_similar():
    imported = [(place, alias.name) for place, node in nodes_of(ast.Import) for alias in node.names]
    imported += [(place, node.module or "") for place, node in nodes_of(ast.ImportFrom)]
    assert [found for found in imported if found[1].partition(".")[0] in MODULES] == []


@cache
def calls() -> list[tuple[str, str, dict[str, str]]]:
    """(place, name of the function, keyword arguments) of every call."""
    return [(place, ast.unparse(node.func), {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords})
            for place, node in nodes_of(ast.Call)]


def test_no_source_evaluates_text_as_code_or_uses_a_shell():
    assert [(place, name) for place, name, _ in calls() if name in CALLS] == []
    assert [place for place, _, keywords in calls() if keywords.get("shell", "False") != "False"] == []
    assert [place for place, name, keywords in calls()
            if name == "np.load" and keywords.get("allow_pickle", "False") != "False"] == []


def test_jinja_environments_escape_html():
    environments = [(place, keywords) for place, name, keywords in calls() if name == "jinja2.Environment"]
    assert environments
    assert [place for place, keywords in environments if keywords.get("autoescape") != "True"] == []


def test_only_listed_files_listen_on_all_networks():
    named = {place.partition(":")[0] for place, node in nodes_of(ast.Constant)
             if isinstance(node.value, str) and "0.0.0.0" in node.value}
    assert named <= LISTEN_ON_ALL_NETWORKS


@pytest.mark.parametrize("name", ["../elsewhere", "/etc", "..", "a/b", "a\\b", ""])
def test_a_path_as_name_in_a_run_file_is_rejected(tmp_path, name):
    (tmp_path / "drive.csv").write_text("t,x\n")
    (tmp_path / "run.yaml").write_text(f"name: {name!r}\ncsv: drive.csv\n")
    (run,) = find_runs([tmp_path / "run.yaml"])
    assert run.problem is not None
    assert "name" in str(run.problem)


@pytest.mark.slow
def test_modules_in_the_current_folder_are_not_imported(tmp_path: Path) -> None:
    """Users start st in folders with scripts of their own, whose names may be those of standard modules."""
    for name in ("csv", "random", "typer", "tools"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('a module of the current folder was imported')\n")
    for command in (["check", "--help"], ["bench", "--help"]):
        run = subprocess.run([ROOT / "st", *command], cwd=tmp_path, check=False, capture_output=True, text=True,
                             timeout=120)
        assert run.returncode == 0 and "Usage" in run.stdout, run.stdout + run.stderr
