"""The program `st`: runs the commands in verbs/. A command imports its libraries only when it is called."""

import errno
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import typer
from st_live import suite

from .verbs import check, discover, effects, evaluate, live, raw_logs, replay

app = typer.Typer(
    name="st", no_args_is_help=True, add_completion=False, rich_markup_mode="rich", pretty_exceptions_show_locals=False,
    help="Single-track predictor suite: where will the car be in five seconds, and how wrong was that prediction?",
    epilog="In a checkout also: ./st test, ./st shell, ./st bench, ./st docs.")
COMMAND_OPTIONS: Any = {discover.discover: {"cls": discover.ReferenceCommand}, raw_logs.import_: {"name": "import"}}
for verb in (live.demo, live.live, raw_logs.ncom, check.car, check.check, evaluate.evaluate, evaluate.calibrate,
             evaluate.course, discover.discover, effects.effects, discover.identify, replay.replay, replay.verify,
             replay.view, replay.foxglove, raw_logs.align, raw_logs.import_, raw_logs.recover, effects.export):
    text = re.sub(r"(?<=\S)\n +(?=\S)", " ", verb.__doc__ or "")  # without the line ends, which typer would keep
    app.command(help=text, **COMMAND_OPTIONS.get(verb, {}))(verb)


def main() -> None:
    if os.environ.get(suite.DISCOVERY_RANGE, "LOCALHOST") == "LOCALHOST":  # unless the user set another range
        os.environ.update(suite.make_loopback_environment(os.environ))
    _ensure_log_directory()
    try:
        app(prog_name="st")
    except ModuleNotFoundError as error:
        name = (error.name or "").partition(".")[0]
        if name not in ("rclpy", "st_ros", "rerun") and not name.endswith("_msgs"):
            raise
        parts = "the live suite and the viewer are" if name != "rerun" else "the viewer is"
        print(f"st: {name} is not installed: {parts} part of a checkout (./st), not of the offline package",
              file=sys.stderr)
        sys.exit(2)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
            raise
        advice = "write to" if error.errno == errno.EROFS else "free some space, or write to"
        print(f"st: {error.filename or 'output'}: {error.strerror}; {advice} another file system", file=sys.stderr)
        sys.exit(1)


def _ensure_log_directory() -> None:
    """Set ROS_LOG_DIR to a temporary folder if ~/.ros/log cannot be created; ROS needs a log folder."""
    if not {"ROS_LOG_DIR", "ROS_HOME"} & os.environ.keys():
        try:
            Path(os.environ["HOME"], ".ros", "log").mkdir(parents=True, exist_ok=True)
        except (KeyError, OSError):
            os.environ["ROS_LOG_DIR"] = str(Path(tempfile.gettempdir(), f"st-ros-log-{os.getuid()}"))


if __name__ == "__main__":
    main()
