"""The suite on the car: bridges, predictor, evaluator and recorder.

    ros2 launch st_predictor car.launch.py config_dir:=/path/to/config car:=mycar can_channel:=can0 ncom_port:=3000
"""

import os
import signal
from datetime import UTC, datetime

import yaml
from launch import LaunchDescription, Substitution
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node

CONFIG = LaunchConfiguration("config_dir")
CAR = LaunchConfiguration("car")
VEHICLE = LaunchConfiguration("vehicle")
DBC = LaunchConfiguration("dbc")
SIGNALS = LaunchConfiguration("signals")
PARAMETERS = LaunchConfiguration("parameters")
OUTPUT = LaunchConfiguration("output")
# launch only forwards SIGINT. With this prefix the kernel interrupts the nodes whenever launch ends.
PARENT_DEATH = "setpriv --pdeathsig INT"


class CarFile(Substitution):
    """A file in the folder of the car: config_dir/car/<car>, or an absolute folder; of the Leaf if `car` is empty."""

    def __init__(self, name):
        super().__init__()
        self._name = name

    def describe(self):
        return f"CarFile({self._name})"

    def perform(self, context):
        # os.path.join discards the parts before an absolute path, so `car` may be an absolute folder.
        return os.path.join(CONFIG.perform(context), "car", CAR.perform(context) or "leaf", self._name)


def argument(name, description, default=None):
    return DeclareLaunchArgument(name, description=description, default_value=default)


def text(node, name, *value):
    """Override of one parameter. To have precedence over the file, it must name the node and follow --params-file."""
    return ["-p", [f"{node}:{name}:='", *value, "'"]]


def number(node, name, value):
    return ["-p", [f"{node}:{name}:=", value]]


def suite_node(package, executable, *overrides, **options):
    clock = number(executable, "use_sim_time", LaunchConfiguration("use_sim_time"))
    arguments = ["--params-file", PARAMETERS, *(part for override in (clock, *overrides) for part in override)]
    return Node(
        package=package, executable=executable, name=executable, exec_name=executable, output="screen",
        ros_arguments=arguments, respawn=LaunchConfiguration("respawn"), respawn_delay=2.0, prefix=PARENT_DEATH,
        **options)


def steering_of(context):
    """Steering parameters from the arguments, else from the car's car.yaml, else from the file of node parameters."""
    steering = {}
    if CAR.perform(context):
        steering = {"steering_sign": 1, "steering_latency": 0.0}
        file = CarFile("car.yaml").perform(context)
        if os.path.exists(file):
            with open(file, encoding="utf-8") as stream:
                steering |= yaml.safe_load(stream) or {}
    given = {"steering_sign": LaunchConfiguration("steering_sign").perform(context),
             "steering_latency": LaunchConfiguration("steering_latency").perform(context)}
    steering |= {name: yaml.safe_load(value) for name, value in given.items() if value}
    # rcl distinguishes 0 from 0.0, and a latency is a float.
    if "steering_latency" in steering:
        steering["steering_latency"] = float(steering["steering_latency"])
    return {name: str(value) for name, value in steering.items()}


def ins_bridge(context):
    """The bridge of the INS, with the lever arm of the vehicle file as the transform base_link to ins_link."""
    with open(VEHICLE.perform(context), encoding="utf-8") as stream:
        vehicle = yaml.safe_load(stream)
    x, y = (float(vehicle.get(name, {}).get("value", 0.0)) for name in ("cg_to_ins_x", "cg_to_ins_y"))
    return [suite_node(
        "oxts_bridge", "oxts_bridge",
        number("oxts_bridge", "udp_port", LaunchConfiguration("ncom_port")),
        text("oxts_bridge", "bind_address", LaunchConfiguration("ncom_address")),
        number("oxts_bridge", "base_to_ins", f"[{x}, {y}, 0.0]"),
    )]


