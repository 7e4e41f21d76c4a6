"""The view of a running suite: the passenger's page during the run, a Rerun recording of it afterwards."""

import atexit
import socket
import sys
import time
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from ..suite import Child, Processes, SuiteError

LOOPBACK = "127.0.0.1"
ALL_ADDRESSES = "0.0.0.0"
READY_TIMEOUT = 20.0  # s
STOP_TIMEOUT = 3.0  # s until the process is killed


class LiveView:
    """page: serve the passenger's page. address: HOST or HOST:PORT of this computer to listen on. save: file to draw
    the recording into after the run, .rrd. Raises SuiteError for an address or a file that cannot be used."""

    def __init__(self, page: bool, address: str | None = None, save: Path | None = None):
        host, _, port = (address or LOOPBACK).partition(":")
        if (not port.isdecimal() and port) or (port and int(port) > 65535):
            raise SuiteError(f"--view-address {address}: the port is not a number up to 65535")
        if save is not None:
            check_new_rerun_file("--view-save", save)
        self._page, self._host, self._port = page or address is not None, host, int(port or 0)
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
        atexit.register(self.close)  # however the run ends
        self._server = self._processes.start("passenger", [
            sys.executable, "-m", "st_live.nodes.passenger", "--vehicle", predictor["vehicle_file"], "--map-frame",
            predictor["map_frame"], "--title", title, "--address", self._host, "--port", str(self._port)])
        self.url = f"http://{_reachable(self._host)}:{self._wait_for_port(self._server)}/"
        console.print(f"view: {self.url}", highlight=False, soft_wrap=True)
        if console.is_terminal:
            webbrowser.open(self.url)

    def _wait_for_port(self, server: Child) -> str:
        end = time.monotonic() + READY_TIMEOUT
        while time.monotonic() < end and server.process.poll() is None:
            if (line := server.last_lines(1)).startswith("serving on "):
                return line.rpartition(":")[2]
            time.sleep(0.05)
        raise SuiteError(f"--view: {server.last_lines() or 'the page did not start'} (log: {server.log})")

    def finish(self, folder: Path, console: Console) -> None:
        """After the run: end the page, and draw the recording of the run into the file of --view-save."""
        if self._server and self._server.process.poll() is not None:
            console.print(f"[yellow]the page ended before the run: {escape(self._server.last_lines())}[/yellow]",
                          highlight=False, soft_wrap=True)
        self.close()
        if self._save:
            from .recorded import draw

            draw(folder, self._save)
            console.print(f"  {escape(str(self._save))}  [dim]the run, for `st view`[/dim]", highlight=False,
                          soft_wrap=True)

    def close(self) -> None:
        if self._processes is not None:
            self._processes.stop(timeout=STOP_TIMEOUT)
            self._processes = None


def check_new_rerun_file(option: str, file: Path) -> None:
    """Raises SuiteError for a file that is not .rrd, exists, or cannot be written, and without rerun-sdk."""
    from .rerun_server import check_rerun

    check_rerun(option)
    if file.suffix != ".rrd":
        raise SuiteError(f"{option} {file}: a Rerun recording ends in .rrd")
    try:
        file.touch(exist_ok=False)
    except FileExistsError:
        raise SuiteError(f"{option} {file}: exists already (nothing is ever overwritten)") from None
    except OSError as error:
        raise SuiteError(f"{option} {file}: cannot be written: {error.strerror}") from None
    file.unlink()


def _reachable(host: str) -> str:
    """Address for another device: of the interface with the default route where all are listened on."""
    if host != ALL_ADDRESSES:
        return host
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # a documentation address; no packet is sent
            return probe.getsockname()[0]
        except OSError:
            return LOOPBACK
