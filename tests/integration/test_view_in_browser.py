"""The live view as a person sees it: in a browser, while the virtual Leaf drives circles to the left."""

import asyncio
import os
import re
import signal
import subprocess
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")
pytest.importorskip("rerun", reason="not beside a sourced ROS")

from browser import Browser, program
from PIL import Image
from st_core.palette import MODEL_COLOUR, rgb
from support import ROOT

pytestmark = [
    pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(400),
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
MODELS = ("kinematic", "linear", "nonlinear")
SIZE = (1100, 700)
DRIVING = 200  # s; the test ends it before
PATIENCE = 150.0  # s for a first whole picture, with software rendering on two cores
# Left of the page's middle, above its plots and below its titles: the view from the driver's seat.
SEAT = (slice(70, 400), slice(0, 460))


def pixels(picture: Path, colour: str) -> np.ndarray:
    """(row, column) of the points of a colour in the view from the driver's seat."""
    seat = np.asarray(Image.open(picture).convert("RGB"), int)[SEAT]
    return np.argwhere(np.abs(seat - rgb(colour)).max(axis=-1) <= 12)


def drawn(picture: Path) -> bool:
    """Whether all models have a path: more than the dot beside the name."""
    return all(len(pixels(picture, MODEL_COLOUR[m])) > 60 for m in ("kinematic", "nonlinear"))


async def look(url: str, folder: Path) -> tuple[list[Path], Browser]:
    """Three pictures: the first that shows everything, and two later ones."""
    async with Browser(folder, SIZE) as browser:
        await browser.open(url)
        pictures, end = [], time.monotonic() + PATIENCE
        while len(pictures) < 3:
            picture = folder / f"view_{len(pictures)}.png"
            await asyncio.sleep(2.0)
            await browser.picture(picture)
            if drawn(picture):
                pictures.append(picture)
            assert time.monotonic() < end, f"nothing drawn in {PATIENCE:.0f} s: {browser.console[-3:]}"
        return pictures, browser


@pytest.mark.skipif(program() is None, reason="no Chromium: apt install chromium")
def test_three_paths_bend_to_the_left_and_move_and_nobody_else_is_asked(tmp_path: Path) -> None:
    command = [str(ROOT / "st"), "demo", "--view", "--scenario", "S2", "--duration", str(DRIVING), "--output",
               str(tmp_path / "run")]
    log = tmp_path / "demo.log"
    with log.open("wb") as stream:
        demo = subprocess.Popen(command, cwd=ROOT, stdout=stream, stderr=stream, start_new_session=True)
    try:
        end = time.monotonic() + 90
        while not (found := re.search(r"view: (\S+)", log.read_text())):
            assert demo.poll() is None and time.monotonic() < end, log.read_text()
            time.sleep(0.2)
        pictures, browser = asyncio.run(look(found.group(1), tmp_path))
    finally:
        if demo.poll() is None:
            os.kill(demo.pid, signal.SIGINT)
        demo.wait(90)
    for picture in pictures:
        ahead = np.concatenate([pixels(picture, MODEL_COLOUR[m]) for m in MODELS])
        middle = 0.5 * (SEAT[1].stop - SEAT[1].start)
        # Of what is coloured above the car and not in the corner of names: a left circle lies to the left.
        path = ahead[ahead[:, 0] < 0.68 * (SEAT[0].stop - SEAT[0].start)]
        assert len(path) > 30 and np.mean(path[:, 1] < middle) > 0.9
    images = [np.asarray(Image.open(p).convert("L"), int) for p in pictures]
    assert all(np.abs(a - b).max() > 50 for a, b in pairwise(images))
    outside = [u for u in browser.requested if not u.startswith(("http://127.0.0.1:", "data:", "blob:"))]
    # The browser asked for nothing outside that the page's policy did not stop.
    assert len(outside) <= len(browser.refused)
    assert any("Content Security Policy" in line for line in browser.console)
