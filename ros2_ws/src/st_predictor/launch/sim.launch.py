"""Launches the suite of car.launch.py with the virtual Leaf on this computer.

    ros2 launch st_predictor sim.launch.py config_dir:=/path/to/config scenario:=S6 duration:=60
"""

from datetime import UTC, datetime
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription, Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackagePrefix

# In addition to those of car.launch.py, or with another default.
ARGUMENTS = {
    "config_dir": (None, "folder with nodes.yaml and car/ (config/ of the repository)"),
    "scenario": ("S6", "manoeuvre: S1 to S7 of the paper, sweep, step, ramp_to_limit, brake_in_turn, lane_change, "
                 "slalom, weave, circle, there_and_back, or a road file (.yaml)"),
    "duration": ("60", "seconds of driving"),
    "plant": ("realistic", "ideal, realistic, or a file with plant settings"),
    "seed": ("0", "seed of the simulated noise"),
    "ncom_rate": ("100", "NCOM packets per second: 100 or 250"),
    "can_channel": ("239.74.163.2", "multicast group on the loopback interface"),
    "output": (f"runs/sim-{datetime.now(UTC):%Y%m%d-%H%M%S}", "folder of the recordings; files in it are kept, and new "
               "ones are named NAME_2"),
}


def generate_launch_description():
    value = {name: LaunchConfiguration(name) for name in (*ARGUMENTS, "vehicle", "ncom_port")}
    suite = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(Path(__file__).with_name("car.launch.py"))),
        # No `car`: DBC, signal table and steering settings always belong to the virtual Leaf.
        launch_arguments={"config_dir": value["config_dir"], "car": "", "ncom_address": "127.0.0.1",
                          "can_interface": "udp_multicast"}.items())
    leaf = ExecuteProcess(
        cmd=[
            PathJoinSubstitution([FindPackagePrefix("st_sim"), "lib", "st_sim", "virtual_leaf"]),
            "--scenario", value["scenario"], "--duration", value["duration"], "--plant", value["plant"],
            "--seed", value["seed"], "--vehicle", value["vehicle"],
            "--ncom-port", value["ncom_port"], "--ncom-rate", value["ncom_rate"],
            "--can-interface", "udp_multicast", "--can-channel", value["can_channel"],
            "--output", PathJoinSubstitution([value["output"], "truth"]),
        ],
        name="virtual_leaf", output="screen", prefix="setpriv --pdeathsig INT",
        on_exit=Shutdown(reason="end of the drive"))
    arguments = [DeclareLaunchArgument(name, default_value=default, description=text)
                 for name, (default, text) in ARGUMENTS.items()]
    return LaunchDescription([*arguments, suite, leaf])
