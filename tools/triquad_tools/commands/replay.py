"""``triquad-replay``: publish a recording to a map server, or tell what it holds."""

import argparse
from collections.abc import Callable, Sequence
from functools import partial

from triquad_tools.console.arguments import add_server, command_parser, positive
from triquad_tools.console.command import run_work
from triquad_tools.recordings.arguments import add_recording

_INTERRUPTED = "interrupted; scans that were sent are in the map"
DueTimes = Callable[[Sequence[int]], list[float]]
"""Returns when scans are sent, seconds after the first, by their stamps in nanoseconds."""


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "triquad-replay",
        description="Publish a recording to a map server. By default the server sets the pace, and "
        "no scan is lost.",
        epilog="Exit status: 0 all scans are in the map (--list: there are some to map), 1 some "
        "were lost or refused or the server failed, 2 wrong usage, or nothing can be mapped.",
    )
    add_recording(parser)
    add = parser.add_argument
    add("--list", action="store_true", help="tell what the recording holds, and publish nothing")
    add_server(parser)
    add("--source", metavar="NAME", help="publish as this sensor (default: as the recording says)")
    rate = "scans a second, or 1x: as recorded, 2x: twice as fast; whatever the server takes"
    add("--rate", type=due_times, metavar="HZ|FACTORx", help=rate)
    corrected = "publish nothing: the scans are in the map, and their poses are to be these"
    add("--correct-poses", action="store_true", help=corrected)
    add("--settle", action="store_true", help="wait until the server has learnt all of it")
    return parser


def due_times(text: str) -> DueTimes:
    """Return when scans are due at a rate in Hz, or at a multiple of the recorded pace (``2x``)."""
    factor = positive(text.removesuffix("x"))
    if text.endswith("x"):
        return lambda stamps_ns: [(stamp - stamps_ns[0]) / 1e9 / factor for stamp in stamps_ns]
    return lambda stamps_ns: [number / factor for number in range(len(stamps_ns))]


main = partial(run_work, "replay", _parser, interrupted=_INTERRUPTED)
