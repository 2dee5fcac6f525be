"""The teams of threads between which the server's work is split, and pools of others."""

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import ParamSpec

from triquad_map.compiled.team import Team

_log = logging.getLogger(__name__)

Arguments = ParamSpec("Arguments")

NICENESS = 5
"""How much later than queries, for which somebody waits, the system schedules all other work."""


@dataclass(frozen=True)
class Teams:
    """Teams for the work of one map; their threads are started when they are first needed."""

    answers: Team = field(default_factory=lambda: Team("triquad-answers"))  # to queries
    # Taking in scans and training; the mapper's own thread has the same niceness.
    mapping: Team = field(default_factory=lambda: Team("triquad-mapping", NICENESS))
    # Tiles that nobody waits for at the moment.
    meshing: Team = field(default_factory=lambda: Team("triquad-meshing", NICENESS))

    def close(self) -> None:
        """End the threads; work that still comes is left to the callers."""
        for team in (self.answers, self.mapping, self.meshing):
            team.close()


def submit(
    pool: ThreadPoolExecutor,
    work: Callable[Arguments, None],
    *args: Arguments.args,
    **kwargs: Arguments.kwargs,
) -> None:
    """Have a thread of a pool do some work; while none can be started, it waits for one."""
    try:
        pool.submit(work, *args, **kwargs)
    except RuntimeError as error:
        # The pool has put it among what waits before it started a thread.
        _log.warning("%s: work in the background waits for one that ends", error)
