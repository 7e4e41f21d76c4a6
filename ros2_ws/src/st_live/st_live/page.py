"""Shows runs in the browser: the passenger's page of a running suite, and Rerun recordings of finished runs.

Rerun's page requests four external addresses (a font, usage data, a release check, an example list). A proxy adds
a Content-Security-Policy that makes the browser block them.
"""

import http.client
import importlib.metadata
import importlib.util
import json
import re
import shutil
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import quote

from rich.console import Console
from rich.markup import escape
from st_ros.scheduling import BACKGROUND_NICE, lower_priority

from .suite import Child, Processes, SuiteError

LOOPBACK, ALL_ADDRESSES = "127.0.0.1", "0.0.0.0"
READY_TIMEOUT = 20.0  # s until a server must accept connections
STOP_TIMEOUT = 3.0  # s until a process that ignores SIGINT is killed
PAGE = Path(__file__).with_name("passenger.html")
# The page is a single file; the browser may fetch nothing but the frames and the clock of this server.
PAGE_POLICY = ("default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; "
               "img-src data:; base-uri 'none'; form-action 'none'")
MAX_CLIENTS = 16
CLIENT_TIMEOUT = 10.0  # s after which a client is disconnected that neither requests nor reads anything
KEEP_ALIVE_PERIOD = 2.0  # s without a frame after which a comment is sent, which fails if the client has left
SEND_BUFFER = 32_768  # bytes, about 0.5 s of frames: a slow client then skips frames instead of showing old ones

REQUEST_TIMEOUT = 30.0  # s until Rerun's server must respond
PROXY_HEADERS = {"connection", "keep-alive", "transfer-encoding", "date", "server"}  # headers set by the proxy
RERUN_POLICY = ("default-src 'self' data: blob:; connect-src 'self' data: blob:; "
                "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
                "worker-src 'self' blob:")
RECORDING_PATH = "/recording.rrd"


class _Handler(BaseHTTPRequestHandler):
    def send_head(self, headers: Mapping[str, str], status: int = 200) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Do not log requests."""


class PageServer(ThreadingHTTPServer):
    """Serves the passenger's page. port: 0 selects a free port. settings: title, models with colours, size of the car.
    Raises OSError if the port is in use or the address does not belong to this host."""

    daemon_threads = True

    def __init__(self, address: str, port: int, settings: Mapping[str, Any]):
        super().__init__((address, port), _PageHandler)
        script = json.dumps(settings).replace("<", "\\u003c")  # so that no title can end the script
        self.page = PAGE.read_text(encoding="utf-8").replace("/*SETTINGS*/null", script).encode()
        self.is_stopped = False
        self.condition = threading.Condition()
        self._frame, self._frame_number = b"", 0
        self.client_count = 0  # number of open pages, protected by `condition`

    def publish(self, frame: Mapping[str, Any]) -> None:
        """Send a frame to every client; a client that is slower than the frames receives only the newest."""
        data = b"data: " + json.dumps(frame, separators=(",", ":")).encode() + b"\n\n"
        with self.condition:
            self._frame, self._frame_number = data, self._frame_number + 1
            self.condition.notify_all()

    def wait_for_frame(self, after: int) -> tuple[bytes, int]:
        """(newest frame, its number) once the number exceeds `after`; else, after KEEP_ALIVE_PERIOD, a comment."""
        with self.condition:
            if self.condition.wait_for(lambda: self._frame_number > after or self.is_stopped, KEEP_ALIVE_PERIOD):
                return self._frame, self._frame_number
            return b":\n\n", after

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors of clients, which may disconnect at any time."""

    def stop(self) -> None:
        with self.condition:
            self.is_stopped = True
            self.condition.notify_all()
        self.shutdown()
        self.server_close()


