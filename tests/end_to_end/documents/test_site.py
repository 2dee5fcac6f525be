"""The documentation site, as ``make docs`` builds it."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
import triquad_format

DOCS = Path(__file__).parents[3] / "docs"
BUILD = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going"]


@pytest.mark.skipif(not importlib.util.find_spec("sphinx"), reason="needs the extra 'docs'")
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    built = subprocess.run([*BUILD, DOCS, tmp_path], capture_output=True, text=True)
    assert (built.returncode, built.stderr) == (0, "")
    commands = (tmp_path / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "usage: triquad-server" in commands
    client = (tmp_path / "reference" / "client.html").read_text(encoding="utf-8")
    assert 'id="triquad_client.Client.query_distance"' in client
    assert "usage: triquad-eval paper" in commands
    changes = (tmp_path / "project" / "changes.html").read_text(encoding="utf-8")
    assert changes.count(triquad_format.__version__) > 1
