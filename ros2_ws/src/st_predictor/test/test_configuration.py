"""config/nodes.yaml and the launch files against the declarations of the nodes and the installed packages."""

import ast
import importlib
import math
import re
import runpy
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

pytest.importorskip("rclpy", reason="needs ROS 2")

import rclpy
from ros_processes import Processes, wait_for
from st_predictor import params
from st_predictor.nodes.evaluator import EvaluatorNode
from st_predictor.nodes.predictor import PredictorNode
from st_ros.parameters import BUILT_IN, ConfigurationError, Parameter
from support import LEAF, ROOT

pytestmark = pytest.mark.ros
LAUNCH = ROOT / "ros2_ws" / "src" / "st_predictor" / "launch"
LAUNCH_FILES = sorted(LAUNCH.glob("*.launch.py"))
NODES_YAML = ROOT / "config" / "nodes.yaml"


def get_declared() -> dict[str, tuple[Parameter, ...]]:
    return {"predictor": params.PREDICTOR, "evaluator": params.EVALUATOR, "recorder": params.RECORDER,
            "markers": params.MARKERS, "identifier": params.IDENTIFIER,
            "oxts_bridge": importlib.import_module("oxts_bridge.node").PARAMETERS,
            "canedge_bridge": importlib.import_module("canedge_bridge.node").PARAMETERS}


def test_file_has_exactly_the_declared_parameters() -> None:
    document = yaml.safe_load(NODES_YAML.read_text())
    assert document.keys() == get_declared().keys()
    for node, table in get_declared().items():
        assert document[node].keys() == {"ros__parameters"}
        assert document[node]["ros__parameters"].keys() == {p.name for p in table}, node


def test_values_of_the_file_are_the_defaults() -> None:
    document = yaml.safe_load(NODES_YAML.read_text())
    for node, table in get_declared().items():
        for parameter in table:
            value = parameter.check(document[node]["ros__parameters"][parameter.name])
            if parameter.name.endswith("_file") and value:
                assert (ROOT / value).is_file(), f"{node}.{parameter.name}"
            elif isinstance(value, float) and math.isnan(value):
                assert math.isnan(parameter.default), f"{node}.{parameter.name}"
            else:
                assert value == parameter.default, f"{node}.{parameter.name}"


@pytest.mark.parametrize("make_node", [PredictorNode, EvaluatorNode])
def test_unknown_model_is_reported_as_value_of_the_parameter(make_node) -> None:
    rclpy.init(args=["--ros-args", "-p", f"vehicle_file:={LEAF}", "-p", "models:=['bicycle']"])
    try:
        with pytest.raises(ConfigurationError, match=r"^(predictor|evaluator)\.models: unknown model 'bicycle'"):
            make_node()
    finally:
        rclpy.try_shutdown()


def test_every_value_has_a_comment_with_its_range() -> None:
    """The range in the comment is that of the declaration."""
    text = NODES_YAML.read_text()
    for node, table in get_declared().items():
        section = re.search(rf"^{node}:\n(.*?)(?=^\w|\Z)", text, re.S | re.M).group(1)
        for parameter in table:
            line = re.search(rf"(?:^ *# .*\n)?^ +{parameter.name}:.*$", section, re.M).group(0)
            assert "#" in line, f"{node}.{parameter.name}"
            if math.isfinite(parameter.minimum) and isinstance(parameter.default, float):
                numbers = re.search(r"\((-?[\d.e]+|-pi) to (-?[\d.e]+|pi)", line).groups()
                limits = [float(n.replace("pi", f"{math.pi}")) for n in numbers]
                assert limits == pytest.approx([parameter.minimum, parameter.maximum]), f"{node}.{parameter.name}"


def find_calls(file: Path, *functions: str) -> list[ast.Call]:
    tree = ast.parse(file.read_text())
    return [n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "id", "") in functions]


def test_launched_nodes_are_installed_and_their_parameters_exist() -> None:
    nodes = {tuple(a.value for a in call.args[:2]) for call in find_calls(LAUNCH / "car.launch.py", "suite_node")}
    assert {executable for _, executable in nodes} == get_declared().keys()
    for package, executable in nodes:
        setup = (ROOT / "ros2_ws" / "src" / package / "setup.py").read_text()
        assert re.search(rf"'{executable} = {package}\.", setup), f"{package} installs no {executable}"
    functions = "override_text", "override_value"
    overrides = [[a.value for a in call.args[:2]] for call in find_calls(LAUNCH / "car.launch.py", *functions)
                 if all(isinstance(a, ast.Constant) for a in call.args[:2])]
    assert len(overrides) >= 10
    for node, name in overrides:
        assert name in BUILT_IN or name in {p.name for p in get_declared()[node]}, f"{node}.{name}"
    literal = re.findall(r'"(\w+):(\w+):=', (LAUNCH / "car.launch.py").read_text())
    assert literal == [("recorder", "configuration_files")]
    assert "configuration_files" in {p.name for p in params.RECORDER}


def test_launched_processes_end_with_their_launch() -> None:
    """launch does not forward SIGTERM; the kernel does, as requested by the prefix."""
    for file in LAUNCH_FILES:
        for call in find_calls(file, "Node", "ExecuteProcess"):
            given = {k.arg: ast.unparse(k.value) for k in call.keywords}
            assert given["prefix"] in ("PARENT_DEATH", "'setpriv --pdeathsig INT'"), file.name
    assert "PARENT_DEATH = \"setpriv --pdeathsig INT\"" in (LAUNCH / "car.launch.py").read_text()


