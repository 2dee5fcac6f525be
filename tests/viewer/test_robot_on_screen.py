"""What a browser shows of the robot, and of how its server is doing."""

from collections.abc import Callable

import numpy as np
from playwright.sync_api import Page, expect
from support.servers import running_service, sphere
from triquad_client import Client, connect

from bench.clients.browser import picture, wait_until, wait_until_drawn


def test_trail_newest_scan_and_figures(page_of: Callable[[str], Page]) -> None:
    with running_service() as endpoint, connect(endpoint) as client:
        page = page_of(endpoint)
        expect(page.get_by_text("No scan has come yet.")).to_be_visible()
        drive(client)
        expect(page.get_by_text("roof: 5 scans, now at 4.0, 0.0, 0.0 m")).to_be_visible()
        expect(page.get_by_text("5 taken, 0 waiting")).to_be_visible()
        expect(page.get_by_text("answers in")).to_be_visible()
        wait_until_drawn(page)
        wait_until(page, lambda: orange(page) > 200, "trail and scan are drawn")
        for name in ("Trail", "Newest scan"):
            page.get_by_role("checkbox", name=name).uncheck()
        wait_until(page, lambda: orange(page) < 20, "neither is drawn")


def drive(client: Client) -> None:
    for x in range(5):
        pose = np.eye(4)
        pose[0, 3] = x
        client.publish_scan(sphere(), pose, source="roof")
    client.flush()


def orange(page: Page) -> int:
    """Pixels in the colour of the first source."""
    red, green, blue = picture(page)[250:, :-330].astype(int).transpose(2, 0, 1)
    return int(((red > 170) & (green > 50) & (green < 150) & (blue < 90)).sum())
