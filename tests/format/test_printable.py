"""Text of others cannot steer a terminal."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from triquad_format.printable import printable
from triquad_tools.console.command import complain


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("roof-lidar", "roof-lidar"),
        ("Dach, Süd 屋根", "Dach, Süd 屋根"),
        ("\x1b]0;title\x07", r"\x1b]0;title\x07"),
        ("a\rb\x9b2J", r"a\rb\x9b2J"),
        ("\u202eevil", r"\u202eevil"),
        ("\ud800", r"\ud800"),
    ],
)
def test_what_steers_a_terminal_is_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown


@given(st.text())
def test_everything_shown_is_visible(text: str) -> None:
    assert printable(text).isprintable()
    assert not text.isprintable() or printable(text) == text


def test_errors_are_shown_that_way(capsys: pytest.CaptureFixture[str]) -> None:
    assert complain("tool", "no map 'a\x1b[2J'\nthere is b", 2) == 2
    assert capsys.readouterr().err == "tool: no map 'a\\x1b[2J'\n  there is b\n"
