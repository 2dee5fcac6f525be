"""The changes of a map: where surface appeared and vanished."""

from dataclasses import dataclass
from enum import Enum

from triquad_format.wire import keys
from triquad_format.wire.query_messages import ChangesReply, ChangesRequest

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.net.call import Ask, Call, ask

Corner = tuple[float, float, float]


class ChangeKind(Enum):
    """The kind of a change of surface."""

    APPEARED = "appeared"
    VANISHED = "vanished"


@dataclass(frozen=True)
class ChangedBox:
    """A box around voxels in which surface appeared, or vanished. Corners are in the map frame."""

    kind: ChangeKind
    minimum: Corner  # metres
    maximum: Corner  # metres
    epoch: int  # of the newest change in it
    voxels: int  # that changed: cubes of the side of a leaf

    @property
    def bounds(self) -> tuple[Corner, Corner]:
        """Its corners, as other questions take them."""
        return self.minimum, self.maximum


@dataclass(frozen=True)
class ChangeReport:
    """The difference of the surface in one epoch, a published state of the map, from another."""

    epoch: int  # up to here: ask for changes since this one next time
    since: int
    server: str  # the run of the server, within which numbers of epochs compare
    boxes: tuple[ChangedBox, ...]  # those of most voxels first


def changes(since: int | ChangeReport | None, bounds: Bounds | None) -> Call[ChangeReport]:
    """Return what changed within ``bounds`` since an epoch, or since an earlier report."""
    if isinstance(since, ChangeReport):
        epoch, server = since.epoch, since.server
    else:
        epoch, server = checks.chosen_epoch(since, "since"), ""
    minimum, maximum = checks.box(bounds)
    request = ChangesRequest(since=epoch, server=server, minimum=minimum, maximum=maximum)
    reply = yield from ask(Ask(keys.CHANGES, request, ChangesReply))
    return ChangeReport(reply.epoch, reply.since, reply.server, boxes=_boxes(reply))


def _boxes(reply: ChangesReply) -> tuple[ChangedBox, ...]:
    """Return the boxes of a reply, those of most voxels first."""
    columns = (reply.appeared, reply.minimum, reply.maximum, reply.epochs, reply.voxels)
    boxes = [
        ChangedBox(
            ChangeKind.APPEARED if appeared else ChangeKind.VANISHED,
            minimum=tuple(low),
            maximum=tuple(high),
            epoch=epoch,
            voxels=voxels,
        )
        for appeared, low, high, epoch, voxels in zip(
            *(column.tolist() for column in columns), strict=True
        )
    ]
    return tuple(sorted(boxes, key=lambda box: -box.voxels))
