"""Runs nodes as processes on a separate ROS domain, and ends them by their own handles."""

import os
import random
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from st_live import suite
from support import ROOT


def executable(package: str, name: str) -> str:
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix, "lib", package, name)
        if path.is_file():
            return str(path)
    pytest.skip(f"{name} is not installed: build the workspace (./st does)")


def free_domain() -> int:
    """A ROS domain without participants on this machine: the discovery port of its first participant is free."""
    domains = list(range(1, 101))
    random.shuffle(domains)  # so that two simultaneous test runs do not choose the same one
    for domain in domains:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", 7400 + 250 * domain + 10))
            except OSError:
                continue
            return domain
    raise RuntimeError("no free ROS domain")


class Processes:
    """Processes of one test, ended by their own handles."""

    def __init__(self, folder: Path):
        """folder: for logs, as NAME.log."""
        self.folder = folder
        self.environment = os.environ | suite.make_loopback_environment(os.environ) | {
            "ROS_DOMAIN_ID": str(free_domain()), "ROS_LOG_DIR": str(folder / "ros_log"),
        }
        self._running: list[subprocess.Popen] = []

    def start(self, command: list[str], name: str) -> subprocess.Popen:
        """Starts a process in the root of the repository; its output is written to NAME.log."""
        with (self.folder / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=self.environment, cwd=ROOT)
        self._running.append(process)
        return process

    def node(self, package: str, name: str, *parameters: str, arguments: tuple[str, ...] = ()) -> subprocess.Popen:
        """Starts a node by its console script. parameters: "name:=value"; arguments: further ROS arguments."""
        words = [word for p in parameters for word in ("-p", p)]
        return self.start([executable(package, name), "--ros-args", *arguments, *words], name)

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def stop(self, process: subprocess.Popen, number: int = signal.SIGINT) -> int:
        process.send_signal(number)
        return process.wait(20)

    def close(self) -> None:
        for process in self._running:
            if process.poll() is None:
                process.kill()
                process.wait()


def run_processes(tmp_path: Path) -> Iterator[Processes]:
    """A fixture, once `pytest.fixture` is applied to it."""
    processes = Processes(tmp_path)
    yield processes
    processes.close()


def refusing_node(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
                  ) -> Callable[..., str]:
    """A fixture, once `pytest.fixture` is applied to it: refuse(make_node, "name:=value", ...) returns the only line,
    except log messages, of a node that ends with status 2. The node runs in this process, which has imported its
    libraries; that the status is that of a process is tested in st_ros/test/test_spin.py."""
    from st_ros import spin

    monkeypatch.setattr(spin, "catch_stop_signals", lambda: lambda: False)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain()))
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "ros_log"))
    monkeypatch.chdir(ROOT)

    def refuse(make_node: Callable[[], Any], *parameters: str) -> str:
        capfd.readouterr()
        status = spin.run(make_node, ["--ros-args", *(word for text in parameters for word in ("-p", text))])
        lines = [line for line in "".join(capfd.readouterr()).splitlines() if not line.startswith("[")]
        assert status == 2 and len(lines) == 1, lines
        return lines[0]

    return refuse


def wait_for(condition: Callable[[], object], seconds: float = 20.0, what: str = "") -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"not within {seconds:g} s: {what}"
        time.sleep(0.05)
