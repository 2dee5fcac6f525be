"""A page shows that poses are being corrected, and the trail as it was before."""

import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, expect
from support import servers
from support.poses import shifted
from triquad_client import Client, connect
from triquad_tools.viewer.sources import LiveSource

from bench.clients.browser import picture, wait_until, wait_until_drawn

Show = Callable[[LiveSource], AbstractContextManager[Page]]

SCANS, APART_M, OFF_M = 3, 2.0, 3.0
STAMPS_S = [1e9 + number for number in range(SCANS)]
CORRECTING = f"correcting {SCANS} scans: regions are made again"
BEFORE = "trail before the correction"


@contextmanager
def correction_held(client: Client) -> Iterator[None]:
    """Have all scans moved to y = 0; regions are made again once the context ends."""
    log, go_on = logging.getLogger("triquad_server.store.pose_corrector"), threading.Event()

    def held(record: logging.LogRecord) -> bool:
        return "regions are made again" not in record.getMessage() or go_on.wait(servers.WAIT_S)

    poses = [shifted(APART_M * number) for number in range(SCANS)]
    log.addFilter(held)
    log.setLevel(logging.INFO)
    try:
        with ThreadPoolExecutor() as pool:
            reply = pool.submit(client.correct_poses, "roof", STAMPS_S, poses)
            try:
                yield
            finally:
                go_on.set()
            assert reply.result().scans_moved == SCANS
    finally:
        log.setLevel(logging.NOTSET)
        log.removeFilter(held)


def has_grey(page: Page) -> bool:
    """Whether a grey line is drawn, below what the page notifies of and next to the panel."""
    scene = picture(page)[250:, :-330].astype(int)
    is_grey = (np.ptp(scene, axis=-1) < 6) & (scene.max(axis=-1) < 200)
    return bool(is_grey.sum() > 50)


def only_trail(page: Page) -> None:
    for name in ("Show mesh", "Newest scan"):
        page.get_by_role("checkbox", name=name).uncheck()
    wait_until(page, lambda: not has_grey(page), "the mesh is drawn no more")


def test_a_correction_is_told_of_and_the_trail_of_before_stays(show: Show, tmp_path: Path) -> None:
    with (
        servers.running_service(servers.LOGGED, store=tmp_path) as endpoint,
        connect(endpoint) as client,
        connect(endpoint) as watching,
        show(LiveSource(watching, endpoint)) as page,
    ):
        for number, stamp_s in enumerate(STAMPS_S):
            pose = shifted(APART_M * number, OFF_M)
            client.publish_scan(servers.sphere(), pose, stamp_s, source="roof")
        client.flush()
        expect(page.get_by_text(f"now at {APART_M * (SCANS - 1):.1f}, {OFF_M:.1f}")).to_be_visible()
        wait_until_drawn(page)
        only_trail(page)
        expect(page.get_by_text(BEFORE)).to_be_hidden()
        with correction_held(client):
            expect(page.get_by_text(CORRECTING)).to_be_visible()
            assert not has_grey(page)
        expect(page.get_by_text(CORRECTING)).to_be_hidden()
        expect(page.get_by_text(f"now at {APART_M * (SCANS - 1):.1f}, 0.0")).to_be_visible()
        expect(page.get_by_text(BEFORE)).to_be_visible()
        wait_until(page, partial(has_grey, page), "the trail of before is drawn")
        page.get_by_role("checkbox", name="Trail").uncheck()
        wait_until(page, lambda: not has_grey(page), "neither trail is drawn")
        page.reload()
        wait_until_drawn(page)
        expect(page.get_by_text(f"now at {APART_M * (SCANS - 1):.1f}, 0.0")).to_be_visible()
        only_trail(page)
        expect(page.get_by_text(BEFORE)).to_be_hidden()
