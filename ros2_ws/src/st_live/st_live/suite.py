"""Starts the nodes of the suite as processes with one parameter file, watches them and stops them in order.

Each child leaves the process group of the terminal: Ctrl-C reaches only this process, which then ends the children in
order. If this process is killed, the kernel interrupts the children (parent-death signal of setpriv, if installed).

Recorder, evaluator and the server of the passenger's page lower their priority; `st live --realtime` gives bridges and
predictor real-time scheduling.
"""

import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from st_core import yaml_text
from st_core.errors import ConfigurationError, StCoreError
from st_recordings.paths import config

STOP_TIMEOUT = 20.0  # s until a child that ignores SIGINT is killed
LARGEST_SAFE_DOMAIN = 101  # the ports of higher domains are in the system's ephemeral range
LARGEST_VALID_DOMAIN = 232  # higher domains have no valid port
# Priorities of SCHED_RR: above other programs, far below the kernel's own threads (50 and more).
REALTIME_PRIORITIES = {"oxts_bridge": 22, "canedge_bridge": 22, "predictor": 21}
# Names of environment variables.
DISCOVERY_RANGE, RMW = "ROS_AUTOMATIC_DISCOVERY_RANGE", "RMW_IMPLEMENTATION"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
REALTIME_PERMISSION = ('echo "$USER - rtprio 30" | sudo tee /etc/security/limits.d/single-track.conf, '
                       "then log in again")

Parameters = Mapping[str, Mapping[str, Any]]


class SuiteError(StCoreError):
    """A run cannot start or continue; the message gives the reason, and the log of a process that has ended."""


@dataclass(frozen=True)
class Child:
    """One process. log: file with its output. may_end: whether it may end with status 0 during the run."""

    name: str
    process: subprocess.Popen
    log: Path
    may_end: bool = False

    def read_reason(self, count: int = 5) -> str:
        """The signal that ended the process, or else the last lines of its output."""
        if (status := self.process.returncode or 0) < 0:
            return f"signal {-status}, {signal.strsignal(-status)}"
        return "\n".join(self.log.read_text(errors="replace").strip().splitlines()[-count:])

    def wait_for(self, text: str, timeout: float) -> str:
        """The first line of the log that contains `text`; empty after `timeout` [s] or if the process ends first."""
        end = time.monotonic() + timeout
        while time.monotonic() < end and self.process.poll() is None:
            for line in self.log.read_text(errors="replace").splitlines(keepends=True):
                if text in line and line.endswith("\n"):
                    return line
            time.sleep(0.05)
        return ""


class Processes(AbstractContextManager):
    """Processes with their logs in folder/logs; leaving the `with` block ends them. realtime: request
    REALTIME_PRIORITIES. realtime_denied: processes for which this was not permitted."""

    def __init__(self, folder: Path, domain_id: int | None = None, realtime: bool = False):
        self.folder = folder
        self._realtime = realtime
        self.realtime_denied: set[str] = set()
        self.children: list[Child] = []
        self.environment = dict(os.environ)
        if domain_id is not None:
            self.environment["ROS_DOMAIN_ID"] = str(domain_id)
        self.environment["ROS_LOG_DIR"] = str(folder / "logs" / "ros")
        (folder / "logs").mkdir(parents=True, exist_ok=True)

    def start(self, name: str, command: list[str], may_end: bool = False) -> Child:
        log = self.folder / "logs" / f"{name}.log"
        if shutil.which("setpriv"):
            command = ["setpriv", "--pdeathsig", "INT", *command]
        with log.open("ab") as stream:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT,
                                       env=self.environment, start_new_session=True)
        if self._realtime and name in REALTIME_PRIORITIES:
            try:
                os.sched_setscheduler(process.pid, os.SCHED_RR, os.sched_param(REALTIME_PRIORITIES[name]))
            except PermissionError:
                self.realtime_denied.add(name)
            except ProcessLookupError:
                pass  # it has already ended; `check` reports that
        self.children.append(Child(name, process, log, may_end))
        return self.children[-1]

    def check(self) -> None:
        """Raises SuiteError naming the first child that has ended, except with status 0 if it may end."""
        for child in self.children:
            if (status := child.process.poll()) is not None and (status or not child.may_end):
                raise SuiteError(f"{child.name} ended with status {status}: {child.read_reason() or 'no output'}\n"
                                 f"(log: {child.log})")

    def reap(self, name: str) -> Child | None:
        """Remove and return the child with this name if it has ended; else None."""
        child = next((c for c in self.children if c.name == name and c.process.poll() is not None), None)
        if child is not None:
            self.children.remove(child)
        return child

    def stop(self, name: str | None = None, timeout: float = STOP_TIMEOUT) -> dict[str, int]:
        """End one child, or all in the order of their start; returns exit statuses. timeout [s]: then it is killed."""
        statuses = {}
        for child in [c for c in self.children if name in (None, c.name)]:
            process = child.process
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                try:
                    process.wait(timeout)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
                if process.returncode == -signal.SIGINT:
                    process.returncode = 0  # interrupted before it installed its handler
            statuses[child.name] = process.returncode
            self.children.remove(child)
        return statuses

    def __exit__(self, *_: object) -> None:
        self.stop()


