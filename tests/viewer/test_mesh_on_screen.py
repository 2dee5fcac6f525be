"""What a browser shows of a server: the mesh, the robot, and how it is doing."""

import re
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from support import servers
from support.servers import learn, running_service, sphere
from triquad_client import Client, connect
from triquad_format.records.arrays import Bytes
from triquad_tools.recordings.publishing import wait_until_settled

from bench.clients.browser import drawn_share, picture, wait_until, wait_until_drawn

GONE = re.compile("no server has a map|the link to the server is down")
"""Whichever of both is found out first."""

PageOf = Callable[[str], Page]


def test_a_map_is_watched_from_its_first_scan_to_its_reset(page_of: PageOf) -> None:
    with running_service() as endpoint, connect(endpoint) as client:
        page = page_of(endpoint)
        expect(page.get_by_text("default at tcp/")).to_be_visible()
        expect(page.get_by_text("No scan has come yet.")).to_be_visible()
        assert drawn_share(page) == 0.0
        _drive(client)
        expect(page.get_by_text("roof: 5 scans, now at 4.0, 0.0, 0.0 m")).to_be_visible()
        expect(page.get_by_text("5 taken, 0 waiting")).to_be_visible()
        expect(page.get_by_text("answers in")).to_be_visible()
        wait_until_drawn(page)
        wait_until(page, lambda: _orange(page) > 200, "trail and scan are drawn")
        # The camera frames all there is.
        drawn = np.argwhere(_scene(page).min(axis=-1) < 200)
        assert np.ptp(drawn, axis=0).min() > 100
        for name in ("Trail", "Newest scan"):
            page.get_by_role("checkbox", name=name).uncheck()
        wait_until(page, lambda: _orange(page) < 20, "neither is drawn")

        upper = page.get_by_text("≥ 4")
        expect(page.get_by_text("height, m")).to_be_visible()
        expect(upper).to_be_visible()
        above = np.eye(4)
        above[2, 3] = 6.0
        client.publish_scan(sphere(), above)
        expect(upper).to_be_hidden()  # the scale of heights goes on

        wait_until_settled(client)
        wait_until(page, partial(_is_still, page), "the mesh has come")
        before = _scene(page)
        page.get_by_role("combobox", name="Colour").click()
        page.get_by_role("option", name="confidence").click()
        expect(page.get_by_text("confidence", exact=True).first).to_be_visible()
        wait_until(page, partial(_most_differs, page, before), "colours are those of confidence")
        client.reset()
        wait_until(page, lambda: drawn_share(page) == 0.0, "nothing is drawn")


@pytest.mark.long
def test_a_server_that_is_gone_is_told_of_until_it_is_back(page_of: PageOf) -> None:
    endpoint = servers.free_endpoint()
    with running_service(endpoint=endpoint) as _, connect(endpoint) as client:
        learn(client)
        page = page_of(endpoint)
        wait_until_drawn(page)
        expect(page.get_by_text(GONE)).to_be_hidden()
    expect(page.get_by_text(GONE)).to_be_visible()
    assert drawn_share(page) > 0.005, "what is known stays"
    with running_service(endpoint=endpoint), connect(endpoint) as client:
        expect(page.get_by_text("0 taken")).to_be_visible()


def _drive(client: Client) -> None:
    for x in range(5):
        pose = np.eye(4)
        pose[0, 3] = x
        client.publish_scan(sphere(), pose, source="roof")
    client.flush()


def _most_differs(page: Page, before: Bytes) -> bool:
    """Whether most of what was drawn has another colour now."""
    change = np.abs(_scene(page).astype(np.int64) - before).max(axis=-1)
    return bool((change[before.min(axis=-1) < 200] > 24).mean() > 0.5)


def _is_still(page: Page) -> bool:
    """Whether the picture stays as it is for two seconds."""
    before = _scene(page)
    page.wait_for_timeout(2000)
    return bool((_scene(page) == before).all())


def _orange(page: Page) -> int:
    """Pixels in the colour of the first source."""
    red, green, blue = _scene(page).astype(int).transpose(2, 0, 1)
    return int(((red > 170) & (green > 50) & (green < 150) & (blue < 90)).sum())


def _scene(page: Page) -> Bytes:
    """What is drawn at the panel's side, [height, width, 3]."""
    return picture(page)[250:, :-330]
