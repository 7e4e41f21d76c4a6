"""Shows Rerun recordings in the browser, with Rerun's server on the loopback interface.

Rerun's page requests four external addresses (a font, usage data, a release check, an example list). A proxy adds
a Content-Security-Policy that makes the browser block them.
"""

import http.client
import importlib.metadata
import importlib.util
import json
import shutil
import socket
import threading
import time
import webbrowser
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar
from urllib.parse import quote

from rich.console import Console
from st_ros.scheduling import BACKGROUND_NICE, lower_priority

from .suite import Child, Processes, SuiteError

LOOPBACK = "127.0.0.1"
READY_TIMEOUT = 20.0  # s until a server must accept connections
STOP_TIMEOUT = 3.0  # s until a process that ignores SIGINT is killed
REQUEST_TIMEOUT = 30.0  # s until Rerun's server must respond
RERUN_MISSING = ("rerun-sdk is not installed (its numpy 2 conflicts with a sourced ROS); "
                 "RViz, Foxglove and PlotJuggler show the same data, see docs/manual/viewing.md")
NOT_FORWARDED = {"connection", "keep-alive", "transfer-encoding", "date", "server"}  # headers the proxy sets itself
POLICY = ("default-src 'self' data: blob:; connect-src 'self' data: blob:; "
          "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
          "worker-src 'self' blob:")
RECORDING = "/recording.rrd"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    rerun_port: ClassVar[int]
    recording: ClassVar[Path]

    def do_GET(self) -> None:
        if self.path.partition("?")[0] == RECORDING:
            with self.recording.open("rb") as stream:
                self.send_response(200)
                self.send_header("Content-Type", "application/octet-stream")
                self.send_header("Content-Length", str(self.recording.stat().st_size))
                self.end_headers()
                shutil.copyfileobj(stream, self.wfile)
            return
        try:
            connection = http.client.HTTPConnection(LOOPBACK, self.rerun_port, timeout=REQUEST_TIMEOUT)
            connection.request("GET", self.path, headers={"Accept-Encoding": self.headers.get("Accept-Encoding", "")})
            response = connection.getresponse()
        except OSError as error:
            self.send_error(502, f"the server of Rerun does not respond: {error}")
            return
        self.send_response(response.status)
        for name, value in response.getheaders():
            if name.lower() not in NOT_FORWARDED:
                self.send_header(name, value)
        if response.length is None:
            self.send_header("Connection", "close")
            self.close_connection = True
        self.send_header("Content-Security-Policy", POLICY)
        self.end_headers()
        shutil.copyfileobj(response, self.wfile)
        connection.close()

    def log_message(self, *_: object) -> None:
        """Do not log requests."""


def show_recording(folder: Path, file: Path, console: Console) -> None:
    """Serve a recording (.rrd), show its address, and wait for Ctrl-C or the end of Rerun.

    folder: for settings and logs. Raises SuiteError if the start fails; call `check_rerun` first.
    """
    lower_priority(BACKGROUND_NICE)
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        rerun_port = probe.getsockname()[1]
    handler = type("Handler", (_Handler,), {"rerun_port": rerun_port, "recording": file})
    page, processes = ThreadingHTTPServer((LOOPBACK, 0), handler), Processes(folder)
    threading.Thread(target=page.serve_forever, name="page", daemon=True).start()
    recording = f"http://{LOOPBACK}:{page.server_port}{RECORDING}"
    try:
        rerun = _start_rerun(processes, recording, rerun_port)
        show_address(f"http://{LOOPBACK}:{page.server_port}/?url={quote(recording, safe='')}", console)
        console.print("Ctrl-C ends the view.")
        rerun.process.wait()
    except KeyboardInterrupt:
        console.print()
    finally:
        processes.stop(timeout=STOP_TIMEOUT)
        page.shutdown()


def _start_rerun(processes: Processes, recording: str, port: int) -> Child:
    """Start Rerun with the address of a recording and wait until its page is available at a port."""
    # Rerun stores its own files in this folder and sends no usage data.
    settings = processes.folder / "settings" / "rerun"
    settings.mkdir(parents=True, exist_ok=True)
    (settings / "analytics.json").write_text(json.dumps({
        "analytics_enabled": False, "analytics_id": "", "metadata": {},
        "config_file_path": str(settings / "analytics.json"), "data_dir_path": str(settings)}))
    processes.environment |= dict.fromkeys(
        ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME"), str(settings.parent))
    # The executable is started directly, because it would survive the end of its wrapper script `rerun`. Given a URL,
    # Rerun starts no server for recordings, which would use 3 % of a core while idle.
    executable = importlib.metadata.distribution("rerun-sdk").locate_file("rerun_cli/rerun")
    rerun = processes.start("rerun", [
        str(executable), recording, "--serve-web", "--bind", LOOPBACK,
        "--web-viewer-port", str(port), "--hide-welcome-screen"])
    end = time.monotonic() + READY_TIMEOUT
    while not _accepts_connections(port):
        if rerun.process.poll() is not None or time.monotonic() > end:
            output = rerun.read_last_lines() or "no output"
            raise SuiteError(f"the server of the view did not start: {output} (log: {rerun.log})")
        time.sleep(0.1)
    return rerun


def _accepts_connections(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((LOOPBACK, port)) == 0


def check_rerun(option: str) -> None:
    """Raises SuiteError if rerun-sdk is not installed."""
    if importlib.util.find_spec("rerun") is None:
        raise SuiteError(f"{option}: {RERUN_MISSING}")


def show_address(url: str, console: Console) -> None:
    """Print the address of a view and, on a terminal, open it in the browser."""
    console.out(f"view: {url}", highlight=False)
    if console.is_terminal:
        webbrowser.open(url)


def check_new_rerun_file(option: str, file: Path) -> None:
    """Raises SuiteError for a file that is not .rrd, exists, or cannot be written, and without rerun-sdk."""
    check_rerun(option)
    if file.suffix != ".rrd":
        raise SuiteError(f"{option} {file}: a Rerun recording ends in .rrd")
    try:
        file.touch(exist_ok=False)
    except FileExistsError:
        raise SuiteError(f"{option} {file}: exists already and is not overwritten") from None
    except OSError as error:
        raise SuiteError(f"{option} {file}: cannot be written: {error.strerror}") from None
    file.unlink()
