"""A map that several servers share: each is asked about its regions, and the replies are joined."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import zenoh
from triquad_format.errors import RefusedError
from triquad_format.wire.codec import Request
from triquad_format.wire.messages import MapReply, ResetReply, ResetRequest
from triquad_format.wire.query_messages import ChangesReply, ChangesRequest
from triquad_format.wire.shares import Shares, read_token, share_name, shares_key
from triquad_format.wire.status_messages import ServerStatus, StatusRequest

from triquad_client.errors import (
    ConnectError,
    NoReplyError,
    RequestTimeoutError,
    UnknownMapError,
)
from triquad_client.net.connection import (
    NEWEST,
    PARTS_IN_FLIGHT,
    Connection,
    ReplyT,
    ResultT,
    is_cancelled,
)
from triquad_client.net.shared_epochs import Epochs, SharedEpochs
from triquad_client.net.shared_places import SharedPlaces
from triquad_client.net.shared_questions import Part, joined, parts_of

_PATIENCE_S = 3.0  # for others to take the regions of a server that does not answer
_PAUSE_S = 0.2  # until it is asked again

_COUNTED = (MapReply, ServerStatus, ResetReply)
"""Replies whose epoch is told as a number of the whole map."""


@dataclass(frozen=True)
class _Sent:
    """A part of a question that is under way."""

    part: Part[Any]
    replies: Iterable[zenoh.Reply]


@dataclass(frozen=True)
class _Asked:
    """A question that is under way, in parts."""

    request: Request[Any]
    epoch: int  # that all of it is asked of; NEWEST: that of each server
    sent: Sequence[_Sent]


class SharedConnection(Connection):
    """An open session, bound to a map of several servers. Safe for use by several threads.

    The number of an epoch stands for one epoch of each server, which this connection remembers:
    so all answers of that number come from the same states, and none mixes two of one server.
    """

    def __init__(self, whole: Connection, numbers: frozenset[int]) -> None:
        """Go on with a connection, whose session closes once nobody refers to it.

        The servers of some ``numbers`` are there: they are known by now, or after a moment.
        """
        vars(self).update(vars(whole))
        self._whole = whole
        self.shares = Shares()
        self._places: SharedPlaces | None = None  # None: the size of regions is not known yet
        self._epochs = SharedEpochs()
        # It must not refer to this object, so that a connection that is forgotten closes.
        heard = zenoh.handlers.Callback(partial(_heard, self.shares, self._epochs), indirect=False)
        self._subscriber = self._session.liveliness().declare_subscriber(
            shares_key(self.map_name), heard, history=True
        )
        ends_s = time.monotonic() + _PATIENCE_S
        while not numbers <= self.shares.numbers and time.monotonic() < ends_s:
            time.sleep(_PAUSE_S / 10)

    def replies(self, requests: Iterable[Request[ReplyT]]) -> Iterator[ReplyT]:
        """Yield the reply to each request, as :meth:`Connection.replies`.

        Where a server that is asked goes, the others are asked instead.
        """
        waiting: deque[_Asked] = deque()
        for request in requests:
            waiting.append(self._persistent(partial(self._ask, request)))
            if len(waiting) >= PARTS_IN_FLIGHT:
                yield self._answered(waiting.popleft())
        while waiting:
            yield self._answered(waiting.popleft())

    def places(self, known: Epochs | None = None) -> SharedPlaces:
        """Return what finds the servers of places, as far as they had these by ``known`` epochs."""
        if self._places is None:
            status = self.server(self._numbers[0]).ask(StatusRequest())
            self._places = SharedPlaces(self.shares, status.region_pitch_m)
        return replace(self._places, known=known or {})

    def server(self, number: int) -> Connection:
        """Return a connection to one of the servers, by this session."""
        return self._whole.of_map(share_name(self.map_name, number))

    def epochs(self, number: int) -> Epochs:
        """Return the epoch of each server that a number stands for; errors: ``epoch_gone``."""
        return self._epochs.of(number)

    @property
    def _numbers(self) -> list[int]:
        """The servers to ask, the lowest first.

        Raises:
            ConnectError: there is none.
        """
        if not (numbers := self.shares.numbers):
            raise ConnectError(f"none of the servers that share map {self.map_name!r} is there")
        return sorted(numbers)

    def _ask(self, request: Request[Any]) -> _Asked:
        """Send a question to the servers that answer it."""
        is_since = isinstance(request, ChangesRequest)
        epoch = getattr(request, "since" if is_since else "epoch", NEWEST)
        known = {} if epoch == NEWEST else self._epochs.of(epoch)
        if is_since and known and known.keys() != self.shares.numbers:
            raise RefusedError(
                "epoch_gone", f"a server has come since epoch {epoch}: ask for the map again"
            )
        sent = []
        for part in parts_of(request, lambda: self.places(known), sorted(known) or self._numbers):
            own = part.request
            if isinstance(own, ChangesRequest):
                own = replace(own, since=known.get(part.number, NEWEST), server="")
            elif epoch != NEWEST:
                own = _of_epoch(own, known.get(part.number, NEWEST))
            replies = self.server(part.number).sent(own)
            sent.append(_Sent(replace(part, request=own), replies))
        return _Asked(request, epoch, sent)

    def _answered(self, asked: _Asked) -> Any:
        """Return the reply to a question, which is asked again where a server has gone."""
        first = iter([asked])
        return self._persistent(lambda: self._joined(next(first, None) or self._ask(asked.request)))

    def _persistent(self, attempt: Callable[[], ResultT]) -> ResultT:
        """Return what an attempt returns; it is repeated for a while where a server may have gone.

        That is from the first failure on: a server that hangs is waited for once.
        """
        ends_s = math.inf
        while True:
            try:
                return attempt()
            except (
                NoReplyError,
                UnknownMapError,
                RequestTimeoutError,
                ConnectError,
                RefusedError,
            ) as error:
                ends_s = min(ends_s, time.monotonic() + _PATIENCE_S)
                may_pass = not isinstance(error, RefusedError) or error.code == "busy"
                is_over = self.is_closed or is_cancelled() or time.monotonic() >= ends_s
                if is_over or not may_pass:
                    raise
            time.sleep(_PAUSE_S)

    def _joined(self, asked: _Asked) -> Any:
        """Return the reply to a question; errors are those of :meth:`Connection.replies`."""
        parts = [sent.part for sent in asked.sent]
        replies = [self._received(sent) for sent in asked.sent]
        told: dict[str, Any] = {}
        if isinstance(replies[0], _COUNTED):
            told["epoch"] = self._counted(asked.epoch, parts, replies)
        if isinstance(replies[0], ChangesReply):
            told |= {"since": asked.epoch or told["epoch"], "server": self.map_name}
        if isinstance(replies[0], ServerStatus):
            names = "+".join(reply.server for reply in replies)
            told |= {"map_name": self.map_name, "server": names[:256]}
        return joined(parts, replies, told, self.places)

    def _received(self, sent: _Sent) -> Any:
        """Return the reply of one server; errors are those of :meth:`Connection.replies`."""
        number, request = sent.part.number, sent.part.request
        try:
            return self.server(number).received(request, sent.replies)
        except RefusedError as error:
            if not isinstance(request, ResetRequest):
                raise
            raise RefusedError(
                error.code,
                f"server {number} has not reset, and others may have: reset again once it can "
                f"({error.message})",
            ) from error

    def _counted(self, epoch: int, parts: Sequence[Part[Any]], replies: list[Any]) -> int:
        """Return the number of the epochs of replies that were asked for ``epoch``, or NEWEST.

        Of a server whose epoch was not known yet, another part may have had an older one: then it
        is asked again.
        """
        own = {part.number: int(reply.epoch) for part, reply in zip(parts, replies, strict=True)}
        if epoch == NEWEST or isinstance(replies[0], ChangesReply):
            return self._epochs.number(own)
        known = self._epochs.extended(epoch, own)
        for row, (part, reply) in enumerate(zip(parts, replies, strict=True)):
            if reply.epoch != known[part.number]:
                again = _of_epoch(part.request, known[part.number])
                replies[row] = self.server(part.number).ask(again)
        return epoch


def _of_epoch(request: Any, epoch: int) -> Any:
    """Return a question of an epoch of one server."""
    return replace(request, epoch=epoch)


def _heard(shares: Shares, epochs: SharedEpochs, sample: zenoh.Sample) -> None:
    key = str(sample.key_expr)
    if sample.kind == zenoh.SampleKind.PUT:
        shares.add(key)
        return
    shares.remove(key)
    token = read_token(key)
    if token is not None and token.region is None:
        epochs.forget(token.number)
