"""Serves the passenger's page of a running suite, and writes a Rerun recording of the run after its end."""

import atexit
import json
import socket
import sys
import threading
import time
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from .rerun_server import LOOPBACK, READY_TIMEOUT, STOP_TIMEOUT, check_new_rerun_file, show_address
from .suite import Child, Processes, SuiteError

PAGE = Path(__file__).with_name("passenger.html")
# The page is a single file; the browser may fetch only frames and clock from this server, and nothing else.
POLICY = ("default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; "
          "img-src data:; base-uri 'none'; form-action 'none'")
MAX_CLIENTS = 16
CLIENT_TIMEOUT = 10.0  # s until a client that neither requests nor reads anything is dropped
KEEP_ALIVE_PERIOD = 2.0  # s without a frame until a comment is sent, which fails if the client has left
SEND_BUFFER = 32_768  # bytes, about 0.5 s of frames: a slow client then skips frames instead of showing old ones
ALL_ADDRESSES = "0.0.0.0"


class PageServer(ThreadingHTTPServer):
    """Serves the page. Raises OSError if the port is in use or the address does not belong to this host.

    port: 0 selects a free port. settings: constants of the page: title, models with colours, size of the car.
    """

    daemon_threads = True

    def __init__(self, address: str, port: int, settings: Mapping[str, Any]):
        super().__init__((address, port), _Handler)
        script = json.dumps(settings).replace("<", "\\u003c")  # so that no title can end the script
        self.page = PAGE.read_text(encoding="utf-8").replace("/*SETTINGS*/null", script).encode()
        self.ended = False
        self.condition = threading.Condition()
        self._frame, self._frame_number = b"", 0
        self.clients = 0  # number of open pages, protected by `condition`

    @property
    def port(self) -> int:
        return self.server_address[1]

    def publish(self, frame: Mapping[str, Any]) -> None:
        """Send a frame to every client; a client that is slower than the frames receives only the newest."""
        data = b"data: " + json.dumps(frame, separators=(",", ":")).encode() + b"\n\n"
        with self.condition:
            self._frame, self._frame_number = data, self._frame_number + 1
            self.condition.notify_all()

    def wait_for_frame(self, after: int) -> tuple[bytes, int]:
        """Wait for a frame after number `after` or for the stop; (frame, number), a comment after KEEP_ALIVE_PERIOD."""
        with self.condition:
            if self.condition.wait_for(lambda: self._frame_number > after or self.ended, KEEP_ALIVE_PERIOD):
                return self._frame, self._frame_number
            return b":\n\n", after

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors of clients, which may disconnect at any time."""

    def stop(self) -> None:
        with self.condition:
            self.ended = True
            self.condition.notify_all()
        self.shutdown()
        self.server_close()


class _Handler(BaseHTTPRequestHandler):
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
        self.send_response(200)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", POLICY)
        self.end_headers()
        self.wfile.write(content)

    def _send_frames(self) -> None:
        server = self.server
        with server.condition:
            accepted = server.clients < MAX_CLIENTS
            server.clients += accepted
        if not accepted:
            self.send_error(503, f"{MAX_CLIENTS} pages are open already")
            return
        try:
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            self.send_response(200)
            self.send_header("Content-Type", "text/event-stream")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            number = 0
            while not server.ended:
                data, number = server.wait_for_frame(number)
                self.wfile.write(data)
        except OSError:
            pass  # the client has left
        finally:
            with server.condition:
                server.clients -= 1

    def log_message(self, *_: object) -> None:
        """Do not log requests."""


class LiveView:
    """Serves the passenger's page during a run, if `page` is set or an address (HOST or HOST:PORT) is given, and writes
    the Rerun file `save` (.rrd) afterwards. Raises SuiteError for an address or a file that cannot be used."""

    def __init__(self, page: bool, address: str | None = None, save: Path | None = None):
        host, _, port = (address or LOOPBACK).partition(":")
        if port and not (port.isdecimal() and int(port) <= 65535):
            raise SuiteError(f"--view-address {address}: the port is not a whole number from 0 to 65535")
        if save is not None:
            check_new_rerun_file("--view-save", save)
        self._page, self._host, self._port = page or address is not None, host or LOOPBACK, int(port or 0)
        self._save = save and save.absolute()
        self._processes: Processes | None = None
        self._server: Child | None = None
        self.url = ""

    def open(self, folder: Path, domain: int | None, predictor: Mapping[str, Any], title: str,
             console: Console) -> None:
        """Start the page and print its address. predictor: parameters of that node. Raises SuiteError on failure."""
        if not self._page:
            return
        self._processes = Processes(folder, domain)
        atexit.register(self.close)  # also if the run ends with an error
        self._server = self._processes.start("passenger", [
            sys.executable, "-m", "st_live.nodes.passenger", "--vehicle", predictor["vehicle_file"], "--map-frame",
            predictor["map_frame"], "--title", title, "--address", self._host, "--port", str(self._port)])
        line = self._server.wait_for("serving on ", READY_TIMEOUT)
        if not line:
            output = self._server.read_last_lines() or "the page did not start"
            raise SuiteError(f"--view: {output} (log: {self._server.log})")
        self.url = f"http://{_find_reachable_address(self._host)}:{line.strip().rpartition(':')[2]}/"
        show_address(self.url, console)

    def finish(self, folder: Path, console: Console) -> None:
        """Stop the page server, and write the Rerun file of --view-save from the recording of the run."""
        if self._server and self._server.process.poll() is not None:
            text = f"the page ended before the run: {self._server.read_last_lines()}"
            console.out(text, style="yellow", highlight=False)
        self.close()
        if self._save:
            from .recorded_view import draw_recording

            draw_recording(folder, self._save)
            console.print(f"  {escape(str(self._save))}  [dim]the run, for `st view`[/dim]", highlight=False,
                          soft_wrap=True)

    def close(self) -> None:
        if self._processes is not None:
            self._processes.stop(timeout=STOP_TIMEOUT)
            self._processes = None


def _find_reachable_address(host: str) -> str:
    """The host; for ALL_ADDRESSES, the address of the interface of the default route, LOOPBACK if there is none."""
    if host != ALL_ADDRESSES:
        return host
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # a documentation address; no packet is sent
            return probe.getsockname()[0]
        except OSError:
            return LOOPBACK
