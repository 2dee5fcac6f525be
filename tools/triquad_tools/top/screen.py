"""The page on a terminal, drawn anew until somebody ends it; or once, as plain text."""

import io
import os
import sys
from dataclasses import replace

from rich.console import Console
from rich.live import Live

from triquad_tools.console.lines import print_line
from triquad_tools.top.keyboard import Keyboard
from triquad_tools.top.page import Page
from triquad_tools.top.watch import Silence, Target, Watch

_PLAIN_WIDTH = 100  # characters, where no terminal says otherwise
_DRAWN_PER_S = 0.5  # at least: the time goes on while the server is waited for


def is_screen() -> bool:
    """Whether standard output is a terminal on which a page can be drawn again and again."""
    return sys.stdout.isatty() and os.environ.get("TERM") != "dumb"


def show(target: Target, watch: Watch) -> None:
    """Draw the page until somebody types q or Ctrl-C; the terminal is then as it was."""
    console = _console()
    page = Page(target, None)

    def fitted() -> Page:
        return replace(page, height=console.height)

    with (
        Keyboard() as keyboard,
        Live(
            get_renderable=fitted, console=console, screen=True, refresh_per_second=_DRAWN_PER_S
        ) as live,
    ):
        while not keyboard.ends_within(watch.due_in_s):
            seen = watch.observe_again()
            page = replace(page, silence=seen) if isinstance(seen, Silence) else Page(target, seen)
            live.refresh()


def print_page(page: Page) -> None:
    """Print the whole page as text without colours."""
    console = _console()
    if not (sys.stdout.isatty() or "COLUMNS" in os.environ):
        console.width = _PLAIN_WIDTH
    for line in console.render_lines(page):
        print_line("".join(segment.text for segment in line).rstrip())


def _console() -> Console:
    """Of standard output, where a character that its encoding lacks is a question mark."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    return Console(markup=False, highlight=False, emoji=False)
