"""The commands `st test` and `st shell` of a checkout."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NoReturn

import typer
from st_live import suite
from st_recordings.paths import project_root

# Files with timing tests of minutes. They run first, so that both workers end at about the same time. Durations:
# --durations=0.
LONGEST_TIMING_TESTS = (
    "test_trouble.py", "test_faults.py", "test_demo.py", "test_bands_live.py", "test_consistency.py", "test_plan.py")


def test(
    context: typer.Context,
    fast: bool = typer.Option(False, "--fast", help="Leave out tests marked slow or timing."),
) -> None:
    """Run every test. Further arguments go to pytest: ./st test -k ncom."""
    root = project_root()
    # -rfEs lists failed, broken and skipped tests with their reasons.
    pytest = [sys.executable, "-m", "pytest", "-rfEs", "-q"]
    markers = "not slow and not timing" if fast else "not timing"
    # Files are distributed in the order of testpaths. One worker more than cores, because some tests wait. Timing tests
    # mostly wait: two run at a time, after all others, and only their files are imported.
    by_file = ["--dist", "loadfile", "--no-loadscope-reorder"]
    timing_tests = [str(file) for name in ("tests", "ros2_ws/src") for file in sorted((root / name).rglob("test_*.py"))
                    if "mark.timing" in file.read_text(encoding="utf-8")]
    timing_tests.sort(key=lambda file: Path(file).name not in LONGEST_TIMING_TESTS)
    parts = [
        [*pytest, "-n", str(len(os.sched_getaffinity(0)) + 1), *by_file, "-m", markers],
        *([] if fast else [[*pytest, "-n", "2", *by_file, "-m", "timing", *timing_tests]]),
    ]
    if context.args:
        parts = [[*pytest, *(["-m", markers] if fast else []), *context.args]]
    with tempfile.TemporaryDirectory(prefix="st-test-") as logs:
        environment = {**os.environ, **suite.make_loopback_environment(os.environ), "ROS_LOG_DIR": logs}
        statuses = [subprocess.run(part, cwd=root, env=environment, check=False).returncode for part in parts]
        raise typer.Exit(max(statuses))


NO_ROS2 = (
    "The command ros2 is not available, because no ROS 2 is sourced. Use instead: ./st demo and live (ros2 launch), "
    "replay (ros2 bag play), view and foxglove (rviz2, ros2 topic), or rclpy in python.")


def shell(context: typer.Context) -> None:
    """Open a shell with the environment of st, or run one command in it: ./st shell -- python."""
    if (not context.args or context.args[0] == "ros2") and shutil.which("ros2") is None:
        typer.echo(NO_ROS2, err=True)
    if context.args:
        _replace_process(context.args)
    shell = os.environ.get("SHELL", "/bin/bash")
    os.environ["PS1"] = "(st) \\w \\$ "
    _replace_process([shell, "--norc"] if Path(shell).name == "bash" else [shell])


def _replace_process(command: list[str]) -> NoReturn:
    try:
        os.execvp(command[0], command)
    except OSError as error:
        typer.echo(f"st shell: {command[0]}: {error.strerror}", err=True)
        raise typer.Exit(127) from None
