"""The messages that open and drop maps of a server: asked of any map that it has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from triquad_format.wire import keys
from triquad_format.wire.bounds import text
from triquad_format.wire.codec import Message, Request
from triquad_format.wire.messages import Ticket

MapName = Annotated[str, text(64, form=keys.NAME)]


@dataclass(frozen=True)
class CreateMapReply(Message):
    """Answer to :class:`CreateMapRequest`: the map can be used."""

    maps: tuple[MapName, ...]  # that the server has by now


@dataclass(frozen=True)
class CreateMapRequest(Request[CreateMapReply], operation=keys.CREATE_MAP):
    """Open another map on the server: the one of this name in its store, else an empty one."""

    name: MapName
    ticket: Ticket = 0


@dataclass(frozen=True)
class DropMapReply(Message):
    """Answer to :class:`DropMapRequest`: the map is no more."""

    maps: tuple[MapName, ...]  # that the server still has
    kept: Annotated[str, text(4096)] | None = None  # folder of what it was; None: nothing is kept


@dataclass(frozen=True)
class DropMapRequest(Request[DropMapReply], operation=keys.DROP_MAP):
    """Close another map of the server, and set its folder aside."""

    name: MapName
    ticket: Ticket = 0
