"""Imports point one way, and ROS stays in the shells. Read from the syntax trees: no file is run, no ROS needed."""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from PIL import Image
from support import ROOT

from tools import structure

SOURCES = ROOT / "ros2_ws" / "src"
PACKAGES = sorted(p.parent.name for p in SOURCES.glob("*/setup.py"))
# Which of our packages a package may import besides itself.
ALLOWED = {
    "st_core": set(),
    "st_ros": set(),
    "oxts_bridge": {"st_core", "st_ros"},
    "canedge_bridge": {"st_core", "st_ros"},
    "st_recordings": {"st_core", "oxts_bridge", "canedge_bridge"},
    "st_predictor": {"st_core", "st_ros", "oxts_bridge", "st_recordings"},
    "st_sim": {"st_core", "oxts_bridge", "canedge_bridge"},
    "st_live": {"st_core", "st_ros", "st_recordings", "st_predictor", "st_sim"},
    "st_offline": {"st_core", "st_ros", "oxts_bridge", "st_recordings", "st_predictor"},
    "st_cli": {"st_core", "oxts_bridge", "st_recordings", "st_predictor", "st_sim", "st_live", "st_offline"},
}
CORE_LIBRARIES = {"numpy", "scipy", "yaml"}
ROS = ("rclpy", "launch", "launch_ros", "builtin_interfaces", "tf2_ros", "rosidl_runtime_py", "rosidl_parser",
       "ament_index_python", "rcl_interfaces")
# These run without ROS, so nothing they import may need it either; st_ros, for one, does.
ROS_FREE = ("st_core", "st_recordings", "st_sim")


WITHOUT_ROS = """
import importlib, sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in ("rclpy", "launch", "builtin_interfaces") or top.endswith("_msgs"):
            raise ImportError(f"{name}: no ROS here")
sys.meta_path.insert(0, Refuse())
for module in sys.argv[1:]:
    importlib.import_module(module)
"""


def is_ros(module: str) -> bool:
    top = module.partition(".")[0]
    return top in ROS or top.endswith("_msgs")


def is_node(path: Path) -> bool:
    return path.name == "node.py" or "nodes" in path.parts


def may_use_ros(path: Path) -> bool:
    return is_node(path) or path.name == "convert.py" or "launch" in path.parts or path.parts[0] == "st_ros"


def python_files() -> list[Path]:
    """All sources but tests, relative to ros2_ws/src."""
    files = (p.relative_to(SOURCES) for package in PACKAGES for p in (SOURCES / package).rglob("*.py"))
    return sorted(p for p in files if p.parts[1] != "test" and p.name != "setup.py")


@cache
def imports(path: Path) -> tuple[tuple[int, str], ...]:
    """(line, full module name) of every import in a file, also those inside functions; relative ones resolved."""
    tree = ast.parse((SOURCES / path).read_text(), str(path))
    return tuple(found for node in ast.walk(tree) for found in _names(node, path))


def _names(node: ast.AST, path: Path) -> Iterator[tuple[int, str]]:
    if isinstance(node, ast.Import):
        yield from ((node.lineno, alias.name) for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        package = path.with_suffix("").parts[1:]  # ros2_ws/src/<package>/<package>/...
        base = ".".join(package[:len(package) - node.level]) if node.level else ""
        module = ".".join(filter(None, (base, node.module)))
        # The name imported may be a module itself: `from . import node`.
        yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)


def offences(allowed) -> list[str]:
    """file:line imports name, for every import that `allowed(path, module)` refuses."""
    return [f"{path}:{line} imports {module}" for path in python_files()
            for line, module in imports(path) if not allowed(path, module)]


def test_every_package_is_looked_at():
    assert set(PACKAGES) == set(ALLOWED)
    assert {p.parts[0] for p in python_files()} == set(ALLOWED)
    # The walk sees what it should: a relative import resolved, and a node that imports ROS.
    assert "st_core.types.VehicleState" in [m for _, m in imports(Path("st_core/st_core/prediction.py"))]
    assert any(is_ros(m) for _, m in imports(Path("st_ros/st_ros/spin.py")))


def test_the_figure_of_the_structure_shows_these_imports():
    """What `st docs` draws, what the picture in the repository holds, and what this walk sees are the same arrows."""
    known = set(structure.list_packages(SOURCES))
    seen = {(path.parts[0], top) for path in python_files() for _, module in imports(path)
            if (top := module.partition(".")[0]) in known - {path.parts[0]}}
    assert known == {*PACKAGES, "st_msgs"}
    assert structure.find_edges(SOURCES) == seen
    assert structure.read_edges(Image.open(ROOT / "docs" / structure.FIGURE).text) == seen, "run ./st docs"
    assert f"]({structure.FIGURE})" in (ROOT / "docs" / "architecture.md").read_text()


def test_layers_and_implied_arrows_of_a_structure():
    arrows = {("a", "b"), ("b", "c"), ("a", "c")}
    assert structure.sort_into_layers(["a", "b", "c", "d"], arrows) == [["c", "d"], ["b"], ["a"]]
    assert structure.find_implied(arrows) == {("a", "c")}
    with pytest.raises(ValueError, match="cycle"):
        structure.sort_into_layers(["a", "b"], {("a", "b"), ("b", "a")})


