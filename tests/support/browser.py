"""A real browser without a screen: Chromium, as the system has it."""

import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

WIDTH, HEIGHT = 1000, 700
_SOFTWARE_RENDERING = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


@contextmanager
def running_browser() -> Iterator[Browser]:
    """Chromium; the test is skipped where it is not installed."""
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        pytest.skip("Chromium is not installed: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=_SOFTWARE_RENDERING)
        yield browser
        browser.close()


@contextmanager
def opened_page(browser: Browser, url: str) -> Iterator[Page]:
    """A page in a window of its own."""
    context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT})
    page = context.new_page()
    page.goto(url)
    yield page
    context.close()


def picture(page: Page) -> NDArray[np.uint8]:
    """What the page shows now, [height, width, 3]."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
