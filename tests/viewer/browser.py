"""A headless chromium that looks at a page, and what of a page a test takes hold of."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
SIZE = {"width": 900, "height": 400}
PATIENCE_S = 120.0
"""Wall time: pictures without a graphics card on a busy machine take seconds each."""
PICTURE_S = 20.0
WITHOUT_NOTICES = """addEventListener("DOMContentLoaded", () => {
    const style = document.createElement("style");
    style.textContent = ".mantine-Notifications-root { display: none }";
    document.head.append(style);
})"""
"""viser says that there is no graphics card in a notice that lies over the scene, where the mouse has to go."""


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser of Debian's; without one, or without playwright, the test is skipped."""
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    path = next((found for name in NAMES if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip("needs chromium: apt-get install chromium")
    with api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=path, args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


def open_tab(browser: Any) -> Any:
    """A page that waits as long for the browser as `wait_for` does for what happens."""
    page = browser.new_page(viewport=SIZE)
    page.set_default_timeout(1e3 * PATIENCE_S)
    page.add_init_script(WITHOUT_NOTICES)
    return page


def picture(page: Any, path: Path) -> None:
    """Keeps a picture for people; where the machine is too busy to draw one, says so."""
    from playwright.sync_api import TimeoutError as TooBusy

    try:
        page.screenshot(path=path, timeout=1e3 * PICTURE_S)
    except TooBusy:
        print(f"no {path.name}: the browser drew nothing in {PICTURE_S:g} s")


def wait_for(happened: Callable[[], object], what: str, seconds: float = PATIENCE_S) -> Any:
    """What `happened` gives once it gives anything; fails after so long (s) of wall time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := happened():
            return found
        time.sleep(0.05)
    raise AssertionError(f"waited {seconds:g} s in vain: {what}")


def pixel(camera: Any, point: np.ndarray, width: float, height: float) -> tuple[float, float]:
    """Where in a picture of width x height pixels a point (3,) is; the camera's quaternion turns x right, y down, z
    ahead into the page's frame, its `fov` is vertical."""
    w, x, y, z = camera.wxyz
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    right, down, ahead = turn.T @ (np.asarray(point) - camera.position)
    focal = height / 2 / np.tan(camera.fov / 2)
    return width / 2 + focal * right / ahead, height / 2 + focal * down / ahead


def control(page: Any, label: str) -> Any:
    """The input beside a label of the page."""
    return page.locator(f"xpath=//*[text()='{label}']/following::input[@type='text' or not(@type)][1]")