def can_bridge(context):
    return [suite_node(
        "canedge_bridge", "canedge_bridge",
        text("canedge_bridge", "interface", LaunchConfiguration("can_interface")),
        text("canedge_bridge", "channel", LaunchConfiguration("can_channel")),
        text("canedge_bridge", "vehicle_file", VEHICLE),
        text("canedge_bridge", "dbc_file", DBC),
        text("canedge_bridge", "signals_file", SIGNALS),
        *(number("canedge_bridge", name, value) for name, value in steering_of(context).items()),
    )]


def generate_launch_description():
    # In the background of a script launch inherits an ignored SIGINT: Ctrl-C would end the nodes, and launch would
    # restart all of them.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if_markers = {"condition": IfCondition(LaunchConfiguration("markers"))}
    if_identify = {"condition": IfCondition(LaunchConfiguration("identify"))}
    if_bridges = {"condition": IfCondition(LaunchConfiguration("bridges"))}
    # Over Fast DDS' shared memory a restarted node may receive nothing (docs/manual/reliability.md, Transport).
    transports = os.environ.get("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    return LaunchDescription([
        SetEnvironmentVariable("FASTDDS_BUILTIN_TRANSPORTS", transports),
        argument("config_dir", "folder with nodes.yaml and car/ (config/ of the repository)"),
        argument("car", "a folder in config_dir/car, or an absolute folder with the same files; empty: the Leaf", ""),
        argument("vehicle", "vehicle file", CarFile("vehicle.yaml")),
        argument("parameters", "node parameters", [CONFIG, "/nodes.yaml"]),
        argument("dbc", "DBC of the car's bus", CarFile("can.dbc")),
        argument("signals", "table from DBC signals to signal names", CarFile("signals.yaml")),
        argument("steering_sign", "1: decoded sensor left positive, -1: right; empty: of car.yaml, or parameters", ""),
        argument("steering_latency", "s, delay from wheel motion to the stamp of its frame; empty: as above", ""),
        argument("can_interface", "python-can interface", "socketcan"),
        argument("can_channel", "channel of that interface", "can0"),
        argument("ncom_port", "UDP port the INS sends NCOM to", "3000"),
        argument("ncom_address", "local address to listen on", "0.0.0.0"),
        argument("bands", "bands.yaml of st calibrate; empty: bands without calibration", ""),
        argument("course", "course.yaml of st course build for this site; empty: none", ""),
        argument("output", "folder of the recordings, must not exist", f"runs/{datetime.now(UTC):%Y%m%d-%H%M%S}"),
        argument("bridges", "false: another source publishes odometry and steering", "true"),
        argument("markers", "true: car, errors and names as markers for RViz and Foxglove", "true"),
        argument("identify", "true: identify steering and stiffness online (published, never applied)", "false"),
        argument("respawn", "true: restart a node that ends; it records into NAME_2", "true"),
        argument("use_sim_time", "true: follow /clock", "false"),
        suite_node("st_predictor", "recorder",
                   text("recorder", "output_directory", PathJoinSubstitution([OUTPUT, "bag"])),
                   number("recorder", "number_when_taken", LaunchConfiguration("respawn")),
                   ["-p", ["recorder:configuration_files:=['", VEHICLE, "', '", PARAMETERS, "']"]]),
        suite_node("st_predictor", "evaluator", text("evaluator", "vehicle_file", VEHICLE),
                   text("evaluator", "output_directory", PathJoinSubstitution([OUTPUT, "errors"])),
                   number("evaluator", "number_when_taken", LaunchConfiguration("respawn"))),
        suite_node("st_predictor", "predictor", text("predictor", "vehicle_file", VEHICLE),
                   text("predictor", "bands_file", LaunchConfiguration("bands")),
                   text("predictor", "course_file", LaunchConfiguration("course"))),
        suite_node("st_predictor", "markers", text("markers", "vehicle_file", VEHICLE), **if_markers),
        suite_node("st_predictor", "identifier", text("identifier", "vehicle_file", VEHICLE), **if_identify),
        OpaqueFunction(function=ins_bridge, **if_bridges),
        OpaqueFunction(function=can_bridge, **if_bridges),
    ])
