"""``triquad-top``: how a map server is doing, as it goes."""

import argparse
import time
from collections.abc import Sequence
from functools import partial

from triquad_client import connect

from triquad_tools.console.arguments import add_version, positive
from triquad_tools.console.command import OK, run
from triquad_tools.console.interrupts import sigterm_interrupts
from triquad_tools.console.lines import print_line
from triquad_tools.console.server_arguments import DEFAULT_MAP, add_server, server_name
from triquad_tools.top.page import Page
from triquad_tools.top.report import json_line
from triquad_tools.top.screen import is_screen, print_page, show
from triquad_tools.top.watch import Target, Watch

_COMMAND = "triquad-top"
_TIMEOUT_S = 5.0  # for connecting, and for each reply
_SHORTEST_S, _LONGEST_S = 0.1, 3600.0  # intervals


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 1 the server failed, 2 wrong usage, 130 ended by Ctrl-C."""
    return run(_COMMAND, partial(_top, _parser().parse_args(argv)))


def _top(options: argparse.Namespace) -> int:
    name = options.map or DEFAULT_MAP
    target = Target(server_name(options), name)
    reached = connect(options.connect, name, timeout_s=_TIMEOUT_S, config=options.config)
    with sigterm_interrupts(), reached as client:
        watch = Watch(client, options.interval)
        if options.once or not (options.json or is_screen()):
            _observe_once(target, watch, options)
        elif options.json:
            while True:
                time.sleep(watch.due_in_s)
                print_line(json_line(target, watch.observe_again()))
        else:
            show(target, watch)
    return OK


def _observe_once(target: Target, watch: Watch, options: argparse.Namespace) -> None:
    """Observe one interval, and print what was seen."""
    watch.observe()
    time.sleep(watch.due_in_s)
    seen = watch.observe()
    if options.json:
        print_line(json_line(target, seen))
    else:
        print_page(Page(target, seen))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_COMMAND,
        description="Show how a map server is doing, as it goes, until Ctrl-C.",
        epilog="Exit status: 0 done, 1 there is no such server or it failed, 2 wrong usage, "
        "130 ended by Ctrl-C.",
    )
    add_server(parser)
    add = parser.add_argument
    add("--interval", type=_interval, default=1.0, metavar="S", help="seconds (default: 1)")
    add("--once", action="store_true", help="print one page as plain text, after one interval")
    add("--json", action="store_true", help="print an object of JSON a line, one each interval")
    add_version(parser)
    return parser


def _interval(text: str) -> float:
    seconds = positive(text)
    if not _SHORTEST_S <= seconds <= _LONGEST_S:
        raise argparse.ArgumentTypeError(
            f"{text} s is out of range: use {_SHORTEST_S:g} to {_LONGEST_S:g}"
        )
    return seconds
