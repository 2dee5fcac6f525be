import pytest
from triquad_format.errors import (
    DamagedMapFileError,
    InvalidInputError,
    MapFileError,
    TriquadError,
)
from triquad_tools.console import report
from triquad_tools.console.command import ToolError, run
from triquad_tools.console.report import Row, json_text, print_columns, print_rows


def test_rows_are_aligned_and_end_where_their_text_does(capsys):
    print_rows("Mesh [x]", [Row("accuracy", "1.00 cm", "mean [m]"), Row("F", "10.00 cm")])
    assert (
        capsys.readouterr().out
        == "Mesh [x]\n  accuracy   1.00 cm  mean [m]\n  F         10.00 cm\n"
    )


def test_columns_are_whole_where_a_program_reads(capsys):
    print_columns(("epoch", "the file's name"), [("1", "x" * 200), ("22", "y")])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines[1:]] == [["1", "x" * 200], ["22", "y"]]
    assert lines[2].endswith(" y")
    assert len(lines[0]) == len(lines[1]) == len(lines[2])


@pytest.mark.parametrize("columns", [20, 60])
def test_a_narrow_terminal_breaks_titles_but_no_cell(capsys, monkeypatch, columns):
    monkeypatch.setattr(report.sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", str(columns))
    titles = ("epoch", *["very long title"] * 4)
    print_columns(titles, [("1234567", *["1,234,567"] * 3, "8")])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 2
    assert lines[-1].split() == ["1234567", *["1,234,567"] * 3, "8"]


def test_json_has_null_for_what_is_not_finite():
    assert json_text({"a": float("nan"), "b": [1.5, float("inf")]}).split() == (
        ["{", '"a":', "null,", '"b":', "[", "1.5,", "null", "]", "}"]
    )


@pytest.mark.parametrize(
    ("raised", "status", "line"),
    [
        (OSError("no such file"), 2, "tool: no such file"),
        (DamagedMapFileError("damage"), 1, "tool: damage"),
        (MapFileError("no map file"), 2, "tool: no map file"),
        (ToolError("usage"), 2, "tool: usage"),
        (InvalidInputError("argument"), 2, "tool: argument"),
        (TriquadError("server"), 1, "tool: server"),
        (KeyboardInterrupt(), 130, "tool: interrupted"),
    ],
)
def test_what_goes_wrong_is_a_status_and_one_line(capsys, raised, status, line):
    def work():
        raise raised

    assert run("tool", work) == status
    assert capsys.readouterr().err == f"{line}\n"
