"""The wire messages. ``docs/wire-protocol.md`` says on which key each travels.

Positions are ``float32`` offsets from a ``float64`` origin, so that a map in large coordinates
(UTM, say) keeps its precision. ``epoch`` in a request pins an epoch; 0 asks for the newest.
Numbers of epochs compare only within one ``ServerStatus.server``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import WireError
from triquad_format.wire import keys
from triquad_format.wire.bounds import (
    MAX_COUNT,
    asked_by,
    corner_above,
    same_as_asked,
    text,
    within,
)
from triquad_format.wire.codec import PLACE, Message, Request, decode
from triquad_format.wire.limits import MAX_CHUNK_BYTES, MAX_SEQUENCE
from triquad_format.wire.packing import ArraySpec

MAX_ORIGIN_BYTES = 1024
"""A longer attachment is not read."""

Positions = Annotated[NDArray[np.float32], ArraySpec("<f4", (None, 3))]
Values = Annotated[NDArray[np.float32], ArraySpec("<f4", (None,))]
StatusCodes = Annotated[NDArray[np.uint8], ArraySpec("|u1", (None,))]
# Those of the map frame: triquad_format.wire.codec.
Point = Annotated[NDArray[np.float64], ArraySpec("<f8", (3,)), PLACE]
Pose = Annotated[NDArray[np.float64], ArraySpec("<f8", (4, 4)), PLACE]
TileIndices = Annotated[NDArray[np.int32], ArraySpec("<i4", (None, 3))]
Integers = Annotated[NDArray[np.int64], ArraySpec("<i8", (None,))]

# Fields with their bounds: triquad_format.wire.bounds.
Count = Annotated[int, within(0, MAX_COUNT)]
Epoch = Annotated[int, within(0, MAX_COUNT)]
Epochs = Annotated[Integers, within(0, MAX_COUNT)]
Duration = Annotated[float, within(0)]  # seconds
Length = Annotated[float, within(0)]  # metres
Statuses = Annotated[StatusCodes, within(0, 2)]  # triquad_format.records.status.Status
FinitePositions = Annotated[Positions, within()]
FinitePoints = Annotated[NDArray[np.float64], ArraySpec("<f8", (None, 3)), within(), PLACE]
Origin = Annotated[NDArray[np.float64], ArraySpec("<f8", (3,)), within()]
Lengths = Annotated[Values, within(0)]
Name = Annotated[str, text(256)]
Ticket = Annotated[int, within(0, 2**63 - 1)]
"""Drawn at random for what takes long: who asks again with the same asks for the same work, and is
refused as ``under_way`` until it is done; with 0 the reply comes when it is."""
UpperCorner = Annotated[Point, corner_above("minimum")]
Digest = Annotated[str, text(64, form="[0-9a-f]{64}")]  # SHA-256


@dataclass(frozen=True)
class Scan(Message):
    """One scan of one source: put on ``triquad/<map>/scan/<source>``.

    ``session`` is drawn at random when a publisher starts; ``sequence`` counts its scans
    from 0, so that the server can count the lost ones. ``stamp_ns`` never runs backwards
    within a session.
    """

    points: Positions  # [N, 3] metres, sensor frame
    world_from_sensor: Pose  # rigid
    stamp_ns: int  # nanoseconds since 1970
    source: str
    session: int
    sequence: int
    no_return: Positions | None = None  # [M, 3] directions of rays that met nothing, sensor frame
    local: bool = False  # the pose counts from the map's origin


@dataclass(frozen=True)
class MapReply(Message):
    """The answer to a question about the map, all of it from one epoch."""

    # number of the published, immutable state of the map that answered
    epoch: Annotated[Epoch, same_as_asked("epoch")]


@dataclass(frozen=True)
class SdfReply(MapReply):
    """Answer to :class:`SdfRequest`."""

    # [N] metres, positive in free space; NaN where no region is
    sdf: Annotated[Values, within(nan=True), asked_by("points")]
    status: Annotated[Statuses, asked_by("points")]  # [N]
    # [N, 3] d(sdf)/dx, map frame
    gradient: Annotated[Positions, within(nan=True), asked_by("points")] | None


@dataclass(frozen=True)
class SdfRequest(Request[SdfReply], operation=keys.SDF):
    """Signed distance, status and, on request, gradient at points of the map frame."""

    origin: Point  # metres, map frame
    points: Positions  # [N, 3] metres, relative to origin
    gradient: bool
    epoch: int


@dataclass(frozen=True)
class CheckpointInfo(Message):
    """A checkpoint on the server's disk; also the answer to :class:`CheckpointRequest`."""

    path: Annotated[str, text(4096)]
    bytes: Count
    epoch: Epoch
    sha256: Digest
    stamp_ns: int


