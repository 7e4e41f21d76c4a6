"""What no source may do, read from the syntax trees; and names from files that must not become paths."""

import ast
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
ALL_ADDRESSES = {"ros2_ws/src/st_cli/st_cli/verbs/live.py", "ros2_ws/src/st_predictor/launch/car.launch.py",
                 "ros2_ws/src/oxts_bridge/oxts_bridge/node.py",
                 # Named for the passenger's page; the default is 127.0.0.1.
                 "ros2_ws/src/st_cli/st_cli/verbs/_options.py", "ros2_ws/src/st_live/st_live/page.py"}


def sources() -> list[Path]:
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    return sorted(path for path in files if "test" not in path.parts)


@cache
def walked() -> list[tuple[str, ast.AST]]:
    return [(f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}", node) for path in sources()
            for node in ast.walk(ast.parse(path.read_text(), str(path)))
            if isinstance(node, ast.Import | ast.ImportFrom | ast.Call | ast.Constant)]


def nodes(kind: type) -> Iterator[tuple[str, ast.AST]]:
    return (found for found in walked() if isinstance(found[1], kind))


def test_sources_are_looked_at():
    assert len(sources()) > 200


def test_nothing_unpickles():
    imported = [(place, alias.name) for place, node in nodes(ast.Import) for alias in node.names]
    imported += [(place, node.module or "") for place, node in nodes(ast.ImportFrom)]
    assert [found for found in imported if found[1].partition(".")[0] in MODULES] == []


def test_no_text_is_run_as_code_or_by_a_shell():
    calls = [(place, ast.unparse(node.func), node.keywords) for place, node in nodes(ast.Call)]
    assert [(place, name) for place, name, _ in calls if name in CALLS] == []
    shells = [(place, ast.unparse(w.value)) for place, _, words in calls for w in words if w.arg == "shell"]
    assert [place for place, value in shells if value != "False"] == []
    loads = [(place, {w.arg: ast.unparse(w.value) for w in words}) for place, name, words in calls if name == "np.load"]
    assert [place for place, words in loads if words.get("allow_pickle", "False") != "False"] == []


def test_templates_escape():
    made = [(place, {w.arg: ast.unparse(w.value) for w in node.keywords}) for place, node in nodes(ast.Call)
            if ast.unparse(node.func) == "jinja2.Environment"]
    assert made
    assert [place for place, words in made if words.get("autoescape") != "True"] == []
    templates = list((ROOT / "ros2_ws" / "src").rglob("*.jinja"))
    assert templates


def test_only_the_verb_for_the_car_listens_on_all_networks():
    named = {place.partition(":")[0] for place, node in nodes(ast.Constant)
             if isinstance(node.value, str) and "0.0.0.0" in node.value}
    assert named <= ALL_ADDRESSES


@pytest.mark.parametrize("name", ["../elsewhere", "/etc", "..", "a/b", "a\\b", ""])
def test_a_name_in_a_run_file_never_becomes_a_path(tmp_path, name):
    (tmp_path / "drive.csv").write_text("t,x\n")
    (tmp_path / "run.yaml").write_text(f"name: {name!r}\ncsv: drive.csv\n")
    (run,) = find_runs([tmp_path / "run.yaml"])
    assert run.problem is not None
    assert "name" in str(run.problem)
