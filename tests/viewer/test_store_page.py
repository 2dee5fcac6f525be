"""What a browser shows of a store without a server: each checkpoint as it was."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, expect
from support.files.changing_store import EMPTY, box_at, write_checkpoint
from triquad_tools.viewer.sources import History

from bench.clients.browser import picture, wait_until, wait_until_drawn

_WATCH = """() => {
    window.shown = [];
    new MutationObserver(() => {
        const [, number] = document.body.textContent.match(/(\\d) of 4/) ?? [];
        if (number && number !== shown.at(-1)) shown.push(number);
    }).observe(document.body, {subtree: true, childList: true, characterData: true});
}"""
"""Notes which of four checkpoints a page shows: to look now and then would miss some."""


def test_a_store_is_shown_as_it_was(
    tmp_path: Path, show: Callable[[History], AbstractContextManager[Page]]
) -> None:
    write_checkpoint(tmp_path, 1, EMPTY)
    write_checkpoint(tmp_path, 2, box_at(4, 4))
    write_checkpoint(tmp_path, 3, EMPTY)
    damaged = write_checkpoint(tmp_path, 4, EMPTY)
    damaged.write_bytes(damaged.read_bytes()[:-1000])
    with show(History(tmp_path)) as page:
        expect(page.get_by_text("epoch 3, 2026-01-31T15:00:00Z 3 of 3")).to_be_visible()
        expect(page.get_by_text("epoch-000000004.triquad is left out")).to_be_visible()
        wait_until_drawn(page)
        without_box = picture(page)
        page.get_by_role("button", name="Previous").click()
        expect(page.get_by_text("epoch 2, 2026-01-31T14:00:00Z 2 of 3")).to_be_visible()
        wait_until(page, lambda: _differs(page, without_box) > 500, "the box is drawn")
        # A server goes on.
        write_checkpoint(tmp_path, 5, box_at(-3, 3))
        expect(page.get_by_text("2 of 4")).to_be_visible()
        page.get_by_role("slider").first.focus()
        page.keyboard.press("End")
        expect(page.get_by_text("epoch 5, 2026-01-31T17:00:00Z 4 of 4")).to_be_visible()
        wait_until_drawn(page)
        page.evaluate(_WATCH)
        page.get_by_role("button", name="Play").click()
        wait_until(page, lambda: _shown(page)[-4:] == [1, 2, 3, 4], "all were shown", 4 * 60.0)
        expect(page.get_by_role("button", name="Play")).to_be_visible()
        page.get_by_role("button", name="Play").click()
        expect(page.get_by_text("1 of 4")).to_be_visible()
        page.get_by_role("button", name="Pause").click()
        expect(page.get_by_role("button", name="Play")).to_be_visible()


def _shown(page: Page) -> list[int]:
    """The numbers of the checkpoints that the page has shown, one after the other."""
    return [int(number) for number in page.evaluate("shown")]


def _differs(page: Page, before: np.ndarray) -> int:
    """Pixels of the scene that are not as in a picture before."""
    now = picture(page)
    return int((np.abs(now.astype(int) - before).max(axis=-1) > 30)[250:, :-330].sum())
