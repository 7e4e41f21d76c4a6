"""Launches the suite on the car: bridges, predictor, evaluator, recorder, and optional markers and identifier.

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
PARENT_DEATH = "setpriv --pdeathsig INT"  # the kernel interrupts the nodes if launch is killed


class CarFile(Substitution):
    """A file in the folder of the car: config_dir/car/CAR, where CAR is the argument `car`, or leaf if it is empty."""

    def __init__(self, name):
        super().__init__()
        self._name = name

    def describe(self):
        return f"CarFile({self._name})"

    def perform(self, context):
        # `car` may be an absolute folder, for which os.path.join ignores the preceding parts.
        return os.path.join(CONFIG.perform(context), "car", CAR.perform(context) or "leaf", self._name)


def declare(name, description, default=None):
    return DeclareLaunchArgument(name, description=description, default_value=default)


def override_text(node, name, *value):
    """Override of one parameter; it names the node and follows --params-file to take precedence over the file."""
    return ["-p", [f"{node}:{name}:='", *value, "'"]]


def override_value(node, name, value):
    return ["-p", [f"{node}:{name}:=", value]]


def suite_node(package, executable, *overrides, **options):
    clock = override_value(executable, "use_sim_time", LaunchConfiguration("use_sim_time"))
    arguments = ["--params-file", PARAMETERS, *(part for override in (clock, *overrides) for part in override)]
    return Node(
        package=package, executable=executable, name=executable, exec_name=executable, output="screen",
        ros_arguments=arguments, respawn=LaunchConfiguration("respawn"), respawn_delay=2.0, prefix=PARENT_DEATH,
        **options)


def steering_parameters(context):
    """Overrides of steering parameters: the arguments, or else car.yaml of `car` (default sign 1, latency 0). If `car`
    is empty, only the arguments override nodes.yaml."""
    steering = {}
    if CAR.perform(context):
        steering = {"steering_sign": 1, "steering_latency": 0.0}
        file = CarFile("car.yaml").perform(context)
        if os.path.exists(file):
            with open(file, encoding="utf-8") as stream:
                steering |= yaml.safe_load(stream) or {}
    given = {"steering_sign": LaunchConfiguration("steering_sign").perform(context),
             "steering_latency": LaunchConfiguration("steering_latency").perform(context)}
    steering |= {name: value for name, value in given.items() if value}
    if "steering_latency" in steering:
        # The latency is a float parameter, for which ROS does not accept the integer 0.
        steering["steering_latency"] = float(steering["steering_latency"])
    return {name: str(value) for name, value in steering.items()}


def ins_bridge(context):
    """The INS bridge; the vehicle file's lever arm is the transform from base_link to ins_link."""
    with open(VEHICLE.perform(context), encoding="utf-8") as stream:
        vehicle = yaml.safe_load(stream)
    x, y = (float(vehicle.get(name, {}).get("value", 0.0)) for name in ("cg_to_ins_x", "cg_to_ins_y"))
    return [suite_node(
        "oxts_bridge", "oxts_bridge",
        override_value("oxts_bridge", "udp_port", LaunchConfiguration("ncom_port")),
        override_text("oxts_bridge", "bind_address", LaunchConfiguration("ncom_address")),
        override_value("oxts_bridge", "base_to_ins", f"[{x}, {y}, 0.0]"),
    )]


def can_bridge(context):
    return [suite_node(
        "canedge_bridge", "canedge_bridge",
        override_text("canedge_bridge", "interface", LaunchConfiguration("can_interface")),
        override_text("canedge_bridge", "channel", LaunchConfiguration("can_channel")),
        override_text("canedge_bridge", "vehicle_file", VEHICLE),
        override_text("canedge_bridge", "dbc_file", DBC),
        override_text("canedge_bridge", "signals_file", SIGNALS),
        *(override_value("canedge_bridge", name, value) for name, value in steering_parameters(context).items()),
    )]


def generate_launch_description():
    # Started in the background of a script, launch ignores SIGINT: Ctrl-C would end the nodes, and launch would restart
    # them.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if_markers = {"condition": IfCondition(LaunchConfiguration("markers"))}
    if_identify = {"condition": IfCondition(LaunchConfiguration("identify"))}
    if_bridges = {"condition": IfCondition(LaunchConfiguration("bridges"))}
    # Over the shared memory of Fast DDS a restarted node may receive nothing (docs/manual/reliability.md, Transport).
    transports = os.environ.get("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    return LaunchDescription([
        SetEnvironmentVariable("FASTDDS_BUILTIN_TRANSPORTS", transports),
        declare("config_dir", "folder with nodes.yaml and car/ (config/ of the repository)"),
        declare("car", "a folder in config_dir/car, or an absolute folder with the same files; empty: the Leaf", ""),
        declare("vehicle", "vehicle file", CarFile("vehicle.yaml")),
        declare("parameters", "file of node parameters", [CONFIG, "/nodes.yaml"]),
        declare("dbc", "DBC of the car's bus", CarFile("can.dbc")),
        declare("signals", "table that maps DBC signals to canonical names, signs and units", CarFile("signals.yaml")),
        declare("steering_sign", "1: left is positive, -1: right is positive; empty: from car.yaml or parameters", ""),
        declare("steering_latency", "s, delay from motion to stamp of the frame; empty: as for steering_sign", ""),
        declare("can_interface", "python-can interface", "socketcan"),
        declare("can_channel", "channel of that interface", "can0"),
        declare("ncom_port", "UDP port the INS sends NCOM to", "3000"),
        declare("ncom_address", "local address to listen on", "0.0.0.0"),
        declare("bands", "bands.yaml of st calibrate; empty: bands without calibration", ""),
        declare("course", "course.yaml of st course build for this site; empty: none", ""),
        declare("output", "folder of the recordings; if they exist: NAME_2, or an error if respawn is false",
                f"runs/{datetime.now(UTC):%Y%m%d-%H%M%S}"),
        declare("bridges", "false: another source publishes odometry and steering", "true"),
        declare("markers", "true: car, paths, bands, errors and names as markers for RViz and Foxglove", "true"),
        declare("identify", "true: identify steering and stiffness online (published, never applied)", "false"),
        declare("respawn", "true: restart a node that ends", "true"),
        declare("use_sim_time", "true: follow /clock", "false"),
        suite_node("st_predictor", "recorder",
                   override_text("recorder", "output_directory", PathJoinSubstitution([OUTPUT, "bag"])),
                   override_value("recorder", "number_if_exists", LaunchConfiguration("respawn")),
                   ["-p", ["recorder:configuration_files:=['", VEHICLE, "', '", PARAMETERS, "']"]]),
        suite_node("st_predictor", "evaluator", override_text("evaluator", "vehicle_file", VEHICLE),
                   override_text("evaluator", "output_directory", PathJoinSubstitution([OUTPUT, "errors"])),
                   override_value("evaluator", "number_if_exists", LaunchConfiguration("respawn"))),
        suite_node("st_predictor", "predictor", override_text("predictor", "vehicle_file", VEHICLE),
                   override_text("predictor", "bands_file", LaunchConfiguration("bands")),
                   override_text("predictor", "course_file", LaunchConfiguration("course"))),
        suite_node("st_predictor", "markers", override_text("markers", "vehicle_file", VEHICLE), **if_markers),
        suite_node("st_predictor", "identifier", override_text("identifier", "vehicle_file", VEHICLE), **if_identify),
        OpaqueFunction(function=ins_bridge, **if_bridges),
        OpaqueFunction(function=can_bridge, **if_bridges),
    ])
