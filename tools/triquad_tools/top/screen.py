"""The page on a terminal, drawn anew until somebody ends it; or once, as plain text."""

import os
import sys
from dataclasses import replace

from rich.console import Console
from rich.live import Live

from triquad_tools.top.page import Page
from triquad_tools.top.watch import Silence, Target, Watch

_PLAIN_WIDTH = 100  # characters, where no terminal says otherwise
_DRAWN_PER_S = 1.0  # at least: the time goes on while the server is silent


def is_screen() -> bool:
    """Whether standard output is a terminal on which a page can be drawn again and again."""
    return sys.stdout.isatty() and os.environ.get("TERM") != "dumb"


def show(target: Target, watch: Watch) -> None:
    """Draw the page until an interrupt; the terminal is then as it was."""
    console = Console(markup=False, highlight=False, emoji=False)
    page = Page(target, None)

    def fitted() -> Page:
        return replace(page, height=console.height)

    with Live(
        get_renderable=fitted, console=console, screen=True, refresh_per_second=_DRAWN_PER_S
    ) as live:
        for seen in watch.looks():
            page = replace(page, silence=seen) if isinstance(seen, Silence) else Page(target, seen)
            live.refresh()


def print_page(page: Page) -> None:
    """Print the whole page as text without colours."""
    width = None if sys.stdout.isatty() or "COLUMNS" in os.environ else _PLAIN_WIDTH
    console = Console(width=width, color_system=None, markup=False, highlight=False, emoji=False)
    with console.capture() as captured:
        console.print(page)
    for line in captured.get().splitlines():
        print(line.rstrip())
