"""The pictures of the documentation: each is made by a command, and shown where it is told."""

import re
import runpy
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
OTHERS = {
    "preview.png",  # what a map file shows to viewers of MCAP
    "tradeoffs.png",  # triquad-bench --plot tradeoffs.png
    "top.svg",  # docs/top_picture.py
    "viewer.gif",  # docs/viewer_pictures.py
    "viewer.png",  # docs/viewer_pictures.py
}
MOST_BYTES = 2_500_000


def test_every_picture_has_a_maker_and_is_shown_on_a_page():
    made = set(runpy.run_path(str(ROOT / "docs" / "pictures.py"))["PICTURES"]) | OTHERS
    kept = {path.name for path in IMAGES.iterdir()}
    shown = {
        name for page in PAGES for name in re.findall(r"images/(\w+\.\w+)\)", page.read_text())
    }
    assert made == kept == shown


def test_the_pictures_are_small_files():
    assert sum(path.stat().st_size for path in IMAGES.iterdir()) < MOST_BYTES
    for name in runpy.run_path(str(ROOT / "docs" / "pictures.py"))["PICTURES"]:
        with Image.open(IMAGES / name) as picture:
            assert picture.width <= 1200


def test_a_picture_that_there_is_not_is_named():
    main = runpy.run_path(str(ROOT / "docs" / "pictures.py"))["main"]
    with pytest.raises(SystemExit, match=r"no picture is called moon.png; there are street.png"):
        main(["moon.png"])
