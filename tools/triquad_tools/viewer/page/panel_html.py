"""Texts in the panel of a page. What comes from the network is shown as it is, whatever it is."""

from collections.abc import Iterable
from html import escape

from triquad_format.printable import printable_lines

_TEXT = "padding: 0.2em 1em; font-size: 0.8em; line-height: 1.4; overflow-wrap: anywhere"
_PROBLEM = f"{_TEXT}; color: #9a3412; font-weight: bold"


def text_html(text: str) -> str:
    """A text, line by line."""
    return f'<div style="{_TEXT}; white-space: pre-line">{_shown(text)}</div>'


def problem_html(text: str) -> str:
    """What goes wrong, with a sign before it; nothing where the text is empty."""
    return f'<div style="{_PROBLEM}">⚠ {_shown(text)}</div>' if text else ""


def table_html(rows: Iterable[tuple[str, str]]) -> str:
    """Names and values, in two columns."""
    cells = "".join(
        f'<tr><td style="padding-right: 1em; opacity: 0.7">{_shown(name)}</td>'
        f"<td>{_shown(value)}</td></tr>"
        for name, value in rows
    )
    return f'<table style="{_TEXT}">{cells}</table>'


def _shown(text: str) -> str:
    """A text of others that neither makes elements of the page nor turns its writing around."""
    return escape(printable_lines(text))
