"""What a browser shows of slices, unknown space, points and paths."""

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from playwright.sync_api import Browser, Locator, Page, expect
from support.servers import WAIT_S, running_service, sphere
from triquad_client import Client, Status, connect
from triquad_tools.plots.plan import UNKNOWN
from triquad_tools.plots.slice_plan import BEHIND, DISTANCE_COLOURS
from triquad_tools.viewer.sources.live_source import LiveSource
from triquad_tools.viewer.viewer import Viewer

from bench.clients.browser import opened_page, picture, wait_until, wait_until_drawn

TIMEOUT_MS = 60_000
NUMBER = re.compile(r"-?\d+\.\d+")


class Looked(NamedTuple):
    """A page that shows the inside of a sphere, and another client of its server."""

    page: Page
    client: Client


@pytest.fixture(scope="module")
def looked(browser: Browser) -> Iterator[Looked]:
    with running_service() as endpoint, connect(endpoint) as client, connect(endpoint) as watching:
        for _ in range(2):
            client.publish_scan(sphere(30_000), np.eye(4))
        client.flush(WAIT_S)
        viewer = Viewer(LiveSource(watching, endpoint), "127.0.0.1", 0)
        try:
            with opened_page(browser, viewer.url) as page:
                wait_until_drawn(page)
                page.get_by_label("Newest scan").uncheck()
                page.get_by_label("Trail").uncheck()
                yield Looked(page, client)
        finally:
            viewer.close()


def share_of(page: Page, colour: str | tuple[float, ...], tolerance: int = 3) -> float:
    """Share of the scene's pixels that have a colour, below what the page notifies of."""
    wanted = np.round(255 * np.array(to_rgb(colour)))
    scene = picture(page)[250:, :-330].astype(int)
    return float((np.abs(scene - wanted).max(axis=-1) <= tolerance).mean())


def control(page: Page, label: str) -> Locator:
    """The field for a number beside a label."""
    row = page.locator("div.mantine-Flex-root").filter(has=page.get_by_text(label, exact=True))
    return row.last.locator("input").last


def cell(page: Page, name: str) -> str:
    """What a table in the panel says of a name."""
    return page.get_by_role("row", name=name).locator("td").last.inner_text()


def numbers_in(text: str) -> list[float]:
    return [float(number) for number in NUMBER.findall(text)]


def use_clicks(page: Page, use: str) -> None:
    page.get_by_role("combobox", name="A click").click()
    page.get_by_role("option", name=use).click()


def click_at(page: Page, x: int, y: int) -> None:
    page.mouse.move(x, y)
    page.mouse.click(x, y)


def test_a_slice_shows_distances_lines_and_what_is_unknown(looked: Looked) -> None:
    page = looked.page
    far = DISTANCE_COLOURS(1.0)[:3]
    assert share_of(page, UNKNOWN) < 0.001
    page.get_by_label("Show slice").check()
    expect(page.get_by_text("distance to the nearest surface, m")).to_be_visible()
    control(page, "At (m)").fill("0")
    wait_until(page, lambda: share_of(page, far) > 0.002, "the middle is 3 m from the surface")
    assert share_of(page, UNKNOWN) > 0.1
    assert share_of(page, "black", tolerance=40) > 0.0005, "the line of the surface"
    expect(page.get_by_text("≥ 3", exact=True)).to_be_visible()
    expect(page.get_by_text("every 0.5 m from it")).to_be_visible()
    control(page, "Up to (m)").fill("10")
    expect(page.get_by_text("every 2 m from it")).to_be_visible()
    wait_until(page, lambda: share_of(page, far) < 0.0005, "the sphere has no place 10 m inside")
    page.get_by_label("Show slice").uncheck()
    wait_until(page, lambda: share_of(page, UNKNOWN) < 0.001, "the slice is gone")
    expect(page.get_by_text("distance to the nearest surface, m")).to_be_hidden()


def test_an_upright_slice_is_put_through_the_middle_of_the_view(looked: Looked) -> None:
    page = looked.page
    page.get_by_label("Show slice").check()
    page.get_by_role("combobox", name="Slice").click()
    page.get_by_role("option", name="upright, at some y").click()
    wait_until(page, lambda: abs(float(control(page, "At (m)").input_value())) < 1, "y is 0")
    wait_until(page, lambda: share_of(page, UNKNOWN) > 0.05, "what is beside the sphere is grey")
    page.get_by_label("Show slice").uncheck()
    wait_until(page, lambda: share_of(page, UNKNOWN) < 0.001, "the slice is gone")


