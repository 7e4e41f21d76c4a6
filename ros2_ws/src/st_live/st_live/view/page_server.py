"""HTTP server of the passenger's page: the page itself, a clock to compare with, and frames as server-sent events."""

import json
import socket
import threading
import time
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

PAGE = Path(__file__).with_name("passenger.html")
# The page is one file: nothing else is loaded, from this host or another.
POLICY = ("default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; "
          "img-src data:; base-uri 'none'; form-action 'none'")
LOOPBACK = "127.0.0.1"
MAX_CLIENTS = 16
CLIENT_TIMEOUT = 10.0  # s until a client that reads nothing is dropped
KEEP_ALIVE = 2.0  # s without a frame until a comment is sent, which detects clients that have left
SEND_BUFFER = 32_768  # bytes, about 0.5 s of frames: a slow client skips frames instead of seeing old ones


class PageServer(ThreadingHTTPServer):
    """Serves the page on an address. Raises OSError if the port is in use or the address is not of this host.

    settings: constants of the page (title, models with colours, size of the car). port 0: a free one.
    """

    daemon_threads = True

    def __init__(self, address: str, port: int, settings: Mapping[str, Any]):
        super().__init__((address, port), _Handler)
        script = json.dumps(settings).replace("<", "\\u003c")  # a title cannot end the script
        self.page = PAGE.read_text(encoding="utf-8").replace("/*SETTINGS*/null", script).encode()
        self.ended = False
        self._condition = threading.Condition()
        self._frame, self._number, self._clients = b"", 0, 0

    @property
    def port(self) -> int:
        return self.server_address[1]

    def publish(self, frame: Mapping[str, Any]) -> None:
        """Send a frame to every client; a client that is slower than the frames gets only the newest."""
        data = b"data: " + json.dumps(frame, separators=(",", ":")).encode() + b"\n\n"
        with self._condition:
            self._frame, self._number = data, self._number + 1
            self._condition.notify_all()

    @property
    def clients(self) -> int:
        return self._clients

    def next_frame(self, after: int) -> tuple[bytes, int]:
        """(frame, its number) newer than number `after`; an empty comment after KEEP_ALIVE without one."""
        with self._condition:
            if self._condition.wait_for(lambda: self._number > after or self.ended, KEEP_ALIVE):
                return self._frame, self._number
            return b":\n\n", after

    def enter(self) -> bool:
        """Count a further client; False if there are MAX_CLIENTS."""
        with self._condition:
            accepted = self._clients < MAX_CLIENTS
            self._clients += accepted
            return accepted

    def leave(self) -> None:
        with self._condition:
            self._clients -= 1

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Clients that disconnect are normal."""

    def stop(self) -> None:
        with self._condition:
            self.ended = True
            self._condition.notify_all()
        self.shutdown()
        self.server_close()


class _Handler(BaseHTTPRequestHandler):
    server: PageServer

    def do_GET(self) -> None:
        if not self._is_addressed_here():
            self.send_error(403, "this host is not served under that name")
        elif self.path.split("?")[0] == "/":
            self._answer(self.server.page, "text/html; charset=utf-8")
        elif self.path.startswith("/clock"):
            self._answer(json.dumps(time.monotonic()).encode(), "application/json")
        elif self.path == "/frames":
            self._stream()
        else:
            self.send_error(404)

    def _is_addressed_here(self) -> bool:
        """On loopback, a page of another site could read frames through a name that resolves to 127.0.0.1."""
        name = self.headers.get("Host", "").rpartition(":")[0]
        return self.server.server_address[0] != LOOPBACK or name in (LOOPBACK, "localhost")

    def _answer(self, content: bytes, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", POLICY)
        self.end_headers()
        self.wfile.write(content)

    def _stream(self) -> None:
        if not self.server.enter():
            self.send_error(503, f"{MAX_CLIENTS} pages are open already")
            return
        try:
            self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            self.connection.settimeout(CLIENT_TIMEOUT)
            self.send_response(200)
            self.send_header("Content-Type", "text/event-stream")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            number = 0
            while not self.server.ended:
                data, number = self.server.next_frame(number)
                self.wfile.write(data)
        except OSError:
            pass  # the client has left
        finally:
            self.server.leave()

    def log_message(self, *_: object) -> None:
        """No log of requests."""
