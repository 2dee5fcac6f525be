"""The teams of threads that share the server's work, and thread pools."""

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import ParamSpec

from triquad_map.compiled.team import MIN_SHARE, Team, Work, is_urgent

_log = logging.getLogger(__name__)

Arguments = ParamSpec("Arguments")

NICENESS = 2
"""The niceness of all work but queries, for which somebody waits, and checkpoints.

It makes the map give way to other programs as well: while two busy ones run on two cores, 84 of 195
scans in 30 s are taken in, with 5 61, with 0 109. Amid a stream a query takes 5.0 ms, with 5 4.6,
with 0 5.7."""


@dataclass(frozen=True)
class Teams:
    """The teams for the work of one map; their threads are started when they are first needed."""

    # For questions that somebody waits for, such as a planner.
    answers: Team = field(default_factory=lambda: Team("triquad-answers"))
    # Taking in scans and training; the mapper's own thread has the same niceness.
    mapping: Team = field(default_factory=lambda: Team("triquad-mapping", NICENESS))
    # For long questions, and for tiles that nobody waits for at the moment.
    background: Team = field(default_factory=lambda: Team("triquad-background", NICENESS))

    def answer(self, count: int, work: Work, least: int = MIN_SHARE) -> None:
        """Split the work of a question among threads of the caller's priority: a ``Split``."""
        team = self.answers if is_urgent() else self.background
        team.split(count, work, least)

    def close(self) -> None:
        """End the threads; work that still comes is left to the callers."""
        for team in (self.answers, self.mapping, self.background):
            team.close()


def submit(
    pool: ThreadPoolExecutor,
    work: Callable[Arguments, None],
    *args: Arguments.args,
    **kwargs: Arguments.kwargs,
) -> None:
    """Run some work in a thread of a pool; while none can be started, it waits for one."""
    try:
        pool.submit(work, *args, **kwargs)
    except RuntimeError as error:
        # The pool queued the work before it tried to start a thread.
        _log.warning("%s: work in the background waits for one that ends", error)
