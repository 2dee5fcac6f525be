"""Questions about a map that several servers share: who answers which part, and all as one."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Bools
from triquad_format.wire.codec import Message, Request
from triquad_format.wire.map_messages import CreateMapRequest, DropMapRequest
from triquad_format.wire.messages import (
    CheckpointInfo,
    CheckpointRequest,
    FlushReply,
    FlushRequest,
    ResetReply,
    ResetRequest,
    SdfRequest,
)
from triquad_format.wire.query_messages import (
    AlignRequest,
    ChangesReply,
    ChangesRequest,
    DistanceReply,
    DistanceRequest,
    GridRequest,
    GroundRequest,
    RaysRequest,
    SegmentsRequest,
    SpheresRequest,
)
from triquad_format.wire.source_messages import CorrectPosesRequest
from triquad_format.wire.status_messages import ServerStatus, StatusRequest

from triquad_client.net.connection import ReplyT
from triquad_client.net.shared_places import SharedPlaces

_BY_ROW = {
    SdfRequest: ("points",),
    DistanceRequest: ("points",),
    SpheresRequest: ("centres", "radii_m"),
    SegmentsRequest: ("starts", "ends"),
    RaysRequest: ("starts", "directions"),
    GroundRequest: ("points",),
}
"""The fields with a row for each thing that is asked about; the first tells where it is."""

_OF_ALL = (StatusRequest, FlushRequest, CheckpointRequest, ResetRequest, ChangesRequest)
_OF_NONE = (CorrectPosesRequest, CreateMapRequest, DropMapRequest)


@dataclass(frozen=True)
class Part(Generic[ReplyT]):
    """The part of a question that one server answers."""

    number: int  # of the server
    request: Request[ReplyT]
    rows: NDArray[np.intp] | None = None  # of the question; None: it has no rows
    owned: Bools | None = None  # of these rows, those whose place is in a region of this server


def parts_of(
    request: Request[Any], find: Callable[[], SharedPlaces], numbers: Sequence[int]
) -> list[Part[Any]]:
    """Return the parts of a question.

    Args:
        request: the question.
        find: returns what finds the servers of places.
        numbers: all servers, of which there are some.

    Raises:
        RefusedError: ``bad_request``: a shared map cannot do this.
    """
    if isinstance(request, _OF_NONE):
        raise RefusedError(
            "bad_request",
            f"{request.operation} is not for a map that several servers share: ask a server that "
            "has a map alone",
        )
    if (fields := _BY_ROW.get(type(request))) is not None:
        return _by_row(request, fields, find(), numbers)
    if isinstance(request, _OF_ALL):
        return [Part(number, request) for number in numbers]
    if isinstance(request, GridRequest):
        middle = request.corner + request.counts * request.cell_m / 2
        return [Part(int(find().owners(middle[None])[0]), request)]
    if isinstance(request, AlignRequest):
        place = request.world_from_sensor[None, :3, 3]
        return [Part(int(find().owners(place)[0]), request)]
    return [Part(numbers[0], request)]  # each knows all of the map as the stores have it


def _by_row(
    request: Any, fields: Sequence[str], places: SharedPlaces, numbers: Sequence[int]
) -> list[Part[Any]]:
    """Return a part for each server of some of the rows; without any, all are asked.

    Of distances, those that have regions within reach are asked, too: they know best what is there.
    """
    points = request.origin + getattr(request, fields[0])
    owners = places.owners(points)
    rows = {number: owners == number for number in np.unique(owners).tolist() or numbers}
    if isinstance(request, DistanceRequest):
        for number, near in places.near(points, request.max_distance_m):
            rows.setdefault(number, np.zeros(len(points), np.bool_))[near] = True
        # Whose a surface is, its place tells.
        request = replace(request, surface_point=request.surface_point or len(rows) > 1)
    parts = []
    for number, chosen in rows.items():
        some = {name: getattr(request, name)[chosen] for name in fields}
        asked = replace(request, **some)
        parts.append(Part(number, asked, np.flatnonzero(chosen), owners[chosen] == number))
    return parts


def joined(
    parts: Sequence[Part[Any]],
    replies: Sequence[Any],
    told: Mapping[str, Any],
    find: Callable[[], SharedPlaces],
) -> Any:
    """Return the reply of the servers as one, with what is ``told`` of all of them together.

    ``find`` returns what finds the servers of places.
    """
    first = replies[0]
    if parts[0].rows is not None:
        return replace(first, **_rows(parts, replies, find), **told)
    if isinstance(first, ServerStatus):
        return replace(_status(replies), **told)
    if isinstance(first, FlushReply):
        return _flushed(parts, replies)
    if isinstance(first, CheckpointInfo):
        newest = max(replies, key=lambda reply: int(reply.stamp_ns))
        return replace(newest, bytes=sum(reply.bytes for reply in replies), **told)
    if isinstance(first, ResetReply):
        told_by = zip(parts, replies, strict=True)
        undo = "; ".join(f"server {part.number}: {reply.undo}" for part, reply in told_by)
        return replace(first, kept_epoch=None, undo=undo[:4096], **told)
    if isinstance(first, ChangesReply):
        boxes: Mapping[str, Any] = _ends(replies, _BOX_FIELDS)
        return replace(first, **boxes, **told)
    return replace(first, **told) if told else first


def _rows(
    parts: Sequence[Part[Any]], replies: Sequence[Message], find: Callable[[], SharedPlaces]
) -> dict[str, Any]:
    """Return the arrays of replies, each row where it was in the question.

    Of a row that several have answered, that of its owner counts. A distance is that to the nearest
    surface, of which others than the owner tell as far as it lies in their regions.
    """
    rows = np.concatenate([part.rows for part in parts if part.rows is not None])
    others = ~np.concatenate([part.owned for part in parts if part.owned is not None])
    arrays = [name for name, value in vars(replies[0]).items() if isinstance(value, np.ndarray)]
    ends = _ends(replies, arrays)
    chosen = dict.fromkeys(arrays, _least(rows, others))
    if isinstance(replies[0], DistanceReply) and others.any():
        asked: Any = parts[0].request
        counts = [len(reply.status) for reply in replies if isinstance(reply, DistanceReply)]
        numbers = np.repeat([part.number for part in parts], counts)
        is_own = find().owners(asked.origin + ends["surface_point"]) == numbers
        is_told = (ends["found"] != 0) & (is_own | ~others)
        off_m = np.where(is_told, np.abs(ends["distance_m"]), np.inf)
        chosen |= dict.fromkeys(_OF_SURFACE, _least(rows, off_m, others))
    return {name: ends[name][chosen[name]] for name in arrays}


def _least(rows: NDArray[np.intp], *keys: NDArray[Any]) -> NDArray[np.intp]:
    """Return, for each row in order, where among all it has the least key."""
    order = np.lexsort((*keys[::-1], rows))
    is_first = np.diff(rows[order], prepend=-1) > 0
    return order[is_first]


def _ends(replies: Sequence[Message], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    return {name: np.concatenate([getattr(one, name) for one in replies]) for name in names}


def _flushed(parts: Sequence[Part[Any]], replies: Sequence[FlushReply]) -> FlushReply:
    """Return what became of scans, each of which has come to every server that was there then."""
    request = parts[0].request
    assert isinstance(request, FlushRequest)
    # One that was started later has heard of none: that counts where nobody has heard of any.
    heard = [one for one in replies if one.taken + one.refused or one.lost <= request.sequence]
    heard = heard or list(replies)
    refused, lost = (max(getattr(one, name) for one in heard) for name in ("refused", "lost"))
    heard_of = max(one.taken + one.refused + one.lost for one in heard)
    return FlushReply(
        done=all(reply.done for reply in replies),
        taken=max(0, heard_of - refused - lost),
        refused=refused,
        lost=lost,
        last_refusal=next((one.last_refusal for one in replies if one.last_refusal), None),
        warnings=tuple(dict.fromkeys(line for reply in heard for line in reply.warnings)),
    )


_OF_SURFACE = ("distance_m", "gradient", "found", "confidence", "surface_point")
_BOX_FIELDS = ("minimum", "maximum", "appeared", "epochs", "voxels")

_SUMS = (
    "scans_taken",
    "samples_trained",
    "samples_left",
    "samples_discarded",
    "rays_kept",
    "rays_discarded",
    "memory_bytes",
    "map_bytes",
    "map_max_bytes",
)
_LARGEST = ("scans_waiting", "regions", "vertices", "parameters", "uptime_s")
_COUNTS = ("scans_dropped", "points_dropped", "requests_refused", "memory_parts")


def _status(replies: Sequence[ServerStatus]) -> ServerStatus:
    """Return how all servers are doing; each tells of all regions, and of what it does itself."""
    changes: dict[str, Any] = {name: sum(getattr(one, name) for one in replies) for name in _SUMS}
    changes |= {name: max(getattr(one, name) for one in replies) for name in _LARGEST}
    for name in _COUNTS:
        counts: Counter[str] = Counter()
        for one in replies:
            counts.update(getattr(one, name))
        changes[name] = dict(counts)
    sources = {source for one in replies for source in one.scans_lost}
    lost = {source: max(one.scans_lost.get(source, 0) for one in replies) for source in sources}
    in_memory = sum(one.regions - one.regions_cold for one in replies)
    return replace(
        replies[0],
        **changes,
        scans_lost=lost,
        settled=all(one.settled for one in replies),
        store_error=next((one.store_error for one in replies if one.store_error), None),
        warnings=tuple(dict.fromkeys(line for one in replies for line in one.warnings)),
        fit=None,
        kept_scans=None,
        regions_cold=max(0, changes["regions"] - in_memory),
    )