def test_the_border_of_unknown_space_is_drawn_and_goes(looked: Looked) -> None:
    page, client = looked
    before = picture(page)
    page.get_by_label("Show border").check()
    expect(page.get_by_text("between free and unknown space")).to_be_visible()
    wait_until(page, lambda: _pink(picture(page)) > _pink(before) + 0.01, "something is pink")
    page.get_by_label("Show border").uncheck()
    wait_until(page, lambda: _pink(picture(page)) <= _pink(before) + 0.001, "nothing is pink")


def _pink(pixels: np.ndarray) -> float:
    red, green, blue = pixels[:, :-330].astype(int).transpose(2, 0, 1)
    return float(((red > green + 15) & (blue > green + 8)).mean())


def test_a_click_asks_the_map(looked: Looked) -> None:
    page, client = looked
    control(page, "Raised by (m)").fill("0.75")
    click_at(page, 480, 380)
    raised = page.get_by_role("row", name="raised by")
    expect(raised).to_contain_text("0.75 m", timeout=TIMEOUT_MS)
    place = numbers_in(cell(page, "position"))
    assert np.linalg.norm(np.array(place) - [0, 0, 0.75]) == pytest.approx(4.0, abs=0.1)
    answer = client.query_distance([place], 10.0)
    assert numbers_in(cell(page, "distance")) == [pytest.approx(answer.distance_m[0], abs=0.002)]
    assert numbers_in(cell(page, "gradient")) == pytest.approx(answer.gradient[0], abs=0.02)
    assert cell(page, "status") == Status(answer.status[0]).name
    assert numbers_in(cell(page, "confidence")) == [pytest.approx(answer.confidence[0], abs=0.01)]
    wait_until(page, lambda: _magenta(page) > 2e-5, "the marker is drawn")
    click_at(page, 12, 480)
    expect(page.get_by_text("No surface there: sky")).to_be_visible()
    wait_until(page, lambda: _magenta(page) == 0, "the marker is gone")


def _magenta(page: Page) -> float:
    red, green, blue = picture(page)[250:, :-330].astype(int).transpose(2, 0, 1)
    return float(((red > green + 60) & (blue > green + 30)).mean())


def test_a_path_is_laid_checked_and_blocked_as_the_map_goes_on(looked: Looked) -> None:
    page, client = looked
    control(page, "Raised by (m)").fill("2.5")
    points = []
    for x, y in ((400, 400), (560, 420)):
        click_at(page, x, y)
        expect(page.get_by_role("row", name="raised by")).to_contain_text("2.50 m")
        if points:
            wait_until(page, lambda: _position(page) != points[0], "the next point is shown")
        points.append(_position(page))
    use_clicks(page, "adds to the path")
    expect(page.get_by_text("Click at the first point.")).to_be_visible()
    control(page, "Radius (m)").fill("0.1")
    click_at(page, 400, 400)
    expect(page.get_by_text("One point: click at the next.")).to_be_visible()
    click_at(page, 560, 420)
    expect(page.get_by_role("row", name="least clearance")).to_be_visible()
    whole = client.query_polyline(points, 0.1, 1.0)
    assert whole.free()
    assert numbers_in(cell(page, "path")) == [pytest.approx(whole.length_m, abs=0.011)]
    least = numbers_in(cell(page, "least clearance"))
    assert least[:1] in ([], [pytest.approx(whole.clearance_m, abs=0.02)])
    expect(page.get_by_role("row", name="free all along")).to_contain_text("with radius 0.1 m")
    assert share_of(page, BEHIND, tolerance=40) < 1e-5

    pose = np.eye(4)
    pose[:3, 3] = points[1]
    for _ in range(3):
        client.publish_scan(sphere(30_000, radius_m=1.7), pose)  # a ball around the second point
    assert client.flush(WAIT_S).refused == 0
    expect(page.get_by_role("row", name="blocked")).to_be_visible(timeout=TIMEOUT_MS)

    def newest() -> bool:
        contact_m = client.query_polyline(points, 0.1, 1.0).contact_m
        return numbers_in(cell(page, "blocked")) == [pytest.approx(contact_m, abs=0.02)]

    wait_until(page, newest, "the path is blocked where the map says that it is")
    wait_until(
        page, lambda: share_of(page, BEHIND, tolerance=40) > 5e-5, "what is blocked stands out"
    )

    page.get_by_role("button", name="Undo last point").click()
    expect(page.get_by_text("One point: click at the next.")).to_be_visible()
    page.get_by_role("button", name="Clear path").click()
    expect(page.get_by_text("Click at the first point.")).to_be_visible()
    wait_until(page, lambda: share_of(page, BEHIND, tolerance=40) < 1e-5, "the path is gone")


def _position(page: Page) -> list[float]:
    return numbers_in(cell(page, "position"))
