"""Imports point one way, and only the shells import ROS. Read from the syntax trees: runs no file, needs no ROS."""

import ast
import importlib
import inspect
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path

import pytest
from PIL import Image
from support import ROOT

from tools import structure

SOURCES = ROOT / "ros2_ws" / "src"
PACKAGES = sorted(p.parent.name for p in SOURCES.glob("*/setup.py"))
# Packages of this project that a package may import in addition to itself.
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
# Packages that run without ROS, so nothing they import may need it; st_ros does.
ROS_FREE = ("st_core", "st_recordings", "st_sim")


WITHOUT_ROS = """
import importlib, sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in ("rclpy", "launch", "builtin_interfaces") or top.endswith("_msgs"):
            raise ImportError(f"{name}: ROS is blocked")
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
    """Sources without tests, relative to ros2_ws/src."""
    files = (p.relative_to(SOURCES) for package in PACKAGES for p in (SOURCES / package).rglob("*.py"))
    return sorted(p for p in files if p.parts[1] != "test" and p.name != "setup.py")


@cache
def imports(path: Path) -> tuple[tuple[int, str], ...]:
    """(line, full module name) of every import in a file, including those inside functions; relative ones resolved."""
    tree = ast.parse((SOURCES / path).read_text(), str(path))
    return tuple(found for node in ast.walk(tree) for found in _names(node, path))


def _names(node: ast.AST, path: Path) -> Iterator[tuple[int, str]]:
    if isinstance(node, ast.Import):
        yield from ((node.lineno, alias.name) for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        package = path.with_suffix("").parts[1:]  # ros2_ws/src/<package>/<package>/...
        base = ".".join(package[:len(package) - node.level]) if node.level else ""
        module = ".".join(filter(None, (base, node.module)))
        # The imported name may be a module itself: `from . import node`.
        yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)


def forbidden_imports(allowed) -> list[str]:
    """FILE:LINE and imported name of every import for which `allowed(path, module)` is false."""
    return [f"{path}:{line} imports {module}" for path in python_files()
            for line, module in imports(path) if not allowed(path, module)]


def test_every_package_is_checked():
    assert set(PACKAGES) == set(ALLOWED)
    assert {p.parts[0] for p in python_files()} == set(ALLOWED)


def test_figure_of_the_structure_shows_the_actual_imports():
    """`st docs`, the picture in the repository and the imports found here have the same arrows."""
    known = set(structure.list_packages(SOURCES))
    found = {(path.parts[0], top) for path in python_files() for _, module in imports(path)
             if (top := module.partition(".")[0]) in known - {path.parts[0]}}
    assert known == {*PACKAGES, "st_msgs"}
    assert structure.find_edges(SOURCES) == found
    assert structure.read_edges(Image.open(ROOT / "docs" / structure.FIGURE).text) == found, "run ./st docs"
    assert f"]({structure.FIGURE})" in (ROOT / "docs" / "architecture.md").read_text()


def test_arrows_that_a_longer_path_implies():
    assert structure.find_implied({("a", "b"), ("b", "c"), ("a", "c")}) == {("a", "c")}


def test_packages_import_in_one_direction():
    def allowed(path, module):
        top = module.partition(".")[0]
        return top not in ALLOWED or top == path.parts[0] or top in ALLOWED[path.parts[0]]

    assert forbidden_imports(allowed) == []


def graph() -> dict[str, set[str]]:
    """Module -> modules of this project that it imports, also inside functions."""
    modules = {".".join(p.with_suffix("").parts[1:]).removesuffix(".__init__"): p for p in python_files()}
    def module_of(name: str) -> str:
        return name if name in modules else name.rpartition(".")[0]

    return {module: {module_of(name) for _, name in imports(path)} & modules.keys() - {module}
            for module, path in modules.items()}


def import_cycles(edges: dict[str, set[str]]) -> list[str]:
    """Modules in import cycles: the rest after modules without imports or importers are removed repeatedly."""
    rest = {module: set(targets) for module, targets in edges.items()}
    while True:
        imported = set().union(*rest.values())
        removable = {module for module, targets in rest.items() if not targets or module not in imported}
        if not removable:
            return sorted(rest)
        rest = {module: targets - removable for module, targets in rest.items() if module not in removable}


def test_there_are_no_import_cycles():
    assert import_cycles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == ["b", "c"]
    edges = graph()
    assert "st_offline.evaluation.work" in edges["st_offline.evaluation.evaluation_command"]
    assert import_cycles(edges) == []


def forbidden_imports_of_virtual_car(packages: tuple[str, ...], shared: tuple[str, ...]) -> list[str]:
    return forbidden_imports(lambda path, module: path.parts[0] != "st_sim" or not module.startswith(packages)
                             or module.startswith(shared))


def test_virtual_car_shares_no_equations_with_the_models():
    """They share manoeuvres and vehicle files; the equations of motion are written twice, so that errors show."""
    assert forbidden_imports_of_virtual_car(("st_core",), (
        "st_core.manoeuvres", "st_core.yaml_text", "st_core.errors", "st_core.vehicle",
        "st_core.tyres.MagicFormula")) == []


def test_virtual_car_uses_only_codecs_transport_and_yaml_reader_of_the_bridges():
    assert forbidden_imports_of_virtual_car(("oxts_bridge", "canedge_bridge"), (
        "oxts_bridge.ncom", "oxts_bridge.channels", "canedge_bridge.decode", "canedge_bridge.yaml_reader",
        "canedge_bridge.transport")) == []


def test_only_nodes_converters_and_launch_files_import_ros():
    assert forbidden_imports(lambda path, module: may_use_ros(path) or not is_ros(module)) == []


def test_no_module_imports_a_node():
    nodes = {".".join(p.with_suffix("").parts[1:]) for p in python_files() if is_node(p) and not p.name.startswith("_")}

    def allowed(path, module):
        imports_node = module in nodes or module.rpartition(".")[0] in nodes
        # The command runs its monitor node in its own process.
        return not imports_node or (path.parts[0] == "st_live" and module.startswith("st_live.nodes.monitor."))

    assert len(nodes) >= 5
    assert forbidden_imports(allowed) == []


@pytest.mark.parametrize("package", ROS_FREE)
def test_ros_free_packages_import_without_ros(package):
    modules = [".".join(p.with_suffix("").parts[1:]) for p in python_files() if p.parts[0] == package]
    modules = [m.removesuffix(".__init__") for m in modules if not m.endswith("__main__")]
    run = subprocess.run([sys.executable, "-c", WITHOUT_ROS, *modules], capture_output=True, text=True, check=False,
                         env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    assert run.returncode == 0, run.stderr
    assert len(modules) > 5


@pytest.mark.ros
def test_predictor_without_a_course_does_not_import_the_large_modules_of_scipy():
    pytest.importorskip("rclpy", reason="needs ROS 2")
    program = ("import sys, st_predictor.nodes.predictor; "
               "print(*{'scipy.integrate', 'scipy.spatial', 'scipy.stats'} & set(sys.modules))")
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True,
                         env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    assert run.stdout.split() == []


# Compilers are optional and have their own folder; their cache of compiled code needs files and modification times.
BACKENDS = "st_core/st_core/backends"


def is_core(path):
    return path.parts[0] == "st_core" and not path.as_posix().startswith(BACKENDS)


def test_core_imports_only_numpy_scipy_and_yaml():
    known = CORE_LIBRARIES | {"st_core"} | set(sys.stdlib_module_names)
    assert forbidden_imports(lambda path, module: not is_core(path) or module.partition(".")[0] in known) == []


def test_core_uses_no_clock_and_no_files():
    forbidden = {"time", "datetime", "pathlib", "io", "os", "socket", "subprocess"}
    assert forbidden_imports(lambda path, module: not is_core(path) or module.partition(".")[0] not in forbidden) == []


@cache
def defined_in(file: Path) -> frozenset[str]:
    """Names that a module or package provides: definitions, imports, assignments and submodules."""
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
def test_names_imported_from_the_packages_exist(folder):
    """mypy checks the packages only; a benchmark or an example would fail at its start."""
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


@pytest.mark.parametrize("folder", ["bench", "examples", "tools"])
def test_names_taken_from_the_packages_exist(folder: str) -> None:
    """mypy does not check these folders, and not all of their functions run in tests."""
    missing = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        tree, modules = ast.parse(path.read_text(encoding="utf-8")), dict[str, object]()
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and not node.level]
        for node in imports:
            if str(node.module).partition(".")[0] not in PACKAGES:
                continue
            package = importlib.import_module(str(node.module))
            for name in node.names:
                with suppress(ImportError):
                    importlib.import_module(f"{node.module}.{name.name}")
                if not hasattr(package, name.name):
                    missing.append(f"{path.name}:{node.lineno}: {node.module}.{name.name}")
                elif inspect.ismodule(value := getattr(package, name.name)):
                    modules[name.asname or name.name] = value
        missing += [f"{path.name}:{node.lineno}: {node.value.id}.{node.attr}" for node in ast.walk(tree)
                    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
                    and node.value.id in modules and not hasattr(modules[node.value.id], node.attr)]
    assert missing == []


BESIDE_ROS = """
import importlib.abc, sys
class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in NAMES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
NAMES = set(sys.argv.pop(1).split(","))
sys.meta_path.insert(0, Refuse())
from st_cli.__main__ import main
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "status", "text"), [
    (["check", "examples/faulty", "--car", "hyundai_genesis", "--output", "report"], 0, "warning x_scale"),
    (["evaluate", "examples/data", "--car", "hyundai_genesis", "--output", "report"], 0, "report.html"),
    (["check", "log.parquet"], 2, "cannot be read without the Python package pandas; read it without a sourced"),
])
def test_commands_work_with_the_packages_beside_a_sourced_ros(arguments, status, text, tmp_path):
    """A sourced ROS 2 has numpy 1.26; then ./st leaves out the section `offline` of requirements.txt."""
    (_, *pins) = (ROOT / "requirements.txt").read_text().partition("# --- offline ---")[2].splitlines()
    missing = {re.sub("[-_.]+", "-", pin.partition("==")[0]).lower() for pin in pins if "==" in pin}
    modules = [module for module, names in metadata.packages_distributions().items()
               if missing.issuperset(re.sub("[-_.]+", "-", name).lower() for name in names)]
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "log.parquet").write_bytes(b"PAR1")
    run = subprocess.run([sys.executable, "-c", BESIDE_ROS, ",".join(modules), *arguments], cwd=tmp_path,
                         capture_output=True, text=True, check=False,
                         env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    assert run.returncode == status and text in " ".join((run.stdout + run.stderr).split()), run.stderr
