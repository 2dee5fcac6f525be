"""What concerns the server itself: how it is doing, checkpoints, and forgetting."""

import time

from triquad_format.wire import keys
from triquad_format.wire.messages import (
    CheckpointInfo,
    CheckpointRequest,
    ResetReply,
    ResetRequest,
    ServerStatus,
    StatusRequest,
)

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.errors import RequestTimeoutError
from triquad_client.net.call import Ask, Call, Pause, ask

_SLOW_S = 60.0
"""For requests that write to the server's disk."""

_SETTLE_PAUSE_S = 0.2


def status() -> Call[ServerStatus]:
    """How the server is doing."""
    return ask(Ask(keys.STATUS, StatusRequest(), ServerStatus))


def settle(timeout_s: float) -> Call[ServerStatus]:
    """Its status, once the server has nothing left to learn.

    Raises:
        RequestTimeoutError: it still had something after ``timeout_s``.
    """
    deadline = checks.deadline(timeout_s)
    while not (now := (yield from status())).settled:
        if time.monotonic() > deadline:
            raise RequestTimeoutError(f"the server still learns after {timeout_s:g} s")
        yield Pause(_SETTLE_PAUSE_S)
    return now


def checkpoint() -> Call[CheckpointInfo]:
    """A checkpoint that is written now."""
    return ask(Ask(keys.CHECKPOINT, CheckpointRequest(), CheckpointInfo, min_timeout_s=_SLOW_S))


def reset(bounds: Bounds | None) -> Call[int]:
    """The first epoch without what was learnt in the bounds."""
    request = ResetRequest(*checks.box(bounds))
    done = yield from ask(Ask(keys.RESET, request, ResetReply, min_timeout_s=_SLOW_S))
    return done.epoch