@dataclass(frozen=True)
class FlushReply(Message):
    """Answer to :class:`FlushRequest`, with the counts of this source and session."""

    done: bool  # the scan and those before it are dealt with, and the newest epoch shows them
    taken: Count
    refused: Count
    lost: Count
    last_refusal: str | None
    warnings: tuple[str, ...] = ()  # about this source, as in the status


@dataclass(frozen=True)
class FlushRequest(Request[FlushReply], operation=keys.FLUSH):
    """Ask whether the scan ``sequence`` of this source and session has been dealt with."""

    source: Annotated[str, text(64, form=keys.NAME)]
    session: int
    sequence: Annotated[int, within(0, MAX_SEQUENCE)]
    waited_s: Duration  # how long ago this was first asked


@dataclass(frozen=True)
class CheckpointRequest(Request[CheckpointInfo], operation=keys.CHECKPOINT):
    """Write a checkpoint now; answered with :class:`CheckpointInfo` once it is on disk."""

    ticket: Ticket = 0


@dataclass(frozen=True)
class ResetReply(Message):
    """Answer to :class:`ResetRequest`: what has happened, and how to go back."""

    epoch: Epoch  # the first without the box's content
    kept_epoch: Epoch | None = None  # as which the map of before stays on disk; None: it does not
    undo: Annotated[str, text(4096)] | None = None  # how to go back to it, or why one cannot


@dataclass(frozen=True)
class ResetRequest(Request[ResetReply], operation=keys.RESET):
    """Forget what was learnt within a box of the map frame; infinite sides are allowed."""

    minimum: Point
    maximum: UpperCorner
    ticket: Ticket = 0


@dataclass(frozen=True)
class MapInfo(Message):
    """Answer to :class:`MapInfoRequest`; the file is then fetched in chunks."""

    epoch: Epoch
    bytes: Count
    sha256: Digest
    chunk_bytes: Annotated[int, within(1, MAX_CHUNK_BYTES)]
    server: Name = ""  # a name of this server process; empty where it is not known


@dataclass(frozen=True)
class MapInfoRequest(Request[MapInfo], operation=keys.MAP_INFO, background=True):
    """Prepare the newest epoch as a map file for download."""

    training: bool  # with the state that training needs to go on
    ticket: Ticket = 0


@dataclass(frozen=True)
class MapChunk(Message):
    """Answer to :class:`MapChunkRequest`."""

    offset: Annotated[int, same_as_asked("offset", any_for=None)]
    data: Annotated[bytes, asked_by("length")]


@dataclass(frozen=True)
class MapChunkRequest(Request[MapChunk], operation=keys.MAP_CHUNK, background=True):
    """Bytes ``[offset, offset + length)`` of the map file with this digest."""

    sha256: str
    offset: int
    length: int  # at most chunk_bytes are sent


@dataclass(frozen=True)
class ErrorReply(Message):
    """The answer of an operation, as a Zenoh error reply, where it cannot do what was asked."""

    code: str  # one of triquad_format.errors.ERROR_CODES
    message: str


@dataclass(frozen=True)
class RequestOrigin(Message):
    """Attached to a request, so that clients are answered in turn and nobody works for nothing."""

    client: str  # Zenoh id of the session that asks, hexadecimal
    timeout_s: float  # nobody waits for the reply for longer
    local: bool = False  # places of the request and of its reply count from the map's origin


def read_origin(attachment: bytes) -> RequestOrigin | None:
    """Return the origin that an attachment names; ``None`` where it names none."""
    if len(attachment) > MAX_ORIGIN_BYTES:
        return None
    try:
        return decode(RequestOrigin, attachment)
    except WireError:
        return None
