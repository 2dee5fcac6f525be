"""What a browser shows of a server: the mesh, the robot, and the answers to questions.

All tests look at one page. Each leaves it as it was, so that any of them may run alone.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, suppress
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from playwright.sync_api import Locator, Page, expect
from support import servers
from support.poses import shifted
from support.servers import WAIT_S, learn, running_service, sphere
from triquad_client import Client, Status, connect
from triquad_format.records.arrays import Bytes
from triquad_tools.console.command import ToolError
from triquad_tools.plots.colours import BEHIND, DISTANCES, UNKNOWN
from triquad_tools.recordings.publishing import wait_until_settled
from triquad_tools.viewer.sources import LiveSource

from bench.clients.browser import drawn_share, picture, wait_until, wait_until_drawn

TIMEOUT_MS = 60_000
NUMBER = re.compile(r"-?\d+\.\d+")
GONE = re.compile("no server has a map|the link to the server is down")
"""Whichever of both is found out first."""

Show = Callable[[LiveSource], AbstractContextManager[Page]]


class Looked(NamedTuple):
    """A page that shows the inside of a sphere, and another client of its server."""

    page: Page
    client: Client


@pytest.fixture(scope="module")
def looked(show: Show) -> Iterator[Looked]:
    with (
        running_service() as endpoint,
        connect(endpoint) as client,
        connect(endpoint) as watching,
        show(LiveSource(watching, endpoint)) as page,
    ):
        yield Looked(page, client)


@pytest.fixture
def mapped(looked: Looked) -> Looked:
    """The same page, which shows the mesh of the sphere alone."""
    page, client = looked
    if client.status().regions == 0:
        publish_sphere(client)
        wait_until_settled(client)
    hide_scans(page)
    wait_until_drawn(page)
    return looked


def publish_sphere(client: Client) -> None:
    for _ in range(2):
        client.publish_scan(sphere(30_000), np.eye(4), source="roof")
    client.flush(WAIT_S)


def hide_scans(page: Page) -> None:
    for name in ("Trail", "Newest scan"):
        page.get_by_role("checkbox", name=name).uncheck()


def scene(page: Page) -> Bytes:
    """What is drawn at the panel's side, [height, width, 3], below what the page notifies of."""
    return picture(page)[250:, :-330]


def share_of(page: Page, colour: str | tuple[float, ...], tolerance: int = 3) -> float:
    """Share of the scene's pixels that have a colour."""
    wanted = np.round(255 * np.array(to_rgb(colour)))
    return float((np.abs(scene(page).astype(int) - wanted).max(axis=-1) <= tolerance).mean())


def share_where(page: Page, holds: Callable[..., Bytes]) -> float:
    """Share of the scene's pixels of which something holds, given red, green and blue."""
    return float(holds(*scene(page).astype(int).transpose(2, 0, 1)).mean())


def is_orange(red: Bytes, green: Bytes, blue: Bytes) -> Bytes:
    """The colour of the first source."""
    return (red > 170) & (green > 50) & (green < 150) & (blue < 90)


def is_magenta(red: Bytes, green: Bytes, blue: Bytes) -> Bytes:
    return (red > green + 60) & (blue > green + 30)


def is_pink(red: Bytes, green: Bytes, blue: Bytes) -> Bytes:
    return (red > green + 15) & (blue > green + 8)


def control(page: Page, label: str) -> Locator:
    """The field for a number beside a label."""
    row = page.locator("div.mantine-Flex-root").filter(has=page.get_by_text(label, exact=True))
    return row.last.locator("input").last


def choose(page: Page, label: str, option: str) -> None:
    page.get_by_role("combobox", name=label).click()
    page.get_by_role("option", name=option).click()


def cell(page: Page, name: str) -> str:
    """What a table in the panel says of a name."""
    return page.get_by_role("row", name=name).locator("td").last.inner_text()


def numbers_in(text: str) -> list[float]:
    return [float(number) for number in NUMBER.findall(text)]


def click_until(page: Page, place: tuple[int, int], holds: Callable[[], bool], what: str) -> None:
    """Click once more where a page that draws slowly has not taken the click."""
    for last in (False, False, True):
        page.mouse.move(*place)
        page.mouse.click(*place)
        with suppress(() if last else ToolError):
            wait_until(page, holds, what, timeout_s=60.0 if last else 20.0)
            return


