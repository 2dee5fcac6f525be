import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from scipy.ndimage import binary_opening, label
from triquad_tools.benchmarks.figures import CurvePoint, Figure, compare, markdown
from triquad_tools.benchmarks.tradeoff_sheet import (
    ACCURACY,
    BYTES,
    F_SCORE,
    SPACING,
    TIME,
    saved_tradeoffs,
)
from triquad_tools.commands import bench
from triquad_tools.console.command import ToolError

CURVES = {TIME: (5.0, 50.0), BYTES: (2e6, 4e6), SPACING: (1.0, 10.0)}


def saved_figures(path: Path, street: int = 1) -> Path:
    """What a run leaves, with a figure that is on no curve."""
    figures = [Figure("publish an epoch", 1.4, "ms")]
    for curve, costs in CURVES.items():
        for cost in costs:
            figures.append(Figure("F", 99.0, "%", point=CurvePoint(curve, F_SCORE, cost)))
            figures.append(Figure("error", 0.9, "cm", point=CurvePoint(curve, ACCURACY, cost)))
    shown = [{"part": "tradeoffs"} | dataclasses.asdict(figure) for figure in figures]
    path.write_text(json.dumps({"title": "today", "street": street, "figures": shown}))
    return path


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
    for option in ("--json", "--record", "--plot"):
        missing = tmp_path / "nowhere" / "figures.png"
        assert bench.main([option, str(missing)]) == bench.BAD_INPUT
        assert str(missing) in capsys.readouterr().err


def test_what_was_measured_is_told_and_kept_by_part(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved, page = tmp_path / "figures.json", tmp_path / "page.md"
    page.write_text("# Benchmarks\n")
    assert bench.main(["ros2", "--json", str(saved), "--record", str(page)]) == bench.OK
    figures = json.loads(saved.read_text())["figures"]
    assert {figure["part"] for figure in figures} == {"ros2"}
    heading, _, *lines = page.read_text().partition("\n## ")[2].splitlines()
    assert heading.endswith(", street 1, part ros2")
    assert len(lines) == 2 + len(figures)
    printed = capsys.readouterr().out
    assert all(figure["name"] in printed for figure in figures)


def test_unknown_parts_are_refused() -> None:
    with pytest.raises(SystemExit) as refusal:
        bench.main(["everything"])
    assert refusal.value.code == bench.BAD_INPUT


def test_the_picture_of_a_saved_run_needs_no_second_one(tmp_path: Path) -> None:
    pictures = []
    for street in (1, 2):
        saved, picture = saved_figures(tmp_path / "figures.json", street), tmp_path / "out.png"
        assert bench.main(["--plot", str(picture), "--from", str(saved)]) == bench.OK
        pictures.append(imread(picture)[..., :3])
    # Okabe and Ito's blue and vermilion: the neighbour was measured on street 1 alone.
    for colour, seen in ((np.array([0, 114, 178]), [True, True]), ((213, 94, 0), [True, False])):
        near = [np.abs(255 * one - colour).max(axis=2) < 3 for one in pictures]
        assert [bool(pixels.sum() > 100) for pixels in near] == seen


def test_every_point_is_within_its_panel(tmp_path: Path) -> None:
    """Whatever the order of panels: the neighbour's scores differ from curve to curve."""
    picture = tmp_path / "out.png"
    saved = saved_figures(tmp_path / "figures.json")
    assert bench.main(["--plot", str(picture), "--from", str(saved)]) == bench.OK
    near = np.abs(255 * imread(picture)[..., :3] - (213, 94, 0)).max(axis=2) < 30
    squares = label(binary_opening(near, np.ones((6, 6))))[1]
    assert squares == 2 * (1 + 1 + 4) + 1  # in two rows, and in the legend


def test_curves_come_back_as_they_were_saved(tmp_path: Path) -> None:
    found = saved_tradeoffs(saved_figures(tmp_path / "figures.json", 3))
    assert found.street == 3
    assert {figure.point.curve for figure in found.figures if figure.point} == set(CURVES)
    assert len(found.figures) == 12  # not the one that is on no curve


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"title": "", "street": 1, "figures": []}',
        '{"title": "", "street": 1, "figures": [{"point": {"curve": "time"}}]}',
        '{"title": "", "street": 1, "figures": [{"name": "", "value": 1, "unit": "", '
        '"point": {"curve": "luck", "measure": "F-score at 10 cm", "cost": 1}}]}',
        '{"title": "", "street": 1, "figures": [{"name": "", "value": "much", "unit": "", '
        '"point": {"curve": "time", "measure": "F-score at 10 cm", "cost": 1}}]}',
        '{"title": "", "street": 1, "figures": [{"name": "", "value": 1, "unit": "", '
        '"point": {"curve": "time", "measure": "F-score at 10 cm", "cost": 0}}]}',
    ],
)
def test_files_without_curves_are_refused(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "figures.json"
    path.write_text(text)
    with pytest.raises(ToolError, match=r"figures\.json"):
        saved_tradeoffs(path)
    assert bench.main(["--plot", str(tmp_path / "o.png"), "--from", str(path)]) == bench.BAD_INPUT
    assert str(path) in capsys.readouterr().err


def test_figures_that_there_are_not_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "nothing.json"
    assert bench.main(["--plot", str(tmp_path / "o.png"), "--from", str(path)]) == bench.BAD_INPUT
    assert capsys.readouterr().err == f"triquad-bench: {path}: no such file or directory\n"


def test_saved_figures_are_drawn_without_measuring_or_not_at_all(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved = str(saved_figures(tmp_path / "figures.json"))
    picture = str(tmp_path / "out.png")
    for arguments in (["--from", saved], ["core", "--from", saved, "--plot", picture]):
        assert bench.main(arguments) == bench.BAD_INPUT
        assert "--plot OUT.png" in capsys.readouterr().err
    assert bench.main(["--from", saved, "--plot", str(tmp_path / "out.txt")]) == bench.BAD_INPUT
    assert ".png" in capsys.readouterr().err


def test_half_of_a_curve_is_not_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved, picture = saved_figures(tmp_path / "figures.json"), tmp_path / "out.png"
    halved = json.loads(saved.read_text())
    halved["figures"] = halved["figures"][:2]
    saved.write_text(json.dumps(halved))
    assert bench.main(["--plot", str(picture), "--from", str(saved)]) == bench.BAD_INPUT
    assert "no curve" in capsys.readouterr().err
    assert not picture.exists()
