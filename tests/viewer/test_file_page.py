"""What a person does with the page of a map file: cut, measure, save, and choose what is drawn.

All tests look at one page of a ground with a box of 1.5 m. Each leaves it as it was.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect
from support.files.changing_store import box_at, write_checkpoint
from triquad_tools.mapfiles.meshfile import read_mesh
from triquad_tools.viewer.sources import FileSource
from triquad_tools.viewer.viewer import Viewer

from bench.clients.browser import drawn_share, wait_until, wait_until_drawn

TOP_M, MOST_M, STEP_M = 1.5, 1.6, 0.1  # of the box, and of the scale
GROUNDS = ((430, 420), (560, 470))  # of the scene, pixels: two places on the ground
SKY = (20, 690)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> FileSource:
    path = write_checkpoint(tmp_path_factory.mktemp("map"), 1, box_at(4, 4))
    return FileSource(path, "a file")


@pytest.fixture(scope="module")
def page(
    source: FileSource, show: Callable[[FileSource], AbstractContextManager[Page]]
) -> Iterator[Page]:
    with show(source) as opened:
        wait_until_drawn(opened)
        expect(opened.get_by_text(f"≥ {MOST_M:g}")).to_be_visible()
        yield opened


def choose(page: Page, option: str) -> None:
    page.get_by_role("combobox", name="A click").click()
    page.get_by_role("option", name=option).click()


def click_at(page: Page, place: tuple[int, int]) -> None:
    page.mouse.move(*place)
    page.mouse.click(*place)


def saved(page: Page, button: str, path: Path) -> Path:
    with page.expect_download() as download:
        page.get_by_role("button", name=button).click()
    download.value.save_as(path)
    return path


def test_what_is_above_a_height_is_cut_and_comes_back(page: Page, tmp_path: Path) -> None:
    def highest_m() -> float:
        mesh = read_mesh(saved(page, "Save mesh", tmp_path / "mesh.glb"))
        return float(mesh.vertices[:, 2].max())

    assert highest_m() == pytest.approx(TOP_M, abs=0.05)
    page.get_by_role("slider").first.focus()
    for _ in range(8):
        page.keyboard.press("ArrowLeft")
    cut_m = MOST_M - 8 * STEP_M
    wait_until(page, lambda: 0.1 < highest_m() < cut_m + 1e-6, "what is above is cut")
    page.get_by_role("slider").first.press("End")
    wait_until(page, lambda: highest_m() > TOP_M - 0.05, "it is there again")


def test_the_mesh_is_drawn_where_it_is_wanted(page: Page) -> None:
    page.get_by_label("Show mesh").uncheck()
    wait_until(page, lambda: drawn_share(page) == 0.0, "nothing is drawn")
    page.get_by_label("Show mesh").check()
    wait_until_drawn(page)


def test_the_length_between_two_clicks(page: Page) -> None:
    choose(page, "measures")
    click_at(page, GROUNDS[0])
    expect(page.get_by_text("Click at the other end.")).to_be_visible()
    click_at(page, GROUNDS[1])

    def metres(name: str) -> float:
        cell = page.get_by_role("row", name=name, exact=False).locator("td").last
        return float(cell.inner_text().removesuffix(" m"))

    expect(page.get_by_role("row", name="upright")).to_be_visible()
    assert metres("length") > 1.0
    assert metres("length") == pytest.approx(metres("level"), abs=0.01), "the ground is level"
    assert metres("upright") == pytest.approx(0.0, abs=0.02)
    expect(page.get_by_role("button", name="Save path")).to_be_hidden()
    click_at(page, SKY)
    expect(page.get_by_role("row", name="upright")).to_be_hidden()
    choose(page, "asks the map")


def test_a_path_is_saved_as_it_was_laid(page: Page, tmp_path: Path) -> None:
    choose(page, "adds to the path")
    for number, place in enumerate(GROUNDS, start=1):
        click_at(page, place)
        expect(page.get_by_role("row", name="position")).to_be_visible()
        if number > 1:
            expect(page.get_by_role("row", name="path")).to_contain_text(f"{number} points")
    told = page.get_by_role("row", name="position").locator("td").last.inner_text()
    path = saved(page, "Save path", tmp_path / "path.csv")
    assert path.read_text().startswith("x_m,y_m,z_m\n")
    points = np.loadtxt(path, delimiter=",", skiprows=1)
    assert points.shape == (2, 3)
    last = [float(each) for each in told.removesuffix(" m").split(",")]
    np.testing.assert_allclose(points[-1], last, atol=1e-3)
    np.testing.assert_allclose(points[:, 2], 0.1 + 0.5, atol=0.03)
    page.get_by_role("button", name="Clear path").click()
    expect(page.get_by_text("Click at a surface.")).to_be_visible()
    choose(page, "asks the map")


def test_a_phone_has_its_scene_until_the_controls_are_opened(
    source: FileSource, chromium: Browser
) -> None:
    with closing(Viewer(source, "127.0.0.1", 0)) as viewer:
        phone = chromium.new_page(viewport={"width": 390, "height": 844})
        phone.goto(viewer.url)
        controls = phone.get_by_text("Controls")
        expect(controls).to_be_visible()
        expect(phone.get_by_label("Show slice")).to_be_hidden()
        assert controls.bounding_box()["y"] > 0.75 * 844  # type: ignore[index]
        controls.click()
        expect(phone.get_by_label("Show slice")).to_be_visible()
        phone.close()
