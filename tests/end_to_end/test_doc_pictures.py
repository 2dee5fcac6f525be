"""The pictures of the documentation: each is made by a command, and shown where it is told."""

import re
import runpy
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MOST_BYTES = 1_500_000


def test_every_picture_is_made_by_make_pictures_and_shown_on_a_page():
    made = set(runpy.run_path(str(ROOT / "docs" / "pictures.py"))["PICTURES"])
    kept = {path.name for path in IMAGES.glob("*.png")}
    shown = {
        name for page in PAGES for name in re.findall(r"images/(\w+\.png)\)", page.read_text())
    }
    assert made == kept == shown


def test_the_pictures_are_small_files():
    assert sum(path.stat().st_size for path in IMAGES.iterdir()) < MOST_BYTES
    for path in IMAGES.glob("*.png"):
        with Image.open(path) as picture:
            assert picture.width <= 1200


def test_a_picture_that_there_is_not_is_named():
    main = runpy.run_path(str(ROOT / "docs" / "pictures.py"))["main"]
    with pytest.raises(SystemExit, match=r"no picture is called moon.png; there are street.png"):
        main(["moon.png"])
