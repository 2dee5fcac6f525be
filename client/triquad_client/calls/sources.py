"""The sources of scans: the trail of each, and its newest scan."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from triquad_format.errors import InvalidInputError
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.wire.limits import MAX_SAMPLE_POINTS
from triquad_format.wire.query_messages import (
    ScanSample,
    SourcesRequest,
    SourceState,
)

from triquad_client import checks
from triquad_client.errors import BadReplyError
from triquad_client.net.connection import Connection


@dataclass(frozen=True)
class NewestScan:
    """The scan of a source that was accepted into the map last."""

    stamp_ns: int  # when it was taken, nanoseconds since 1970, as its publisher said
    world_from_sensor: Doubles  # [4, 4] pose of the sensor in the map frame
    points: Doubles  # [N, 3] metres, map frame: some of those that the map uses
    points_used: int  # as many the map uses: in range, and thinned

    @property
    def position_m(self) -> Doubles:
        """The position of the sensor: [3] metres, map frame."""
        return self.world_from_sensor[:3, 3]


@dataclass(frozen=True)
class ScanSource:
    """A source of scans, and where its sensor has been."""

    name: str
    scans: int  # that were accepted into the map since the server heard of the source
    trail: Doubles  # [N, 3] positions of the sensor, metres, map frame, oldest first
    pieces: Longs  # [N] the piece of the trail each is part of: rises where the sensor jumped
    newest: NewestScan | None  # None: a reset forgot it, and no scan has come since

    def lines(self) -> list[Doubles]:
        """Return the trail as lines to draw: [K, 3] a piece, the last one up to the newest scan."""
        lines = np.split(self.trail, np.flatnonzero(np.diff(self.pieces)) + 1)
        if self.newest is not None:
            lines[-1] = np.concatenate([lines[-1], self.newest.position_m[None]])
        return [line for line in lines if len(line)]


@dataclass(frozen=True)
class SourceReport:
    """All sources of scans that a server knows of, with their whole trails."""

    server: str  # the run of the server, within which revisions compare
    revision: int  # rises with each scan that is accepted into the map
    sources: Mapping[str, ScanSource]  # by name


class SourceCalls:
    """The call that tells where the sources of scans have been."""

    _connection: Connection

    def sources(self, since: SourceReport | None = None, max_points: int = 5_000) -> SourceReport:
        """Return where each source of scans has been, and its newest scan.

        To follow them, give the report before: it comes back where nothing is new.

        Args:
            since: the report before; ``None``: nothing is known yet.
            max_points: 0 to 10,000: as many points of each newest scan come, evenly drawn.

        Raises:
            NoReplyError: the server may be of a release that does not know this question.
        """
        if since is not None and not isinstance(since, SourceReport):
            raise InvalidInputError(f"since = {since!r}: give what an earlier call returned")
        limit = checks.count("max_points", max_points, MAX_SAMPLE_POINTS)
        known = since or SourceReport(server="", revision=0, sources={})
        request = SourcesRequest(server=known.server, revision=known.revision, max_points=limit)
        reply = self._connection.ask(request)
        if reply.sources is not None:
            found = {name: _source(name, state) for name, state in reply.sources.items()}
            return SourceReport(reply.server, reply.revision, found)
        if (reply.server, reply.revision) != (known.server, known.revision):
            raise BadReplyError(
                f"nothing is new of server {known.server!r}, revision {known.revision}, says "
                f"server {reply.server!r}, revision {reply.revision}"
            )
        return known


def _source(name: str, state: SourceState) -> ScanSource:
    newest = None if state.newest is None else _newest(state.newest)
    return ScanSource(name, state.scans, state.trail, pieces=state.pieces, newest=newest)


def _newest(sample: ScanSample) -> NewestScan:
    pose = sample.world_from_sensor
    return NewestScan(
        stamp_ns=sample.stamp_ns,
        world_from_sensor=pose,
        points=pose[:3, 3] + sample.points,
        points_used=sample.points_used,
    )
