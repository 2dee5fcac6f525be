import math
from pathlib import Path

import pytest
from triquad_tools.benchmarks.figures import Figure, compare, markdown
from triquad_tools.commands import bench


def test_a_figure_keeps_to_its_bounds_or_not() -> None:
    assert Figure("rate", 1.0, "M/s", at_least=1.0).kept
    assert not Figure("rate", 0.99, "M/s", at_least=1.0).kept
    assert Figure("time", 3.0, "s", at_most=3.0).kept
    assert not Figure("time", 3.01, "s", at_most=3.0).kept
    assert not Figure("ratio", 1.3, "", at_least=0.8, at_most=1.2).kept
    assert not Figure("time", math.nan, "s", at_most=3.0).kept
    assert Figure("bytes", 7.0, "MB").kept


def test_a_table_says_what_is_missed() -> None:
    table = markdown(
        "today", [Figure("a", 1.0, "s", at_most=2.0), Figure("b", 5.0, "", at_least=6)]
    )
    lines = table.splitlines()
    assert lines[0] == "## today"
    assert lines[4:] == ["| a | 1 s | at most 2 | yes |", "| b | 5 | at least 6 | **no** |"]


def test_both_ways_are_timed_in_turns() -> None:
    calls: list[str] = []
    result = compare(lambda: calls.append("new"), lambda: calls.append("old"), 3, repeats=2)
    assert calls == ["new", "old", *["new", "new", "old"] * 3]
    assert result.seconds > 0
    assert result.ratio > 0


def test_files_that_cannot_be_written_are_refused_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for option in ("--json", "--record"):
        missing = tmp_path / "nowhere" / "figures"
        assert bench.main([option, str(missing)]) == bench.BAD_INPUT
        assert str(missing) in capsys.readouterr().err


def test_unknown_parts_are_refused() -> None:
    with pytest.raises(SystemExit) as refusal:
        bench.main(["everything"])
    assert refusal.value.code == bench.BAD_INPUT
