"""The pictures of the documentation: each is made by a command, and shown where it is told."""

import re
import runpy
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

DOCS = Path(__file__).parents[3] / "docs"
IMAGES = DOCS / "images"
PAGES = [DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md"))]
MOST_BYTES, MOST_OF_FILM = 1_500_000, 3_000_000


@pytest.fixture(autouse=True)
def programs_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS))


def run(program: str) -> dict[str, Any]:
    return runpy.run_path(str(DOCS / program))


def test_every_picture_is_made_by_make_pictures_and_shown_on_a_page():
    makefile = (DOCS.parent / "Makefile").read_text()
    for program in ("pictures.py", "top_picture.py", "viewer_pictures.py"):
        assert f"docs/{program}" in makefile
    made = {*run("pictures.py")["PICTURES"], *run("viewer_pictures.py")["PICTURES"]}
    made.add(run("top_picture.py")["PICTURE"].name)
    kept = {path.name for path in IMAGES.iterdir()}
    shown = {
        name for page in PAGES for name in re.findall(r"images/(\w+\.\w+)\)", page.read_text())
    }
    assert made == kept == shown


def test_the_pictures_are_small_files():
    sizes = {path.name: path.stat().st_size for path in IMAGES.iterdir()}
    assert sizes.pop("viewer.gif") < MOST_OF_FILM
    assert sum(sizes.values()) < MOST_BYTES
    for path in IMAGES.glob("*.png"):
        with Image.open(path) as picture:
            assert picture.width <= 1200
