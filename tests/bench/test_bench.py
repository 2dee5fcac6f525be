import json
import math
from pathlib import Path

import pytest

from bench import __main__ as bench
from bench.figures import Figure
from bench.results_page import PAGE, RESULTS, Result, page

MEASURED = Result(
    "core",
    "2026-01-31",
    "a machine",
    street=2,
    figures=[
        Figure("a", 1.0, "s", at_most=2.0),
        Figure("b", 5.0, "", at_least=6),
        Figure("c", 7.0, "MB"),
        Figure("d", math.nan, "s", at_most=1.0),
    ],
    remark="b is missed for a reason.",
)


def test_a_figure_keeps_to_its_bounds_or_not() -> None:
    assert Figure("rate", 1.0, "M/s", at_least=1.0).kept
    assert not Figure("rate", 0.99, "M/s", at_least=1.0).kept
    assert Figure("time", 3.0, "s", at_most=3.0).kept
    assert not Figure("time", 3.01, "s", at_most=3.0).kept
    assert not Figure("ratio", 1.3, "", at_least=0.8, at_most=1.2).kept
    assert not Figure("time", math.nan, "s", at_most=3.0).kept
    assert Figure("bytes", 7.0, "MB").kept


def test_the_page_tells_what_is_missed_and_why(tmp_path: Path) -> None:
    MEASURED.write(tmp_path)
    text = page(tmp_path)
    assert "## core: 2026-01-31, a machine, street 2" in text
    assert "| a | 1 s | at most 2 |" in text
    assert "| b | 5 | at least 6: **missed** |" in text
    assert "| d | nan s | at most 1: **missed** |" in text
    assert "| c | 7 MB | |" in text
    assert "b is missed for a reason." in text


def test_results_come_back_as_they_were_written(tmp_path: Path) -> None:
    MEASURED.write(tmp_path)
    found = Result.read(tmp_path, "core")
    assert found is not None
    assert found.title == MEASURED.title
    assert found.figures[:3] == MEASURED.figures[:3]
    assert math.isnan(found.figures[3].value)
    json.loads((tmp_path / "core.json").read_text(), parse_constant=pytest.fail)
    assert Result.read(tmp_path, "server") is None


def test_the_documentation_shows_the_newest_results() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(RESULTS)


def test_unknown_parts_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as refusal:
        bench.main(["everything"])
    assert refusal.value.code == 2
    assert "'everything' is none of core, server" in capsys.readouterr().err