def test_used_launch_arguments_are_declared() -> None:
    declared_by_car = {call.args[0].value for call in find_calls(LAUNCH / "car.launch.py", "declare")}
    used = {call.args[0].value for call in find_calls(LAUNCH / "car.launch.py", "LaunchConfiguration")}
    assert used == declared_by_car
    for file in LAUNCH_FILES:
        if file.name == "car.launch.py":
            continue
        (include,) = find_calls(file, "IncludeLaunchDescription")
        arguments = {k.value for d in ast.walk(include) if isinstance(d, ast.Dict) for k in d.keys}
        assert arguments <= declared_by_car, file.name


@pytest.mark.parametrize(("given", "steering"), [
    ({}, {}),
    ({"car": "leaf"}, {"steering_sign": "1", "steering_latency": "0.0"}),
    ({"car": "FOLDER"}, {"steering_sign": "-1", "steering_latency": "0.03"}),
    ({"car": "FOLDER", "steering_sign": "1"}, {"steering_sign": "1", "steering_latency": "0.03"}),
    ({"steering_latency": "0"}, {"steering_latency": "0.0"}),
])
def test_launch_accepts_a_car_by_its_folder(tmp_path: Path, given: dict[str, str], steering) -> None:
    """Files and steering of the folder; arguments override both; without a car those of nodes.yaml are used."""
    launch = pytest.importorskip("launch")
    pytest.importorskip("launch_ros")
    (tmp_path / "car.yaml").write_text("steering_sign: -1\nsteering_latency: 0.03\n")
    given = {name: str(tmp_path) if value == "FOLDER" else value for name, value in given.items()}
    names = runpy.run_path(str(LAUNCH / "car.launch.py"))
    context = launch.LaunchContext()
    context.launch_configurations.update({"config_dir": str(ROOT / "config"), **given})
    for entity in names["generate_launch_description"]().entities:
        if isinstance(entity, launch.actions.DeclareLaunchArgument):
            entity.execute(context)
    folder = Path(given["car"]) if "/" in given.get("car", "") else ROOT / "config" / "car" / "leaf"
    files = {"vehicle": "vehicle.yaml", "dbc": "can.dbc", "signals": "signals.yaml"}
    assert {key: context.launch_configurations[key] for key in files} == {
        key: str(folder / name) for key, name in files.items()}
    assert names["steering_parameters"](context) == steering


def test_launch_options_of_virtual_leaf_exist() -> None:
    text = (LAUNCH / "sim.launch.py").read_text()
    options = set(re.findall(r'"(--[a-z-]+)"', text))
    assert "--scenario" in options
    setup = (ROOT / "ros2_ws" / "src" / "st_sim" / "setup.py").read_text()
    module, function = re.search(r"virtual_leaf = ([\w.]+):(\w+)", setup).groups()
    program = f"import sys; sys.argv = ['virtual_leaf', '--help']; from {module} import {function}; {function}()"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert options <= set(re.findall(r"--[a-z-]+", result.stdout))


def test_configuration_files_of_equal_names_are_stored_separately(tmp_path: Path) -> None:
    from st_predictor.nodes.recorder import make_metadata

    files = [tmp_path / "car" / "leaf.yaml", tmp_path / "can" / "leaf.yaml", tmp_path / "nodes.yaml"]
    for file in files:
        file.parent.mkdir(exist_ok=True)
        file.write_text(f"content of {file.parent.name}")
    values = SimpleNamespace(message_prefix="", configuration_files=[str(f) for f in files], metadata_json="")
    configuration = make_metadata(values)["configuration"]
    assert set(configuration) == {"car/leaf.yaml", "can/leaf.yaml", "nodes.yaml", "hash"}
    assert configuration["can/leaf.yaml"] == "content of can"


@pytest.mark.slow
def test_all_nodes_start_with_the_file(processes: Processes) -> None:
    """rcl reads the file including NaN and empty lists; each node starts and ends with status 0."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = ("--params-file", str(NODES_YAML))
    nodes = [
        processes.node("oxts_bridge", "oxts_bridge", f"oxts_bridge:udp_port:={port}", arguments=arguments),
        processes.node("canedge_bridge", "canedge_bridge", "canedge_bridge:interface:=udp_multicast",
                       f"canedge_bridge:channel:=239.74.163.{1 + port % 250}", arguments=arguments),
        processes.node("st_predictor", "predictor", arguments=arguments),
        processes.node("st_predictor", "evaluator", arguments=arguments),
        processes.node("st_predictor", "recorder", f"recorder:output_directory:={processes.folder / 'bag'}",
                       arguments=arguments),
        processes.node("st_predictor", "markers", arguments=arguments),
        processes.node("st_predictor", "identifier", arguments=arguments),
    ]
    for name in get_declared():
        # Seven nodes start simultaneously, and the predictor may have to compile its models.
        wait_for(lambda name=name: f"[{name}]" in processes.log(name), 120.0, f"{name} up: {processes.log(name)}")
    assert [processes.stop(node) for node in nodes] == [0] * 7, [processes.log(name) for name in get_declared()]
