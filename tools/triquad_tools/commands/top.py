"""``triquad-top``: how a map server is doing, live."""

import argparse
import itertools
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

from rich.console import Console
from rich.live import Live
from triquad_client import Client, connect
from triquad_format.errors import TriquadError
from triquad_format.mapfile.metadata import utc_time

from triquad_tools.console.amounts import duration
from triquad_tools.console.arguments import add_version, positive
from triquad_tools.console.command import FAILED, OK, complain, run
from triquad_tools.console.interrupts import sigterm_interrupts
from triquad_tools.console.lines import print_line
from triquad_tools.console.report import json_text
from triquad_tools.console.server_arguments import DEFAULT_MAP, add_server, server_name
from triquad_tools.top.interval import Sample, rates
from triquad_tools.top.page import Seen, page, problems

_COMMAND = "triquad-top"
_TIMEOUT_S = 5.0  # for connecting, and for each reply
_PLAIN_WIDTH = 100  # characters, where neither a terminal nor COLUMNS says otherwise


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 1 the server failed, 2 wrong usage, 130 ended by Ctrl-C."""
    return run(_COMMAND, partial(_top, _parser().parse_args(argv)))


def _top(options: argparse.Namespace) -> int:
    name, server = options.map or DEFAULT_MAP, server_name(options)
    can_draw = sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    reached = connect(options.connect, name, timeout_s=_TIMEOUT_S, config=options.config)
    with sigterm_interrupts(), reached as client:
        if not options.once and options.json:
            for seen in _observed(client, options.interval, _sleep):
                print_line(_json_line(server, name, seen))
        elif not options.once and can_draw:
            _show(f"map {name} at {server}", client, options.interval)
        else:
            _, seen = itertools.islice(_observed(client, options.interval, _sleep), 2)
            if seen.silent is not None:
                return complain(_COMMAND, seen.silent, FAILED)
            title = f"map {name} at {server}"
            print_line(_json_line(server, name, seen) if options.json else _plain(title, seen))
    return OK


def _observed(
    client: Client, period_s: float, ends_within: Callable[[float], bool]
) -> Iterator[Seen]:
    """Yield what is known of a server, at each interval; one that does not answer is waited for."""
    seen, due_s = Seen(Sample(client.status(), client.metrics()), None), time.monotonic()
    answered_s = due_s
    while True:
        yield seen
        due_s = max(due_s + period_s, time.monotonic())
        if ends_within(max(0.0, due_s - time.monotonic())):
            return
        try:
            sample, last = Sample(client.status(), client.metrics()), seen.sample
            restarted = sample.status.server != last.status.server
            seen, answered_s = Seen(sample, rates(last, sample), restarted), time.monotonic()
        except TriquadError as error:
            silent_s = time.monotonic() - answered_s
            silent = f"no answer for {duration(silent_s)}: {error}"
            seen = replace(seen, silent=silent, restarted=False)


def _show(title: str, client: Client, period_s: float) -> None:
    """Draw the page until q or Ctrl-C is typed; the terminal is then as it was."""
    console = Console()
    with _keyboard() as q_within, Live(console=console, screen=True, auto_refresh=False) as live:
        for seen in _observed(client, period_s, q_within):
            live.update(page(title, seen, console.width), refresh=True)


def _sleep(seconds: float) -> bool:
    time.sleep(seconds)
    return False


@contextmanager
def _keyboard() -> Iterator[Callable[[float], bool]]:
    """Yield what waits for some seconds, and returns whether ``q`` was typed meanwhile."""

    def q_within(seconds: float) -> bool:
        end_s = time.monotonic() + seconds
        while select.select([sys.stdin], [], [], max(0.0, end_s - time.monotonic()))[0]:
            typed = os.read(sys.stdin.fileno(), 1024)
            if not typed or b"q" in typed.lower():
                return True
        return False

    if sys.stdin is None or not sys.stdin.isatty():
        yield _sleep
        return
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield q_within
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _plain(title: str, seen: Seen) -> str:
    """Return the whole page as text without colours."""
    has_width = sys.stdout.isatty() or "COLUMNS" in os.environ
    console = Console(width=None if has_width else _PLAIN_WIDTH)
    lines = console.render_lines(page(title, seen, console.width))
    return "\n".join("".join(part.text for part in line).rstrip() for line in lines)


def _json_line(server: str, name: str, seen: Seen) -> str:
    """Return an object in one line, with the same keys whether the server answers or not."""
    sample = None if seen.silent else seen.sample
    report = {
        "time": utc_time(time.time_ns()),
        "endpoint": server,
        "map": name,
        "silent": seen.silent,
        "restarted": seen.restarted,
        "problems": problems(seen),
        "rates": sample and seen.rates,
        "status": sample and sample.status,
        "metrics": sample and sample.metrics,
    }
    return json_text(report, indent=None)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_COMMAND,
        description="Show how a map server is doing, as it goes, until q or Ctrl-C.",
        epilog="Exit status: 0 done, 1 there is no such server or it failed, 2 wrong usage, "
        "130 ended by Ctrl-C.",
    )
    add_server(parser)
    add = parser.add_argument
    add("--interval", type=positive, default=1.0, metavar="S", help="seconds (default: 1)")
    add("--once", action="store_true", help="print one page as plain text, after one interval")
    add("--json", action="store_true", help="print an object of JSON a line, one each interval")
    add_version(parser)
    return parser
