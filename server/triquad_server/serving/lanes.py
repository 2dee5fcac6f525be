"""The lanes of requests: what waits in one queue, and which threads work at it."""

from dataclasses import dataclass
from enum import Enum

from triquad_map.compiled.team import THREADS

from triquad_server.process.threads import NICENESS

_LONG_BYTES = 32_768
"""A question of more bytes is long: some 2,700 points, which take a server 10 ms."""


class Lane(Enum):
    """The operations that share a queue and its workers."""

    QUESTIONS = "questions"
    LONG_QUESTIONS = "long_questions"
    """The lane of questions about many places, which take a tenth of a second: short ones, such as
    a planner's, do not wait for them, and mapping is not slowed down."""

    ADMINISTRATION = "administration"
    """The lane of what takes no time: it is answered however many queries wait."""

    MESH = "mesh"
    """The lane of the mesh: requests come one after the other, and all cores make their tiles."""

    FILES = "files"
    """The lane of checkpoints and map files, which take long, one after the other: its workers
    wait for what :class:`LongWork` does."""


@dataclass(frozen=True)
class LaneWorkers:
    """The workers of a lane, and what they give way to."""

    threads: int  # for questions, one for each core
    niceness: int = 0  # that of mapping where the work is long
    gives_way_s: float | None = None
    """The seconds for which scans of a source that is about to lose some have to wait before these
    workers give way: a planner does not wait for a source that floods, a long question does.
    ``None``: they never do."""


LANES = {
    Lane.QUESTIONS: LaneWorkers(max(2, THREADS), gives_way_s=1.0),
    Lane.LONG_QUESTIONS: LaneWorkers(max(2, THREADS), NICENESS, gives_way_s=0.0),
    Lane.ADMINISTRATION: LaneWorkers(2),
    Lane.MESH: LaneWorkers(1, NICENESS),
    Lane.FILES: LaneWorkers(2),
}


def lane_of(lane: Lane, nbytes: int) -> Lane:
    """Return the lane of a request of some bytes, for an operation of this lane."""
    is_long = lane is Lane.QUESTIONS and nbytes > _LONG_BYTES
    return Lane.LONG_QUESTIONS if is_long else lane
