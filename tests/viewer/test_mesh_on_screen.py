"""What a browser shows of the mesh of a server."""

import re
from collections.abc import Callable
from functools import partial

import numpy as np
from playwright.sync_api import Page, expect
from support import servers
from support.servers import learn, running_service, sphere
from triquad_client import connect
from triquad_format.records.arrays import Bytes
from triquad_tools.recordings.publishing import wait_until_settled

from bench.clients.browser import drawn_share, picture, wait_until, wait_until_drawn

GONE = re.compile("no server has a map|the link to the server is down")
"""Whichever of both is found out first."""

PageOf = Callable[[str], Page]


def test_a_mesh_appears_once_there_is_one(page_of: PageOf) -> None:
    with running_service() as endpoint, connect(endpoint) as client:
        page = page_of(endpoint)
        expect(page.get_by_text("default at tcp/")).to_be_visible()
        assert drawn_share(page) == 0.0
        learn(client)
        wait_until_drawn(page)
        # The camera frames all there is.
        drawn = np.argwhere(picture(page)[250:, :-330].min(axis=-1) < 200)
        assert np.ptp(drawn, axis=0).min() > 100


def test_the_mesh_grows_while_somebody_looks(page_of: PageOf) -> None:
    with running_service() as endpoint, connect(endpoint) as client:
        learn(client)
        page = page_of(endpoint)
        wait_until_drawn(page)
        upper = page.get_by_text("≥ 4")
        expect(upper).to_be_visible()
        above = np.eye(4)
        above[2, 3] = 6.0
        client.publish_scan(sphere(), above)
        expect(upper).to_be_hidden(timeout=60_000)  # the scale of heights goes on


def test_colours_say_what_the_legend_says(page_of: PageOf) -> None:
    with running_service() as endpoint, connect(endpoint) as client:
        learn(client)
        wait_until_settled(client)  # ages change no more
        page = page_of(endpoint)
        wait_until_drawn(page)
        page.get_by_label("Newest scan").uncheck()  # it hides the mesh
        expect(page.get_by_text("height, m")).to_be_visible()
        for name, legend in (("age", "epochs since it changed"), ("confidence", "confidence")):
            before = _scene(page)
            page.get_by_role("combobox", name="Colour").click()
            page.get_by_role("option", name=name).click()
            expect(page.get_by_text(legend, exact=True).first).to_be_visible()
            wait_until(page, partial(_most_differs, page, before), f"colours are those of {name}")


def test_a_server_that_is_gone_is_told_of_until_it_is_back(page_of: PageOf) -> None:
    endpoint = servers.free_endpoint()
    with running_service(endpoint=endpoint) as _, connect(endpoint) as client:
        learn(client)
        page = page_of(endpoint)
        wait_until_drawn(page)
        expect(page.get_by_text(GONE)).to_be_hidden()
    expect(page.get_by_text(GONE)).to_be_visible(timeout=60_000)
    assert drawn_share(page) > 0.005, "what is known stays"
    with running_service(endpoint=endpoint), connect(endpoint) as client:
        expect(page.get_by_text("0 taken")).to_be_visible(timeout=60_000)


def test_nothing_is_left_of_a_map_that_is_reset(page_of: PageOf) -> None:
    with running_service() as endpoint, connect(endpoint) as client:
        learn(client)
        page = page_of(endpoint)
        wait_until_drawn(page)
        client.reset()
        wait_until(page, lambda: drawn_share(page) == 0.0, "nothing is drawn")


def _most_differs(page: Page, before: Bytes) -> bool:
    """Whether most of what was drawn has another colour now."""
    change = np.abs(_scene(page).astype(np.int64) - before).max(axis=-1)
    return bool((change[before.min(axis=-1) < 200] > 24).mean() > 0.5)


def _scene(page: Page) -> Bytes:
    """What is drawn beside the panel, [height, width, 3]."""
    return picture(page)[250:, :-330]
