"""Shows Rerun recordings in the browser: Rerun's server on the loopback interface, its page forwarded with a policy.

Rerun's page requests four external addresses (a font, usage data, a release check, an example list). A
Content-Security-Policy makes the browser refuse them.
"""

import argparse
import atexit
import http.client
import importlib.util
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import webbrowser
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar
from urllib.parse import quote

from rich.console import Console
from st_ros.scheduling import lower

from .suite import VIEW_NICE, Child, Processes, SuiteError

LOOPBACK = "127.0.0.1"
READY_TIMEOUT = 20.0  # s
STOP_TIMEOUT = 3.0  # s until a process is killed
WITHOUT_RERUN = ("rerun-sdk is not installed (with a sourced ROS its numpy 2 does not fit): "
                 "RViz, Foxglove and PlotJuggler show the same, see docs/manual/viewing.md")
HOP_BY_HOP = {"connection", "keep-alive", "transfer-encoding", "date", "server"}


POLICY = ("default-src 'self' data: blob:; connect-src 'self' data: blob:; "
          "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
          "worker-src 'self' blob:")
RECORDING = "/recording.rrd"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    source_port: ClassVar[int]
    recording: ClassVar[Path]

    def do_GET(self) -> None:
        if self.path.partition("?")[0] == RECORDING:
            self._send_recording()
            return
        try:
            source = http.client.HTTPConnection(LOOPBACK, self.source_port, timeout=30)
            source.request("GET", self.path, headers={"Accept-Encoding": self.headers.get("Accept-Encoding", "")})
            answer = source.getresponse()
        except OSError as error:
            self.send_error(502, f"the server of Rerun does not answer: {error}")
            return
        self.send_response(answer.status)
        for name, value in answer.getheaders():
            if name.lower() not in HOP_BY_HOP:
                self.send_header(name, value)
        if answer.length is None:
            self.send_header("Connection", "close")
            self.close_connection = True
        self.send_header("Content-Security-Policy", POLICY)
        self.end_headers()
        shutil.copyfileobj(answer, self.wfile)
        source.close()

    def _send_recording(self) -> None:
        with self.recording.open("rb") as stream:
            self.send_response(200)
            self.send_header("Content-Type", "application/octet-stream")
            self.send_header("Content-Length", str(self.recording.stat().st_size))
            self.end_headers()
            shutil.copyfileobj(stream, self.wfile)

    def log_message(self, *_: object) -> None:
        """No log of requests."""


def page_server(port: int, source_port: int, recording: Path) -> ThreadingHTTPServer:
    """Server on the loopback interface. Raises OSError if the port is in use."""
    handler = type("Handler", (_Handler,), {"source_port": source_port, "recording": recording})
    return ThreadingHTTPServer((LOOPBACK, port), handler)


def rerun_server(settings: Path, port: int, recording: str) -> subprocess.Popen:
    """Server of Rerun's page. settings: folder for its own files, with usage data switched off.

    recording: address of the recording. For an address Rerun starts no server of recordings, which would need 3 % of a
    core while idle.
    """
    (settings / "rerun").mkdir(parents=True, exist_ok=True)
    (settings / "rerun" / "analytics.json").write_text(json.dumps({
        "analytics_enabled": False, "analytics_id": "", "metadata": {},
        "config_file_path": str(settings / "rerun" / "analytics.json"), "data_dir_path": str(settings / "rerun")}))
    # The program itself: the command `rerun` is a script, whose end would leave the program running.
    found = importlib.util.find_spec("rerun_cli")
    assert found and found.submodule_search_locations
    program = Path(found.submodule_search_locations[0], "rerun")
    command = [str(program), recording, "--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(port),
               "--hide-welcome-screen"]
    if shutil.which("setpriv"):
        command = ["setpriv", "--pdeathsig", "TERM", *command]
    own = {"XDG_CONFIG_HOME": str(settings), "XDG_DATA_HOME": str(settings), "XDG_CACHE_HOME": str(settings)}
    return subprocess.Popen(command, env=os.environ | own, stdin=subprocess.DEVNULL)


class RecordingView:
    """The server of recordings as a process of its own. Use as a context: leaving it ends the process.

    folder: for settings and logs. file: a recording, .rrd. Raises SuiteError without rerun-sdk, or on a failed start.
    """

    def __init__(self, folder: Path, file: Path):
        check_rerun("st view")
        self._processes = Processes(folder)
        atexit.register(self._processes.stop, timeout=STOP_TIMEOUT)
        page, source = free_ports(2)
        self._server = self._processes.start("view_server", [
            sys.executable, "-m", "st_live.rerun_server", str(file.absolute()), "--settings",
            str(folder / "settings"), "--page-port", str(page), "--source-port", str(source)])
        self._wait_until_ready(self._server, (page, source))
        self.url = f"http://{LOOPBACK}:{page}/?url={quote(f'http://{LOOPBACK}:{page}{RECORDING}', safe='')}"

    @staticmethod
    def _wait_until_ready(server: Child, ports: tuple[int, ...]) -> None:
        end = time.monotonic() + READY_TIMEOUT
        while not all(map(listens, ports)):
            if server.process.poll() is not None or time.monotonic() > end:
                output = server.last_lines() or "no output"
                raise SuiteError(f"the server of the view did not start: {output} (log: {server.log})")
            time.sleep(0.1)

    def show(self, console: Console) -> None:
        """Print the address, open the browser on a terminal, and wait for Ctrl-C or the end of the server."""
        console.print(f"view: {self.url}", highlight=False, soft_wrap=True)
        if console.is_terminal:
            webbrowser.open(self.url)
        console.print("Ctrl-C ends the view.")
        try:
            self._server.process.wait()
        except KeyboardInterrupt:
            console.print()

    def __enter__(self) -> "RecordingView":
        return self

    def __exit__(self, *_: object) -> None:
        self._processes.stop(timeout=STOP_TIMEOUT)


def check_rerun(option: str) -> None:
    """Raises SuiteError where rerun-sdk is not installed."""
    if importlib.util.find_spec("rerun") is None:
        raise SuiteError(f"{option}: {WITHOUT_RERUN}")


def free_ports(count: int) -> list[int]:
    """Free TCP ports of the loopback interface."""
    probes = [socket.socket() for _ in range(count)]
    try:
        for probe in probes:
            probe.bind((LOOPBACK, 0))
        return [probe.getsockname()[1] for probe in probes]
    finally:
        for probe in probes:
            probe.close()


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((LOOPBACK, port)) == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path, help="recording to show, .rrd")
    parser.add_argument("--settings", type=Path, required=True, help="folder for Rerun's own files")
    parser.add_argument("--page-port", type=int, required=True)
    parser.add_argument("--source-port", type=int, required=True, help="of Rerun's own server of the page")
    options = parser.parse_args()
    server = page_server(options.page_port, options.source_port, options.file)
    lower(VIEW_NICE)
    recording = f"http://{LOOPBACK}:{options.page_port}{RECORDING}"
    rerun = rerun_server(options.settings, options.source_port, recording)

    def stop(*_: object) -> None:
        rerun.terminate()

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    threading.Thread(target=server.serve_forever, name="page", daemon=True).start()
    status = rerun.wait()
    server.shutdown()
    return 0 if status in (0, -signal.SIGTERM) else 1


if __name__ == "__main__":
    sys.exit(main())
