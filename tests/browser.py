"""Headless Chromium, controlled through its DevTools port: opens a page, captures it, and lists its requests."""

import asyncio
import base64
import json
import os
import shutil
import subprocess
import urllib.request
from pathlib import Path

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run",
         "--disable-background-networking", "--disable-component-update", "--remote-debugging-port=0",
         "--remote-debugging-address=127.0.0.1")


def program() -> str | None:
    return next(filter(None, map(shutil.which, PROGRAMS)), None)


def _priority_prefix() -> list[str]:
    """Prefix of the command that gives Chromium a lower priority than the nodes; as root it would raise its own."""
    without = ["setpriv", "--bounding-set", "-sys_nice"] if os.geteuid() == 0 and shutil.which("setpriv") else []
    return [*without, "nice", "-n", "5"]


class Browser:
    """A separate browser with one page. Use as `async with`."""

    def __init__(self, folder: Path, size: tuple[int, int] = (1600, 1000)):
        self._folder, self._size = folder, size
        self.requested: list[str] = []  # requested addresses
        self.console: list[str] = []
        self._number = 0
        self._answers: dict[int, asyncio.Future] = {}

    async def __aenter__(self) -> "Browser":
        from tornado.websocket import websocket_connect

        command = [*_priority_prefix(), program(), *FLAGS, f"--window-size={self._size[0]},{self._size[1]}",
                   f"--user-data-dir={self._folder / 'profile'}", "about:blank"]
        with (self._folder / "browser.log").open("wb") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log)
        port_file = self._folder / "profile" / "DevToolsActivePort"
        for _ in range(300):
            if port_file.exists() and port_file.read_text().count("\n") >= 1:
                break
            await asyncio.sleep(0.1)
        port = int(port_file.read_text().split()[0])
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            page = next(p for p in json.load(answer) if p["type"] == "page")
        self._socket = await websocket_connect(page["webSocketDebuggerUrl"], max_message_size=100_000_000)
        self._reader = asyncio.ensure_future(self._read())
        for domain in ("Page", "Network", "Runtime", "Log"):
            await self._call(f"{domain}.enable")
        return self

    async def __aexit__(self, *_: object) -> None:
        self._reader.cancel()
        self._socket.close()
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    async def open(self, url: str) -> None:
        await self._call("Page.navigate", url=url)

    async def emulate(self, width: int, height: int, dark: bool = False) -> None:
        """Sets the size of the window in pixels (below 500: a phone) and the colour scheme."""
        await self._call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1,
                         mobile=width < 500)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        await self._call("Emulation.setEmulatedMedia", features=[scheme])

    async def evaluate(self, expression: str) -> object:
        """Value of a JavaScript expression, JSON-able."""
        answer = await self._call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        return answer["result"].get("value")

    async def picture(self, file: Path) -> None:
        answer = await self._call("Page.captureScreenshot", format="png")
        file.write_bytes(base64.b64decode(answer["data"]))

    async def _call(self, method: str, **parameters: object) -> dict:
        self._number += 1
        number, future = self._number, asyncio.get_running_loop().create_future()
        self._answers[number] = future
        await self._socket.write_message(json.dumps({"id": number, "method": method, "params": parameters}))
        return await asyncio.wait_for(future, 300)

    async def _read(self) -> None:
        while (text := await self._socket.read_message()) is not None:
            message = json.loads(text)
            if "id" in message:
                answer = self._answers.pop(message["id"])
                if "error" in message:
                    answer.set_exception(RuntimeError(f"the browser: {message['error']}"))
                else:
                    answer.set_result(message["result"])
            elif message["method"] == "Network.requestWillBeSent":
                self.requested.append(message["params"]["request"]["url"])
            elif message["method"] == "Runtime.consoleAPICalled":
                self.console.append(" ".join(str(a.get("value", a.get("description", "")))
                                             for a in message["params"]["args"]))
            elif message["method"] == "Log.entryAdded":
                self.console.append(message["params"]["entry"]["text"])
