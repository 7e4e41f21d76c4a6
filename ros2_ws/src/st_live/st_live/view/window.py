"""Opens and closes the live view of a run: two processes beside the suite, whose end or silence ends nothing else."""

import atexit
import importlib.util
import socket
import sys
import time
import webbrowser
from pathlib import Path
from urllib.parse import quote

from rich.console import Console
from rich.markup import escape

from ..suite import Child, Processes, SuiteError
from .page import LOOPBACK

READY_TIMEOUT = 20.0  # s
STOP_TIMEOUT = 3.0  # s; what does not end by then, stopped perhaps, is killed
WITHOUT_RERUN = ("rerun-sdk is not installed here (beside a sourced ROS its numpy 2 does not fit): "
                 "RViz, Foxglove and PlotJuggler show the same, see docs/manual/viewing.md")


def window(page: bool, save: Path | None) -> "Window | None":
    """The view that --view and --view-save ask for. Raises SuiteError."""
    return Window(page, save) if page or save else None


def finish(view: "Window | None", console: Console) -> None:
    """After the run's last word: close the view; on a terminal the page stays up until Ctrl-C."""
    if view is not None:
        view.finish(console)


class Window:
    """page: serve it for a browser. save: a recording to write, .rrd. Raises SuiteError where either cannot be."""

    def __init__(self, page: bool, save: Path | None = None):
        if importlib.util.find_spec("rerun") is None:
            raise SuiteError(f"--view: {WITHOUT_RERUN}")
        if save is not None and save.suffix != ".rrd":
            raise SuiteError(f"--view-save {save}: a Rerun recording ends in .rrd")
        if save is not None:
            try:
                save.touch(exist_ok=False)
            except FileExistsError:
                raise SuiteError(f"--view-save {save}: exists already (nothing is ever overwritten)") from None
            except OSError as error:
                raise SuiteError(f"--view-save {save}: cannot be made: {error.strerror}") from None
            save.unlink()
        self._page, self._save = page, save and save.absolute()
        self._processes: Processes | None = None
        self._viewer: Child | None = None
        self._server: Child | None = None
        self.url = ""

    def open(self, folder: Path, domain: int | None, vehicle: str, map_frame: str, title: str,
             console: Console) -> None:
        """Start it and say where it is. Raises SuiteError when it does not come up."""
        processes = self._start(folder, domain)
        settings = folder / "logs" / "viewer"
        # Rerun writes its settings where it is told, and nowhere else.
        processes.environment |= {"XDG_CONFIG_HOME": str(settings), "XDG_DATA_HOME": str(settings)}
        command = [sys.executable, "-m", "st_live.nodes.viewer", "--vehicle", vehicle, "--map-frame", map_frame,
                   "--title", title]
        if self._page:
            data = self._serve(processes, settings, [])
            command += ["--server", f"rerun+http://{LOOPBACK}:{data}/proxy"]
        if self._save:
            command += ["--save", str(self._save)]
        self._viewer = processes.start("viewer", command)
        self._announce(console)

    def show(self, folder: Path, files: list[Path], console: Console) -> None:
        """Serve recordings (.rrd, .mcap) without a run. Raises SuiteError."""
        self._serve(self._start(folder, None), folder / "settings", [str(f.absolute()) for f in files])
        self._announce(console)

    def _start(self, folder: Path, domain: int | None) -> Processes:
        self._processes = Processes(folder, domain)
        atexit.register(self.close)  # whatever becomes of the run
        return self._processes

    def _serve(self, processes: Processes, settings: Path, files: list[str]) -> int:
        page, data, source = free_ports(3)
        ports = ["--page-port", str(page), "--data-port", str(data), "--source-port", str(source)]
        self._server = processes.start("view_server", [
            sys.executable, "-m", "st_live.view.page", *files, "--settings", str(settings), *ports])
        end = time.monotonic() + READY_TIMEOUT
        while not all(map(listens, (page, data, source))):
            if self._server.process.poll() is not None or time.monotonic() > end:
                words = self._server.last_lines() or "no output"
                raise SuiteError(f"the viewer's server did not start: {words} (log: {self._server.log})")
            time.sleep(0.1)
        self.url = f"http://{LOOPBACK}:{page}/?url={quote(f'rerun+http://{LOOPBACK}:{data}/proxy', safe='')}"
        return data

    def _announce(self, console: Console) -> None:
        if self.url:
            console.print(f"view: {self.url}", highlight=False, soft_wrap=True)
            if console.is_terminal:
                webbrowser.open(self.url)

    def finish(self, console: Console) -> None:
        """The run is over: close the recording; on a terminal the page stays up until Ctrl-C."""
        if self._processes is None:
            return
        trouble = [c for c in (self._viewer, self._server) if c and c.process.poll() is not None]
        for child in trouble:
            console.print(f"[yellow]the view ended before the run did: {escape(child.last_lines())}[/yellow]",
                          highlight=False, soft_wrap=True)
        self._processes.stop("viewer", STOP_TIMEOUT)
        if self._save and self._save.exists():
            console.print(f"  {escape(str(self._save))}  [dim]the view, for `st view`[/dim]", highlight=False,
                          soft_wrap=True)
        if console.is_terminal and not trouble:
            self.linger(console)

    def linger(self, console: Console) -> None:
        """Until Ctrl-C, or the server ends."""
        if not self._server:
            return
        console.print("The view stays open to look back in time; Ctrl-C closes it.")
        try:
            self._server.process.wait()
        except KeyboardInterrupt:
            console.print()

    @property
    def pids(self) -> list[int]:
        """Of its processes, those they started not counted."""
        return [child.process.pid for child in self._processes.children] if self._processes else []

    def close(self) -> None:
        if self._processes is not None:
            self._processes.stop(timeout=STOP_TIMEOUT)
            self._processes = None


def free_ports(count: int) -> list[int]:
    """TCP ports nobody listens on at the moment."""
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