def test_packages_import_in_one_direction():
    def allowed(path, module):
        top = module.partition(".")[0]
        return top not in ALLOWED or top == path.parts[0] or top in ALLOWED[path.parts[0]]

    assert offences(allowed) == []


def graph() -> dict[str, set[str]]:
    """Module -> modules of ours that it imports, also inside functions."""
    modules = {".".join(p.with_suffix("").parts[1:]).removesuffix(".__init__"): p for p in python_files()}
    def named(name: str) -> str:
        return name if name in modules else name.rpartition(".")[0]

    return {module: {named(name) for _, name in imports(path)} & modules.keys() - {module}
            for module, path in modules.items()}


def circles(edges: dict[str, set[str]]) -> list[str]:
    """Modules that are reached again from themselves: what is left when leaves are taken away, from both ends."""
    left = {module: set(targets) for module, targets in edges.items()}
    while True:
        imported = set().union(*left.values())
        going = {module for module, targets in left.items() if not targets or module not in imported}
        if not going:
            return sorted(left)
        left = {module: targets - going for module, targets in left.items() if module not in going}


def test_no_file_imports_itself_by_way_of_others():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == ["b", "c"]
    edges = graph()
    assert "st_offline.evaluation.work" in edges["st_offline.evaluation.evaluation_command"]
    assert circles(edges) == []


def test_virtual_car_shares_no_equations_with_the_models():
    """The drives and the reading of YAML are shared; how a car moves is written down twice: no error hides in both."""
    shared = ("st_core.manoeuvres", "st_core.yaml_text", "st_core.errors")
    assert offences(lambda path, module: path.parts[0] != "st_sim" or module.partition(".")[0] != "st_core"
                    or module.startswith(shared)) == []


def test_virtual_car_takes_only_the_wire_from_the_bridges():
    wire = ("oxts_bridge.ncom", "oxts_bridge.channels", "oxts_bridge.packet_time", "canedge_bridge.decode",
            "canedge_bridge.transport")
    assert offences(lambda path, module: path.parts[0] != "st_sim" or not module.startswith(("oxts_b", "canedge_b"))
                    or module.startswith(wire)) == []


def test_ros_stays_in_nodes_converters_and_launch_files():
    assert offences(lambda path, module: may_use_ros(path) or not is_ros(module)) == []


def test_nothing_imports_a_node():
    nodes = {".".join(p.with_suffix("").parts[1:]) for p in python_files() if is_node(p) and not p.name.startswith("_")}

    def allowed(path, module):
        imports_node = module in nodes or module.rpartition(".")[0] in nodes
        # The command runs its own monitor node inside its own process.
        return not imports_node or (path.parts[0] == "st_live" and module.startswith("st_live.node."))

    assert len(nodes) >= 5
    assert offences(allowed) == []


@pytest.mark.parametrize("package", ROS_FREE)
def test_core_recordings_and_simulated_car_run_where_there_is_no_ros(package):
    modules = [".".join(p.with_suffix("").parts[1:]) for p in python_files() if p.parts[0] == package]
    modules = [m.removesuffix(".__init__") for m in modules if not m.endswith("__main__")]
    run = subprocess.run([sys.executable, "-c", WITHOUT_ROS, *modules], capture_output=True, text=True, check=False,
                         env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    assert run.returncode == 0, run.stderr
    assert len(modules) > 5


# Compilers are optional and have a folder of their own, whose cache of compiled code needs files and their age.
BACKENDS = "st_core/st_core/backends"


def is_core(path):
    return path.parts[0] == "st_core" and not path.as_posix().startswith(BACKENDS)


def test_the_core_needs_numpy_scipy_and_yaml_only():
    known = CORE_LIBRARIES | {"st_core"} | set(sys.stdlib_module_names)
    assert offences(lambda path, module: not is_core(path) or module.partition(".")[0] in known) == []


@pytest.mark.parametrize("forbidden", ["time", "datetime", "pathlib", "io", "os", "socket", "subprocess"])
def test_the_core_has_no_clock_and_no_files(forbidden):
    def allowed(path, module):
        return not is_core(path) or module.partition(".")[0] != forbidden

    assert offences(allowed) == []


@cache
def defined_in(file: Path) -> frozenset[str]:
    """Names at the top level of a module, in its conditions too, and its submodules."""
    names = {child.stem if child.suffix == ".py" else child.name for child in file.parent.iterdir()
             } if file.name == "__init__.py" else set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            names.update(alias.asname or alias.name for alias in node.names)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return frozenset(names)


@pytest.mark.parametrize("folder", ["bench", "examples", "tests", "tools"])
def test_what_other_code_imports_of_the_packages_exists(folder):
    """Types are checked in the packages only; a benchmark or an example would fail when it is started."""
    missing = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.ImportFrom) or node.level or not node.module:
                continue
            top, *parts = node.module.split(".")
            if top not in PACKAGES:
                continue
            module = SOURCES.joinpath(top, top, *parts)
            file = module / "__init__.py" if module.is_dir() else module.with_suffix(".py")
            known = defined_in(file) if file.is_file() else frozenset()
            missing += [f"{path.relative_to(ROOT)}: {node.module}.{alias.name}" for alias in node.names
                        if alias.name not in known]
    assert not missing