class _PageHandler(_Handler):
    server: PageServer
    timeout = CLIENT_TIMEOUT
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        # On loopback only local names are permitted, which prevents DNS rebinding.
        name = self.headers.get("Host", "").partition(":")[0]
        if self.server.server_address[0] == LOOPBACK and name not in (LOOPBACK, "localhost"):
            self.send_error(403, "the page is not available under this host name")
        elif self.path.split("?")[0] == "/":
            self._send_content(self.server.page, "text/html; charset=utf-8")
        elif self.path.startswith("/clock"):
            self._send_content(json.dumps(time.monotonic()).encode(), "application/json")
        elif self.path == "/frames":
            self._send_frames()
        else:
            self.send_error(404)

    def _send_content(self, content: bytes, content_type: str) -> None:
        self.send_head({"Content-Type": content_type, "Content-Length": str(len(content)), "Cache-Control": "no-store",
                        "Content-Security-Policy": PAGE_POLICY})
        self.wfile.write(content)

    def _send_frames(self) -> None:
        server = self.server
        with server.condition:
            is_accepted = server.client_count < MAX_CLIENTS
            server.client_count += is_accepted
        if not is_accepted:
            self.send_error(503, f"{MAX_CLIENTS} pages are open already")
            return
        try:
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            self.send_head({"Content-Type": "text/event-stream", "Cache-Control": "no-store"})
            number = 0
            while not server.is_stopped:
                data, number = server.wait_for_frame(number)
                self.wfile.write(data)
        except OSError:
            pass  # the client has left
        finally:
            with server.condition:
                server.client_count -= 1


class LiveView:
    """Serves the passenger's page during a run, if `page` is set or an address (HOST or HOST:PORT) is given, and writes
    the Rerun file `save` (.rrd) afterwards. Raises SuiteError for an address or a file that cannot be used."""

    def __init__(self, page: bool, address: str | None = None, save: Path | None = None):
        host, _, port = (address or LOOPBACK).partition(":")
        if port and not (port.isdecimal() and int(port) <= 65535):
            raise SuiteError(f"--view-address {address}: the port is not a whole number from 0 to 65535")
        try:  # before any node starts
            socket.create_server((host or LOOPBACK, int(port or 0))).close()
        except (OSError, TypeError) as error:  # TypeError: the host cannot be encoded
            raise SuiteError(f"--view-address {address}: {getattr(error, 'strerror', None) or error}; use an address "
                             "of this computer and a free port") from None
        if save is not None:
            check_new_rerun_file("--view-save", save)
        self._page, self._host, self._port = page or address is not None, host or LOOPBACK, int(port or 0)
        self._save = save and save.absolute()

    @contextmanager
    def open(self, folder: Path, domain: int | None, predictor: Mapping[str, Any], title: str,
             console: Console) -> Iterator[str]:
        """Context in which the page is served; prints and yields its address, "" without a page. predictor: parameters
        of the node predictor. Raises SuiteError if the page does not start."""
        if not self._page:
            yield ""
            return
        with Processes(folder, domain) as processes:
            options = {"vehicle": predictor["vehicle_file"], "map_frame": predictor["map_frame"], "title": title,
                       "address": self._host, "port": self._port}
            server = processes.start(
                "passenger", [sys.executable, "-m", "st_live.nodes.passenger", json.dumps(options)])
            if not (line := server.wait_for("serving on ", READY_TIMEOUT)):
                raise SuiteError(f"passenger's page: {server.read_reason() or 'did not start'} (log: {server.log})")
            url = f"http://{_find_reachable_address(self._host)}:{line.strip().rpartition(':')[2]}/"
            show_address(url, console)
            yield url
            if server.process.poll() is not None:
                text = f"the page server stopped during the run: {server.read_reason()}"
                console.out(text, style="yellow", highlight=False)
            processes.stop(timeout=STOP_TIMEOUT)

    def finish(self, folder: Path, console: Console) -> None:
        """Write the Rerun file of --view-save from the recording of the run."""
        if self._save and folder.exists():  # a run that did not start has no folder: `set_aside` renamed it
            from .recorded_view import draw_recording

            draw_recording(folder, self._save)
            console.print(f"  {escape(str(self._save))}  [dim]the run, for `st view`[/dim]", highlight=False,
                          soft_wrap=True)


def _find_reachable_address(host: str) -> str:
    """The host; for ALL_ADDRESSES, the address of the interface of the default route, LOOPBACK if there is none."""
    if host != ALL_ADDRESSES:
        return host
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.connect(("192.0.2.1", 9))  # an address reserved for documentation; no packet is sent
        return probe.getsockname()[0]
    return LOOPBACK


