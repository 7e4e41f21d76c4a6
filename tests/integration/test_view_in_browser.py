"""The passenger's page in headless Chromium, on a phone, a tablet and a laptop, while the virtual Leaf drives."""

import asyncio
import os
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from browser import Browser, program
from PIL import Image
from st_core.palette import MODEL_COLOUR, rgb
from support import ROOT

pytestmark = [
    pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(400),
    pytest.mark.skipif(program() is None, reason="no Chromium: apt install chromium"),
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
DURATION = 200  # s; the test ends the drive earlier
SIZES = [(390, 844), (1024, 768), (1400, 900)]
MEASURING_TIME = 8.0  # s, per size
AGES = "window.ages = []; setInterval(() => window.ages.push(picture.age()), 100); 0"


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[subprocess.Popen, str]]:
    """(process, address of the page) of a demo of left circles."""
    folder = tmp_path_factory.mktemp("page")
    command = [str(ROOT / "st"), "demo", "--view", "--scenario", "S2", "--duration", str(DURATION), "--output",
               str(folder / "run")]
    log = folder / "demo.log"
    with log.open("wb") as stream:
        process = subprocess.Popen(command, cwd=ROOT, stdout=stream, stderr=stream, start_new_session=True)
    try:
        end = time.monotonic() + 90
        while not (found := re.search(r"view: (\S+)", log.read_text())):
            assert process.poll() is None and time.monotonic() < end, log.read_text()
            time.sleep(0.2)
        yield process, found.group(1)
    finally:
        if process.poll() is None:
            os.kill(process.pid, signal.SIGINT)
        process.wait(90)


async def wait_until(browser: Browser, condition: str) -> None:
    end = time.monotonic() + 60
    while not await browser.evaluate(condition):
        assert time.monotonic() < end, f"{condition}: {browser.console[-3:]}"
        await asyncio.sleep(0.2)


async def measure(demo: subprocess.Popen, url: str, folder: Path) -> tuple[dict, Browser]:
    """Frame rate, overflow and screenshot at each size, ages of the data, and the state after the server has ended."""
    found: dict = {}
    async with Browser(folder) as browser:
        await browser.open(url)
        await wait_until(browser, "typeof picture !== 'undefined' && Number.isFinite(picture.age())")
        await browser.evaluate(AGES)
        for size in SIZES:
            await browser.emulate(*size, dark=size[0] == 1024)
            before, begin = await browser.evaluate("picture.drawn"), time.monotonic()
            await asyncio.sleep(MEASURING_TIME)
            after, seconds = await browser.evaluate("picture.drawn"), time.monotonic() - begin
            await browser.picture(folder / f"page_{size[0]}.png")
            overflow = await browser.evaluate("document.documentElement.scrollWidth - innerWidth")
            found[size[0]] = (after - before) / seconds, overflow
        found["ages"] = await browser.evaluate("window.ages")
        found["text"] = await browser.evaluate("document.body.innerText")
        (server,) = (p for p in psutil.Process(demo.pid).children(recursive=True)
                     if "st_live.nodes.passenger" in p.cmdline())
        server.kill()
        await asyncio.sleep(3.0)
        found["age_after_end"] = await browser.evaluate("picture.age()")
        found["light"] = await browser.evaluate("document.querySelector('#light b').textContent")
        return found, browser


def test_page_shows_current_predictions_at_every_size_and_an_error_after_the_end(demo, tmp_path: Path) -> None:
    found, browser = asyncio.run(measure(*demo, tmp_path))
    for width, _ in SIZES:
        rate, overflow = found[width]
        assert rate > 7.0 and overflow <= 0, (width, found[width])
    assert np.median(found["ages"]) < 0.5
    # The age increases after the end of the server.
    assert found["age_after_end"] > 2.5 and found["light"].lower() == "error"
    for word in ("RTK integer", "km/h", "left", "nonlinear"):
        assert word in found["text"]
    assert {u.split("/")[2] for u in browser.requested if u.startswith("http")} == {demo[1].split("/")[2]}
    for width, height in (SIZES[0], SIZES[2]):
        # On a left circle the swath is to the left of the car.
        picture = np.asarray(Image.open(tmp_path / f"page_{width}.png").convert("RGB"), float)
        road = picture[: height if width > 800 else height // 2, : width - 440 if width > 800 else width]
        background = np.array([251.0, 251.0, 249.0])
        swath = background + 0.38 * (np.array(rgb(MODEL_COLOUR["nonlinear"])) - background)
        columns = np.argwhere(np.abs(road - swath).max(axis=-1) < 12)[:, 1]
        assert len(columns) > 500 and np.mean(columns < 0.5 * road.shape[1] + 10) > 0.9, (width, len(columns))