def test_a_map_is_watched_from_its_first_scan(looked: Looked) -> None:
    page, client = looked
    expect(page.get_by_text("default at tcp/")).to_be_visible()
    expect(page.get_by_text("0 scans; nothing to learn yet; epoch 1")).to_be_visible()
    assert drawn_share(page) == 0.0
    expect(page.get_by_text("nothing was seen yet")).to_be_visible()
    publish_sphere(client)
    expect(page.get_by_text("roof: 2 scans, now at 0.0, 0.0, 0.0 m")).to_be_visible()
    expect(page.get_by_text(re.compile(r"2 scans; \d+ % learnt; "))).to_be_visible()
    wait_until_drawn(page)
    wait_until(page, lambda: share_where(page, is_orange) > 5e-4, "the scan is drawn")
    # The camera frames all there is.
    drawn = np.argwhere(scene(page).min(axis=-1) < 200)
    assert np.ptp(drawn, axis=0).min() > 100
    hide_scans(page)
    wait_until(page, lambda: share_where(page, is_orange) < 5e-5, "neither is drawn")
    expect(page.get_by_text("height, m")).to_be_visible()
    expect(page.get_by_text("≥ 4")).to_be_visible()


def test_colours_are_those_that_are_chosen(mapped: Looked) -> None:
    page, client = mapped
    wait_until_settled(client)
    wait_until(page, partial(_is_still, page), "the mesh has come")
    before = scene(page)

    def most_differs() -> bool:
        change = np.abs(scene(page).astype(np.int64) - before).max(axis=-1)
        return bool((change[before.min(axis=-1) < 200] > 24).mean() > 0.5)

    choose(page, "Colour", "confidence")
    expect(page.get_by_text("confidence", exact=True).first).to_be_visible()
    wait_until(page, most_differs, "colours are those of confidence")
    choose(page, "Colour", "height")
    wait_until(page, lambda: not most_differs(), "colours are those of heights")


def _is_still(page: Page) -> bool:
    """Whether the picture stays as it is for a second."""
    before = scene(page)
    page.wait_for_timeout(1000)
    return bool((scene(page) == before).all())


def test_a_slice_shows_distances_lines_and_what_is_unknown(mapped: Looked) -> None:
    page, far = mapped.page, DISTANCES(1.0)[:3]
    assert share_of(page, UNKNOWN) < 0.001
    page.get_by_label("Show slice").check()
    expect(page.get_by_text("distance to the nearest surface, m")).to_be_visible()
    control(page, "At (m)").fill("0")
    wait_until(page, lambda: share_of(page, far) > 0.002, "the middle is 3 m from the surface")
    assert share_of(page, UNKNOWN) > 0.1
    assert share_of(page, "black", tolerance=40) > 0.0005, "the line of the surface"
    expect(page.get_by_text("every 0.5 m from it")).to_be_visible()
    choose(page, "Slice", "upright, at some y")
    wait_until(page, lambda: abs(float(control(page, "At (m)").input_value())) < 1, "y is 0")
    wait_until(page, lambda: share_of(page, UNKNOWN) > 0.05, "what is beside the sphere is grey")
    page.get_by_label("Show slice").uncheck()
    wait_until(page, lambda: share_of(page, UNKNOWN) < 0.001, "the slice is gone")
    expect(page.get_by_text("distance to the nearest surface, m")).to_be_hidden()


def test_the_border_of_unknown_space_is_drawn_and_goes(mapped: Looked) -> None:
    page = mapped.page
    before = share_where(page, is_pink)
    page.get_by_label("Show border").check()
    expect(page.get_by_text("between free and unknown space")).to_be_visible()
    wait_until(page, lambda: share_where(page, is_pink) > before + 0.01, "something is pink")
    page.get_by_label("Show border").uncheck()
    wait_until(page, lambda: share_where(page, is_pink) <= before + 0.001, "nothing is pink")


def test_the_view_tells_its_scale_and_direction(mapped: Looked) -> None:
    page, _ = mapped
    expect(page.get_by_text("m in the middle")).to_be_visible(timeout=TIMEOUT_MS)
    expect(page.get_by_text("x axis; the view looks")).to_be_visible()


