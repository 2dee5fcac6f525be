"""Calls that concern the server itself: how it is doing, checkpoints, and forgetting."""

from dataclasses import replace

from triquad_format.printable import printable
from triquad_format.wire import keys
from triquad_format.wire.messages import (
    CheckpointInfo,
    CheckpointRequest,
    ResetReply,
    ResetRequest,
    ServerStatus,
    StatusRequest,
)
from triquad_format.wire.metrics_messages import MetricsRequest, ServerMetrics

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.net.call import Ask, Call, ask

_SLOW_S = 60.0
"""The least timeout of requests that write to the server's disk."""


def status() -> Call[ServerStatus]:
    """Return how the server is doing."""
    return ask(Ask(keys.STATUS, StatusRequest(), ServerStatus))


def metrics() -> Call[ServerMetrics]:
    """Return how the server is doing, in figures."""
    return ask(Ask(keys.METRICS, MetricsRequest(), ServerMetrics))


def checkpoint() -> Call[CheckpointInfo]:
    """Return a checkpoint that is written now."""
    return ask(Ask(keys.CHECKPOINT, CheckpointRequest(), CheckpointInfo, min_timeout_s=_SLOW_S))


def reset(bounds: Bounds | None) -> Call[ResetReply]:
    """Forget what was learnt in the bounds."""
    request = ResetRequest(*checks.box(bounds))
    reply = yield from ask(Ask(keys.RESET, request, ResetReply, min_timeout_s=_SLOW_S))
    return reply if reply.undo is None else replace(reply, undo=printable(reply.undo))
