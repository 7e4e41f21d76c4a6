"""Plays the INS and steering data of a bag through predictor and evaluator, and records their results.

    ros2 launch st_predictor replay.launch.py config_dir:=/path/to/config bag:=runs/sim/bag
"""

from datetime import UTC, datetime
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription, Shutdown, TimerAction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

# Measurements only; predictions and errors of the recorded run are not played.
MEASURED = "/(ins|vehicle|can)/.*|/tf|/tf_static"
START_DELAY = 3.0  # s for the nodes to start before the first message is played
CLOCK_RATE = "200"  # /clock messages per second, which the predictor's ticks follow

# In addition to those of car.launch.py, or with another default.
ARGUMENTS = {
    "config_dir": (None, "folder with nodes.yaml and car/ (config/ of the repository)"),
    "bag": (None, "bag directory to play"),
    "speed": ("1.0", "playback speed relative to the recording"),
    "output": (f"runs/replay-{datetime.now(UTC):%Y%m%d-%H%M%S}", "folder of the new recordings; bags in it are kept, "
               "and new ones are named NAME_2"),
}


def generate_launch_description():
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    suite = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(Path(__file__).with_name("car.launch.py"))),
        launch_arguments={"config_dir": value["config_dir"], "bridges": "false", "use_sim_time": "true"}.items())
    play = ExecuteProcess(
        cmd=["ros2", "bag", "play", value["bag"], "--clock", CLOCK_RATE, "--rate", value["speed"], "--regex", MEASURED],
        output="screen", prefix="setpriv --pdeathsig INT", on_exit=Shutdown(reason="end of the bag"))
    arguments = [DeclareLaunchArgument(name, default_value=default, description=text)
                 for name, (default, text) in ARGUMENTS.items()]
    return LaunchDescription([*arguments, suite, TimerAction(period=START_DELAY, actions=[play])])
