"""Sphinx makes the documentation site of these pages: ``make docs``."""

import sys
from pathlib import Path

from triquad_format import __version__

sys.path.append(str(Path(__file__).parent))  # its own extension

project = "triquad"
author = "the triquad maintainers"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "site_extension"]
exclude_patterns = ["README.md", "_build"]  # index.md is the site's first page

html_theme = "furo"
html_title = f"triquad {release}"
html_copy_source = False

highlight_language = "none"  # where a block names no other
myst_heading_anchors = 4  # named as on GitHub

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
napoleon_numpy_docstring = False
