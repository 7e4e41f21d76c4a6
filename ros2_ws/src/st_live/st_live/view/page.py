"""The server of the live view: Rerun's own on the loopback interface, its page handed on with a policy.

Rerun's page asks four outside addresses (a font, usage data, a release check, an example list). A
Content-Security-Policy makes the browser refuse those: nothing outside this machine is asked.
"""

import argparse
import http.client
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

from st_ros.scheduling import lower

from ..importance import VIEW_NICE

LOOPBACK = "127.0.0.1"
MEMORY = "500MB"  # of the recording kept for a page that is opened later; the oldest goes first
HOP_BY_HOP = {"connection", "keep-alive", "transfer-encoding", "date", "server"}


def policy(data_port: int) -> str:
    """The header's value; data_port: where the page gets the recording from."""
    own = f"'self' http://{LOOPBACK}:{data_port}"
    return (f"default-src 'self' data: blob:; connect-src {own} data: blob:; "
            "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
            "worker-src 'self' blob:")


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    source_port: ClassVar[int]
    policy: ClassVar[str]

    def do_GET(self) -> None:
        try:
            source = http.client.HTTPConnection(LOOPBACK, self.source_port, timeout=30)
            source.request("GET", self.path, headers={"Accept-Encoding": self.headers.get("Accept-Encoding", "")})
            answer = source.getresponse()
        except OSError as error:
            self.send_error(502, f"the viewer's server does not answer: {error}")
            return
        self.send_response(answer.status)
        for name, value in answer.getheaders():
            if name.lower() not in HOP_BY_HOP:
                self.send_header(name, value)
        if answer.length is None:
            self.send_header("Connection", "close")
            self.close_connection = True
        self.send_header("Content-Security-Policy", self.policy)
        self.end_headers()
        shutil.copyfileobj(answer, self.wfile)
        source.close()

    def log_message(self, *_: object) -> None:
        """Quiet."""


def page_server(port: int, source_port: int, data_port: int) -> ThreadingHTTPServer:
    """On the loopback interface. Raises OSError where the port is taken."""
    handler = type("Handler", (_Handler,), {"source_port": source_port, "policy": policy(data_port)})
    return ThreadingHTTPServer((LOOPBACK, port), handler)


def rerun_server(settings: Path, data_port: int, page_port: int, files: list[str]) -> subprocess.Popen:
    """Rerun's server. settings: a folder for its own files, usage data switched off there. files: what it shows."""
    (settings / "rerun").mkdir(parents=True, exist_ok=True)
    (settings / "rerun" / "analytics.json").write_text(json.dumps({
        "analytics_enabled": False, "analytics_id": "", "metadata": {},
        "config_file_path": str(settings / "rerun" / "analytics.json"), "data_dir_path": str(settings / "rerun")}))
    # The program itself: the command `rerun` is a script that would leave it behind.
    found = importlib.util.find_spec("rerun_cli")
    assert found and found.submodule_search_locations
    program = Path(found.submodule_search_locations[0], "rerun")
    command = [str(program), *files, "--serve-web", "--bind", LOOPBACK, "--port", str(data_port), "--web-viewer-port",
               str(page_port), "--server-memory-limit", MEMORY, "--hide-welcome-screen"]
    if shutil.which("setpriv"):
        command = ["setpriv", "--pdeathsig", "TERM", *command]
    own = {"XDG_CONFIG_HOME": str(settings), "XDG_DATA_HOME": str(settings), "XDG_CACHE_HOME": str(settings)}
    return subprocess.Popen(command, env=os.environ | own, stdin=subprocess.DEVNULL)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", help="recordings to show, .rrd")
    parser.add_argument("--settings", type=Path, required=True, help="folder for Rerun's own files")
    for name, what in (("--page-port", "of the page"), ("--data-port", "the viewer draws into, and the page reads"),
                       ("--source-port", "Rerun's own page")):
        parser.add_argument(name, type=int, required=True, help=what)
    options = parser.parse_args()
    server = page_server(options.page_port, options.source_port, options.data_port)
    lower(VIEW_NICE)
    rerun = rerun_server(options.settings, options.data_port, options.source_port, options.files)

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