def test_a_click_asks_the_map(mapped: Looked) -> None:
    page, client = mapped
    control(page, "Raised by (m)").fill("0.75")
    raised = page.get_by_role("row", name="raised by")
    click_until(page, (480, 380), raised.is_visible, "a surface was met")
    expect(raised).to_contain_text("0.75 m", timeout=TIMEOUT_MS)
    place = numbers_in(cell(page, "position"))
    assert np.linalg.norm(np.array(place) - [0, 0, 0.75]) == pytest.approx(4.0, abs=0.2)
    answer = client.query_distance([place], 10.0)
    assert numbers_in(cell(page, "distance")) == [pytest.approx(answer.distance_m[0], abs=0.002)]
    assert numbers_in(cell(page, "gradient")) == pytest.approx(answer.gradient[0], abs=0.02)
    assert cell(page, "status") == Status(answer.status[0]).name
    wait_until(page, lambda: share_where(page, is_magenta) > 2e-5, "the marker is drawn")
    sky = page.get_by_text("No surface there: sky")
    click_until(page, (12, 480), sky.is_visible, "no surface was met")
    wait_until(page, lambda: share_where(page, is_magenta) == 0, "the marker is gone")


def test_a_path_is_laid_checked_and_blocked_as_the_map_goes_on(mapped: Looked) -> None:
    page, client = mapped
    control(page, "Raised by (m)").fill("2.5")
    choose(page, "A click", "adds to the path")
    control(page, "Radius (m)").fill("0.1")
    points: list[list[float]] = []
    for place in ((400, 400), (560, 420)):
        click_until(page, place, lambda: _shown_point(page) not in (None, *points), "it is shown")
        points.append(_position(page))
    expect(page.get_by_role("row", name="least clearance")).to_be_visible()
    whole = client.query_polyline(points, 0.1, 1.0)
    assert whole.free()
    assert numbers_in(cell(page, "path")) == [pytest.approx(whole.length_m, abs=0.011)]
    least = numbers_in(cell(page, "least clearance"))
    assert least[:1] in ([], [pytest.approx(whole.clearance_m, abs=0.02)])
    expect(page.get_by_role("row", name="free all along")).to_contain_text("with radius 0.1 m")
    assert share_of(page, BEHIND, tolerance=40) < 1e-5

    for _ in range(3):  # a ball around the second point
        client.publish_scan(sphere(30_000, radius_m=1.7), shifted(*points[1]))
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
    expect(page.get_by_role("row", name="least clearance")).to_be_hidden()
    page.get_by_role("button", name="Clear path").click()
    expect(page.get_by_text("Click at a surface.")).to_be_visible()
    wait_until(page, lambda: share_of(page, BEHIND, tolerance=40) < 1e-5, "the path is gone")


def _position(page: Page) -> list[float]:
    return numbers_in(cell(page, "position"))


def _shown_point(page: Page) -> list[float] | None:
    """Where the point is that the panel tells of, once it is raised as the path is."""
    raised = page.get_by_role("row", name="raised by")
    return _position(page) if raised.is_visible() and "2.50 m" in raised.inner_text() else None


def test_nothing_is_drawn_after_a_reset(mapped: Looked) -> None:
    mapped.client.reset()
    wait_until(mapped.page, lambda: drawn_share(mapped.page) == 0.0, "nothing is drawn")


@pytest.mark.long
def test_a_server_that_is_gone_is_told_of_until_it_is_back(show: Show) -> None:
    endpoint = servers.free_endpoint()
    with ExitStack() as opened:
        with running_service(endpoint=endpoint), connect(endpoint) as client:
            learn(client)
            watching = opened.enter_context(connect(endpoint))
            page = opened.enter_context(show(LiveSource(watching, endpoint)))
            wait_until_drawn(page)
            expect(page.get_by_text(GONE)).to_be_hidden()
        expect(page.get_by_text(GONE)).to_be_visible()
        assert drawn_share(page) > 0.005, "what is known stays"
        with running_service(endpoint=endpoint):
            expect(page.get_by_text("0 scans; ")).to_be_visible()
