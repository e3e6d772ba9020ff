"""The page of `neurosim view --web` in a browser, as a person sees it."""

from __future__ import annotations

import io
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import PIL.Image
import pytest
import trimesh
from fake_simulator import HEIGHT, MS, WIDTH, FakeSimulator
from numpy.typing import NDArray
from processes import SOON_S

from cortex import messages as msg
from neurosim_core.view.pictures import OFF_SRGB, ON_SRGB

CHROMIUM = shutil.which("chromium")
OPTIONS = [
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--js-flags=--liftoff-only",
]
SEEN_S = 120.0
"""Deadline of the first picture; 20 s where nothing else runs."""
BAR_PX = 3

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("runtime"),
    pytest.mark.skipif(CHROMIUM is None, reason="needs a browser: apt-get install chromium"),
]


def bar_of_events(k: int) -> msg.Events:
    """A bar that has moved to the right in window k of 100 ms: red where it comes, blue where it was."""
    left = 4 + 2 * k % 20
    rows, columns = np.mgrid[4 : HEIGHT - 4, left : left + 2 * BAR_PX]
    x, y = (np.tile(a.ravel(), 4) for a in (columns, rows))  # four times: in full colour
    return msg.Events(
        stamp_ns=(k + 1) * 100 * MS,
        start_ns=k * 100 * MS,
        t=np.full(len(x), k * 100_000 + 1),
        x=x.astype(np.uint16),
        y=y.astype(np.uint16),
        polarity=(x >= left + BAR_PX).astype(np.uint8),
        width=WIDTH,
        height=HEIGHT,
        sequence=k,
    )


@contextmanager
def publishing(simulator: FakeSimulator) -> Iterator[None]:
    """Publish bars, ten a second."""
    stop = threading.Event()

    def publish() -> None:
        k = 0
        while not stop.wait(0.1):
            simulator.state(20 * k)
            simulator.sensors["dvs"].publish(bar_of_events(k))
            simulator.status(100 * MS * k)
            k += 1

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def find_bar(shot: NDArray[np.uint8]) -> tuple[float, float] | None:
    """Where the two colours of events are side by side on white, in the column of pictures.

    Args:
        shot: The page, shape [H, W, 3].

    Returns:
        Mean columns of the darker and the brighter events [px]; None if there are no such.
    """
    height, width = shot.shape[:2]
    panel = shot[height // 20 : height * 2 // 3, width * 3 // 4 :].astype(int)
    red, blue, white = (
        (np.abs(panel - np.array(c)) < 40).all(axis=2) for c in (ON_SRGB, OFF_SRGB, (255,) * 3)
    )
    if min(red.mean(), blue.mean()) < 0.01 or white.mean() < 0.2:
        return None
    return float(np.nonzero(blue)[1].mean()), float(np.nonzero(red)[1].mean())


def look(take: Callable[[], bytes], enough: Callable[[set[tuple[float, float]]], bool]) -> None:
    """Take pictures of the page until enough has been seen."""
    seen: set[tuple[float, float]] = set()
    deadline_s = time.monotonic() + SEEN_S
    while not enough(seen):
        assert time.monotonic() < deadline_s, f"the page does not show moving events; seen at {sorted(seen)}"
        with PIL.Image.open(io.BytesIO(take())) as shot:
            found = find_bar(np.asarray(shot.convert("RGB")))
        if found is not None:
            seen.add(found)


def test_the_page_shows_events_that_move(tmp_path):
    """Red and blue on white beside each other, at several places in time."""
    browsers = pytest.importorskip(
        "playwright.sync_api", reason="needs something that drives a browser: pip install playwright"
    )
    scene = tmp_path / "box.glb"
    trimesh.creation.box((20, 20, 3)).export(scene)
    command = [sys.executable, "-m", "neurosim_core", "view", "--web", "--no-browser", "--only", "dvs"]
    with (
        subprocess.Popen([*command, "--event-window", "0.1"], stdout=subprocess.PIPE, text=True) as viewer,
        FakeSimulator(str(scene)) as simulator,
    ):
        try:
            assert viewer.stdout is not None
            address = re.match(r"open (http://127\.0\.0\.1:\d+/)\n", viewer.stdout.readline())
            assert address is not None
            simulator.announce()
            with publishing(simulator), browsers.sync_playwright() as driver:
                browser: Any = driver.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
                page = browser.new_page(viewport={"width": 600, "height": 420})
                page.goto(address[1])

                def take() -> bytes:
                    picture: bytes = page.screenshot(timeout=SEEN_S * 1e3)
                    return picture

                look(take, lambda seen: len(seen) >= 3 and all(blue < red for blue, red in seen))
                browser.close()
            viewer.send_signal(signal.SIGTERM)
            assert viewer.wait(SOON_S) == 130
        finally:
            viewer.kill()


@pytest.mark.parametrize("color", [(255, 255, 255), (0, 0, 0), ON_SRGB])
def test_a_blank_page_shows_nothing(color):
    assert find_bar(np.full((700, 1000, 3), color, dtype=np.uint8)) is None
