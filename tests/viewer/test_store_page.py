"""What a browser shows of a store without a server: each checkpoint, and what changed."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, expect
from support.files.changing_store import EMPTY, box_at, write_checkpoint
from triquad_tools.viewer.sources.history import History

from bench.clients.browser import picture, wait_until, wait_until_drawn

SKY_BLUE, VERMILION = (86, 180, 233), (213, 94, 0)


def test_a_store_is_shown_as_it_was_and_what_changed(
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
        page.get_by_role("checkbox", name="Show changes").check()
        expect(page.get_by_text("vanished (V): free space in epoch 3")).to_be_visible()
        expect(page.get_by_text("1 vanished")).to_be_visible()
        wait_until(page, lambda: _pixels(page, VERMILION) > 50, "the box is outlined")
        assert _pixels(page, SKY_BLUE) < 20
        page.get_by_role("button", name="Previous").click()
        expect(page.get_by_text("epoch 2, 2026-01-31T14:00:00Z 2 of 3")).to_be_visible()
        expect(page.get_by_text("1 appeared")).to_be_visible()
        wait_until(page, lambda: _pixels(page, SKY_BLUE) > 50, "the box is outlined")
        page.get_by_role("combobox", name="Since").click()
        page.get_by_role("option", name="epoch 3").click()
        expect(page.get_by_text("1 vanished")).to_be_visible()  # from the box to the later epoch
        page.get_by_role("checkbox", name="Show changes").uncheck()
        expect(page.get_by_text("1 vanished")).to_be_hidden()
        wait_until(page, lambda: _pixels(page, VERMILION) < 20, "nothing is outlined")
        wait_until(page, lambda: _differs(page, without_box) > 500, "the box is drawn")
        # A server goes on.
        write_checkpoint(tmp_path, 5, box_at(-3, 3))
        expect(page.get_by_text("2 of 4")).to_be_visible()
        page.get_by_role("slider").first.focus()
        page.keyboard.press("End")
        expect(page.get_by_text("epoch 5, 2026-01-31T17:00:00Z 4 of 4")).to_be_visible()
        wait_until_drawn(page)


def _differs(page: Page, before: np.ndarray) -> int:
    """Pixels of the scene that are not as in a picture before."""
    now = picture(page)
    return int((np.abs(now.astype(int) - before).max(axis=-1) > 30)[250:, :-330].sum())


def _pixels(page: Page, colour: tuple[int, int, int]) -> int:
    """Pixels of the scene in about a colour: the browser makes bright ones duller."""
    scene = picture(page)[250:, :-330].astype(int)
    return int((np.abs(scene - colour).max(axis=-1) < 40).sum())
