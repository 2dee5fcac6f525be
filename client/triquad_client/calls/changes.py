"""The changes of a map: where surface appeared and vanished."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from triquad_format.wire.query_messages import ChangesReply, ChangesRequest

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.net.connection import Connection

Corner = tuple[float, float, float]


class ChangeKind(Enum):
    """The kind of a change of surface."""

    APPEARED = "appeared"
    VANISHED = "vanished"


@dataclass(frozen=True)
class ChangedBox:
    """A box, metres, map frame, around voxels in which surface appeared, or vanished."""

    kind: ChangeKind
    minimum: Corner
    maximum: Corner
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

    def __repr__(self) -> str:
        told = f"{len(self.boxes)} boxes since epoch {self.since}"
        return f"ChangeReport({told}; epoch {self.epoch})"


class ChangeCalls:
    """The call that tells what changed."""

    _connection: Connection

    def changes(
        self, since: int | ChangeReport | None = None, bounds: Bounds | None = None
    ) -> ChangeReport:
        """Return where surface appeared or vanished since an epoch, a published state of the map.

        What appeared and vanished again is not listed. To follow the map, give the report before:
        its epoch, and its server, so that a restart is noticed whatever the epochs' numbers.

        Args:
            since: number of an epoch, of this run of the server; or an earlier report; ``None``:
                the newest, to which nothing is listed.
            bounds: corners of a box, metres, map frame; ``None``: everywhere.

        Raises:
            RefusedError: ``epoch_gone``: the server was restarted, does not remember as far back,
                or has not published that epoch. Ask for what you need of the map again.
        """
        if isinstance(since, ChangeReport):
            epoch, server = since.epoch, since.server
        else:
            epoch, server = checks.chosen_epoch(since, "since"), ""
        reply = self._connection.ask(ChangesRequest(epoch, server, *checks.box(bounds)))
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
