"""A headless browser: Chromium, as the system has it, and what its pages show."""

import io
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright
from triquad_format.records.arrays import Bytes
from triquad_tools.console.command import ToolError

WIDTH, HEIGHT = 1280, 720
_PANEL_PIXELS = 330  # at the right
_BRIGHT = 200  # of a pixel in which nothing is drawn
_NOTHING = 0.005  # share of pixels
_SOFTWARE_RENDERING = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


def installed() -> str:
    """Return where Chromium is.

    Raises:
        ToolError: it is not installed.
    """
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        raise ToolError("Chromium is not installed: apt-get install chromium")
    return path


@contextmanager
def running_browser() -> Iterator[Browser]:
    """Yield Chromium, which draws in software.

    Raises:
        ToolError: it is not installed.
    """
    path = installed()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=_SOFTWARE_RENDERING)
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened_page(browser: Browser, url: str) -> Iterator[Page]:
    """Yield a page in a window of its own."""
    context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT})
    page = context.new_page()
    page.goto(url)
    page.wait_for_selector("canvas")
    try:
        yield page
    finally:
        context.close()


def picture(page: Page) -> Bytes:
    """Return what the page shows now, [height, width, 3]."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


def drawn_share(page: Page) -> float:
    """Return the share of the pixels next to the panel in which something is drawn."""
    scene = picture(page)[HEIGHT // 3 :, :-_PANEL_PIXELS]  # what it notifies of stands above
    return float((scene.min(axis=-1) < _BRIGHT).mean())


def wait_until_drawn(page: Page) -> None:
    """Wait until something is drawn.

    Raises:
        ToolError: nothing is.
    """
    wait_until(page, lambda: drawn_share(page) > _NOTHING, "something is drawn")


def wait_until(page: Page, holds: Callable[[], bool], what: str, timeout_s: float = 60.0) -> None:
    """Wait until a condition on what a page shows is true; ``what`` says it in words.

    Raises:
        ToolError: it does not.
    """
    ends = time.monotonic() + timeout_s
    while not holds():
        if time.monotonic() > ends:
            raise ToolError(f"after {timeout_s:g} s it is not so that {what}")
        page.wait_for_timeout(100)