class Suite(Processes):
    """The nodes of one run, with one parameter file."""

    def __init__(self, folder: Path, parameters: Parameters, domain_id: int | None = None, realtime: bool = False):
        """folder: for parameters.yaml and logs/. parameters: {node: {name: value}}."""
        super().__init__(folder, domain_id, realtime)
        self.parameter_file = folder / "parameters.yaml"
        document = {node: {"ros__parameters": dict(values)} for node, values in parameters.items()}
        self.parameter_file.write_text(yaml.safe_dump(document, sort_keys=False))

    def start_node(self, package: str, executable: str) -> Child:
        return self.start(
            executable, [find_executable(package, executable), "--ros-args", "--params-file", str(self.parameter_file)])


def find_executable(package: str, executable: str) -> str:
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if (candidate := Path(prefix) / "lib" / package / executable).exists():
            return str(candidate)
    if found := shutil.which(executable):
        return found
    raise SuiteError(f"{executable} of package {package} not found: start with ./st, or source install/setup.bash of "
                     "the workspace")


def merge_parameters(base: Path, overrides: Parameters) -> dict[str, dict[str, Any]]:
    """Node parameters of a file, in which each section describes one node, updated with `overrides`. Raises SuiteError
    naming the file if it is unreadable, has no such sections or contains a key twice."""
    try:
        document = yaml_text.load(base.read_text(encoding="utf-8"))
        merged = {node: dict(section["ros__parameters"]) for node, section in document.items()}
    except (OSError, UnicodeDecodeError, ConfigurationError) as error:
        raise SuiteError(f"{base}: {error}") from None
    except (AttributeError, KeyError, TypeError, ValueError):
        raise SuiteError(f"{base}: expected sections `node: {{ros__parameters: {{name: value}}}}`") from None
    for node, values in overrides.items():
        merged.setdefault(node, {}).update(values)
    return merged


def find_free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def read_domain_id() -> int | None:
    """The user's ROS_DOMAIN_ID; None if it is not set. Raises SuiteError if it is invalid."""
    if not (text := os.environ.get("ROS_DOMAIN_ID", "")):
        return None
    if not text.isdecimal() or int(text) > LARGEST_VALID_DOMAIN:
        raise SuiteError(f"ROS_DOMAIN_ID: {text!r} is not a whole number from 0 to {LARGEST_VALID_DOMAIN}")
    return int(text)


def make_loopback_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Environment variables that keep the messages of all nodes on the loopback interface.

    The discovery range LOCALHOST does so with any middleware, but makes Fast DDS use shared memory, over which a node
    restarted after `kill -9` may receive nothing (docs/manual/reliability.md, Transport). Fast DDS therefore gets the
    profile config/dds/loopback.xml instead, unless the user has set a different profile.
    """
    profile = str(config("dds/loopback.xml"))
    uses_fast_dds = environment.get(RMW, "rmw_fastrtps_cpp").startswith("rmw_fastrtps")
    if environment.get(PROFILES, profile) != profile or not uses_fast_dds:
        return {DISCOVERY_RANGE: "LOCALHOST"}
    return {DISCOVERY_RANGE: "SYSTEM_DEFAULT", PROFILES: profile}


@contextmanager
def claim_domain(requested: int | None = None) -> Iterator[int]:
    """Yields the requested ROS domain, by default one of 1 to 101 that no process on this computer uses, reserved by
    binding its first unicast discovery port (7400 + 250 * domain + 10). Raises SuiteError if all are in use."""
    if requested is not None:
        yield requested
        return
    for domain in range(LARGEST_SAFE_DOMAIN, 0, -1):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as claim:
            try:
                claim.bind(("", 7400 + 250 * domain + 10))
            except OSError:
                continue
            yield domain
            return
    raise SuiteError("ROS domains 1 to 101 are in use on this computer: stop the nodes in one of them, or set "
                     "ROS_DOMAIN_ID to a domain without other nodes of the suite")