class _RerunHandler(_Handler):
    protocol_version = "HTTP/1.1"
    rerun_port: ClassVar[int]
    recording: ClassVar[Path]

    def do_GET(self) -> None:
        if self.path.partition("?")[0] == RECORDING_PATH:
            with self.recording.open("rb") as stream:
                self.send_head({"Content-Type": "application/octet-stream",
                                "Content-Length": str(self.recording.stat().st_size)})
                shutil.copyfileobj(stream, self.wfile)
            return
        try:
            connection = http.client.HTTPConnection(LOOPBACK, self.rerun_port, timeout=REQUEST_TIMEOUT)
            connection.request("GET", self.path, headers={"Accept-Encoding": self.headers.get("Accept-Encoding", "")})
            response = connection.getresponse()
        except OSError as error:
            self.send_error(502, f"Rerun's server does not respond: {error}")
            return
        headers = {name: value for name, value in response.getheaders() if name.lower() not in PROXY_HEADERS}
        if response.length is None:
            headers["Connection"] = "close"
            self.close_connection = True
        self.send_head(headers | {"Content-Security-Policy": RERUN_POLICY}, response.status)
        shutil.copyfileobj(response, self.wfile)
        connection.close()


def show_recording(folder: Path, file: Path, console: Console) -> None:
    """Serve a recording (.rrd), show its address, and wait until Ctrl-C is pressed or Rerun exits. folder: folder for
    settings and logs. Raises SuiteError if Rerun does not start; call `check_rerun` first."""
    lower_priority(BACKGROUND_NICE)
    proxy, processes = ThreadingHTTPServer((LOOPBACK, 0), _RerunHandler), Processes(folder)
    recording = f"http://{LOOPBACK}:{proxy.server_port}{RECORDING_PATH}"
    try:
        rerun, _RerunHandler.rerun_port = _start_rerun(processes, recording)
        _RerunHandler.recording = file
        threading.Thread(target=proxy.serve_forever, name="proxy", daemon=True).start()
        show_address(f"http://{LOOPBACK}:{proxy.server_port}/?url={quote(recording, safe='')}", console)
        console.print("Press Ctrl-C to stop the viewer.")
        rerun.process.wait()
    except KeyboardInterrupt:
        console.print()
    finally:
        processes.stop(timeout=STOP_TIMEOUT)


def _start_rerun(processes: Processes, recording: str) -> tuple[Child, int]:
    """Start Rerun with the address of a recording; returns its process and the port of its page."""
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
        str(executable), recording, "--serve-web", "--bind", LOOPBACK, "--web-viewer-port", "0",
        "--hide-welcome-screen"])
    if address := re.search(rf"http://{LOOPBACK}:(\d+)", rerun.wait_for(f"http://{LOOPBACK}:", READY_TIMEOUT)):
        return rerun, int(address[1])
    raise SuiteError(f"the Rerun viewer did not start: {rerun.read_reason() or 'no output'} (log: {rerun.log})")


def check_rerun(prefix: str = "") -> None:
    """Raises SuiteError if rerun-sdk is not installed. prefix: start of the message."""
    if importlib.util.find_spec("rerun") is None:
        raise SuiteError(f"{prefix}rerun-sdk is not installed (it needs numpy 2; a sourced ROS has numpy 1); "
                         "RViz, Foxglove and PlotJuggler show the same data, see docs/manual/viewing.md")


def show_address(url: str, console: Console) -> None:
    """Print the address of a view and, on a terminal, open it in the browser."""
    console.out(f"view: {url}", highlight=False)
    if console.is_terminal:
        webbrowser.open(url)


def check_new_rerun_file(option: str, file: Path) -> None:
    """Raises SuiteError for a file that is not .rrd, exists, or cannot be written, and without rerun-sdk."""
    check_rerun(f"{option}: ")
    if file.suffix != ".rrd":
        raise SuiteError(f"{option} {file}: the name of a Rerun recording must end in .rrd")
    try:
        file.touch(exist_ok=False)
    except FileExistsError:
        raise SuiteError(f"{option} {file}: exists already; choose another name") from None
    except OSError as error:
        raise SuiteError(f"{option} {file}: cannot be written: {error.strerror}") from None
    file.unlink()
