"""All that both clients can do with a server, each written once."""

from pathlib import Path

from numpy.typing import ArrayLike
from triquad_format.mapfile.writer import MapFileInfo
from triquad_format.wire.messages import (
    CheckpointInfo,
    MapInfo,
    ResetReply,
    ServerStatus,
    TileList,
)
from triquad_format.wire.metrics_messages import ServerMetrics

from triquad_client.calls import admin, changes, download, sources
from triquad_client.calls.changes import ChangeReport
from triquad_client.calls.queries import QueryOperations
from triquad_client.calls.scans import FlushReport, ScanPublisher
from triquad_client.calls.sources import SourceReport
from triquad_client.checks import Bounds, PoseLike
from triquad_client.depth_image import Intrinsics, depth_points
from triquad_client.mesh.followed_mesh import FollowedMesh, KnownTiles
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.mesh_calls import fetch_mesh, fetch_tile, fetch_tiles
from triquad_client.net.call import Call, put
from triquad_client.net.connection import Connection
from triquad_client.net.operation import operation


class ClientOperations(QueryOperations):
    """The operations of a client over a connection."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._scans = ScanPublisher(connection)

    @property
    def map_name(self) -> str:
        """The map this client works with."""
        return self._connection.map_name

    @operation
    def publish_scan(
        self,
        points: ArrayLike,
        world_from_sensor: PoseLike,
        stamp_s: float | None = None,
        source: str = "default",
        no_return: ArrayLike | None = None,
    ) -> Call[None]:
        """Send a scan to be learnt. Returns once it is handed to the network.

        Args:
            points: [N, 3] metres, sensor frame; points that are not finite are left out, and so
                are up to 13 more columns, such as intensities.
            world_from_sensor: rigid pose of the sensor in the map frame: [4, 4], or a
                :class:`Pose` of position and quaternion.
            stamp_s: seconds since 1970, never running backwards within a source; ``None``: now.
            source: name of the sensor.
            no_return: directions [M, 3], sensor frame, of any length but 0, of rays that met
                nothing within the sensor's range: the space along them is free. A ray of which
                this is not known does not belong here; see docs/client.md. ``points`` may be
                empty where there are any.

        Raises:
            InvalidScanError: the scan cannot be used; nothing was sent.
        """
        return put(
            lambda: self._scans.publish(
                points, world_from_sensor, stamp_s, source=source, no_return=no_return
            )
        )

    @operation
    def publish_depth(
        self,
        depth: ArrayLike,
        intrinsics: Intrinsics,
        world_from_camera: PoseLike,
        stamp_s: float | None = None,
        source: str = "default",
        stride: int = 1,
    ) -> Call[None]:
        """Send a depth image to be learnt. Returns once it is handed to the network.

        Servers ignore what is nearer than 1.5 m unless set otherwise: see ``range_min_m`` in
        docs/settings.md, which each source can have for itself.

        Args:
            depth: [rows, columns] along the optical axis: metres as floating numbers, or
                millimetres as ``uint16``. A pixel that is 0 or not finite shows nothing.
            intrinsics: of the camera; the image must be rectified.
            world_from_camera: pose of the camera's optical frame (x to the right, y down, z
                forward) in the map frame, as in :meth:`publish_scan`.
            stamp_s: as in :meth:`publish_scan`.
            source: name of the camera.
            stride: every how many rows and columns one is taken, where an image has more pixels
                than a scan may have points.

        Raises:
            InvalidScanError: the image cannot be used; nothing was sent.
        """
        return put(
            lambda: self._scans.publish(
                depth_points(depth, intrinsics, stride),
                world_from_camera,
                stamp_s,
                source=source,
                no_return=None,
            )
        )

    @operation
    def restart_source(self, source: str = "default") -> Call[None]:
        """Let the time of a source begin again, as that of a simulation that was started again.

        Its next scan may have any stamp. :meth:`flush` counts only those from then on.
        """
        return put(lambda: self._scans.restart(source))

    @operation
    def flush(self, timeout_s: float = 30.0, pending: int = 0) -> Call[FlushReport]:
        """Wait until what this client published is dealt with and queries see it.

        Args:
            timeout_s: how long, at most.
            pending: number of scans that may still be under way: more than 0 lets a fast
                publisher run ahead of the server by as many.

        Returns:
            What became of the scans so far.

        Raises:
            RefusedError: ``timeout``, where that was not long enough.
        """
        return self._scans.flush(timeout_s, pending)

    @operation
    def settle(self, timeout_s: float = 600.0) -> Call[ServerStatus]:
        """Wait until what this client published is dealt with and nothing is left to learn.

        Raises:
            RequestTimeoutError: it still had some after ``timeout_s``.
        """
        return self._scans.settle(timeout_s)

    @operation
    def changes(
        self, since: int | ChangeReport | None = None, bounds: Bounds | None = None
    ) -> Call[ChangeReport]:
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
        return changes.changes(since, bounds)

    @operation
    def sources(
        self, since: SourceReport | None = None, max_points: int = 5_000
    ) -> Call[SourceReport]:
        """Return where each source of scans has been, and its newest scan.

        To follow them, give the report before: only what is new travels, and the report has all.

        Args:
            since: the report before; ``None``: nothing is known yet.
            max_points: 0 to 10,000: as many points of each newest scan come, evenly drawn.

        Raises:
            NoReplyError: the server may be of a release that does not know this question.
        """
        return sources.sources(since, max_points)

    @operation
    def tiles(self, bounds: Bounds | None = None, level: int = 0) -> Call[TileList]:
        """Return the mesh tiles that meet ``bounds``, with the epoch in which each last changed.

        Args:
            bounds: corners of a box, metres, map frame; ``None``: everywhere.
            level: of detail: 0, 1 or 2, each with cells and tiles twice as large as the one before.
        """
        return fetch_tiles(bounds, level)

    @operation
    def mesh_tile(self, x: int, y: int, z: int, level: int = 0) -> Call[Mesh]:
        """Return the newest mesh of one tile of a level's lattice, as :meth:`tiles` names it."""
        return fetch_tile((x, y, z), level, self._connection.max_download_bytes)

    @operation
    def mesh(self, bounds: Bounds | None = None, level: int = 0, fill_m: float = 0.0) -> Call[Mesh]:
        """Return the mesh in ``bounds`` (faces by their centroids), its tiles joined, of one epoch.

        Args:
            bounds: corners of a box, metres, map frame; ``None``: everywhere.
            level: of detail: 0, 1 or 2, each with cells twice as large as the one before.
            fill_m: also the surface up to so far from what was seen, 0 to 5 m, where the field
                continues it into ``UNKNOWN`` space; those faces are marked in ``Mesh.filled``.
        """
        limit = self._connection.max_download_bytes
        return fetch_mesh(bounds, level, limit, fill_m)

    @operation
    def status(self) -> Call[ServerStatus]:
        """Return how the server is doing."""
        return admin.status()

    @operation
    def metrics(self) -> Call[ServerMetrics]:
        """Return how the server is doing, in figures: requests and their times, queues, memory.

        Counts and times only grow while a server runs: take the difference of two answers.
        """
        return admin.metrics()

    @operation
    def checkpoint(self) -> Call[CheckpointInfo]:
        """Have the server write the map to its store now.

        Raises:
            RefusedError: ``store``, where it cannot be written.
        """
        return admin.checkpoint()

    @operation
    def reset(self, bounds: Bounds | None = None) -> Call[ResetReply]:
        """Forget what was learnt within ``bounds``.

        A server with a store first writes the map as it is to a checkpoint, which stays until so
        many more resets as its setting ``store.keep_resets`` says.

        Args:
            bounds: corners of a box, metres, map frame; ``None``: everything is forgotten.

        Returns:
            ``epoch``: the first without it. ``kept_epoch``: the checkpoint of the map before;
            ``None`` where there is none. ``undo``: how to go back to it, or why one cannot.

        Raises:
            RefusedError: ``store``, where the map as it is cannot be kept: nothing is forgotten.
        """
        return admin.reset(bounds)

    @operation
    def download_map(self, path: str | Path, training: bool = False) -> Call[MapInfo]:
        """Write the newest map to a file, checked against its digest, all of it or nothing.

        Args:
            path: the file; an older one is replaced.
            training: with the state from which training can go on.

        Raises:
            DownloadError: what arrived is not what the server announced.
            OSError: the file cannot be written.
        """
        return download.fetch(Path(path), training, self._connection.max_download_bytes)

    @operation
    def download_box(self, path: str | Path, bounds: Bounds) -> Call[MapFileInfo]:
        """Write to a file what the newest map needs to answer within ``bounds``.

        Only the file's index and the parts that the box needs are sent. The file has no preview
        for MCAP viewers: ``triquad-pack`` adds one.

        Args:
            path: the file; an older one is replaced.
            bounds: corners of a box, metres, map frame.

        Raises:
            InvalidInputError: the bounds are not a box, or contain nothing.
            DownloadError: nothing of the map lies in the box, or what arrived is not valid.
            OSError: the file cannot be written.
        """
        return download.fetch_box(Path(path), bounds, self._connection.max_download_bytes)

    def _followed(
        self,
        bounds: Bounds | None,
        level: int,
        max_bytes_per_s: int | None,
        known: KnownTiles | None,
    ) -> FollowedMesh:
        """Return the mesh of a watch that begins; arguments as of ``Client.watch_mesh``."""
        return FollowedMesh.initial(
            bounds,
            level,
            max_bytes_per_s=max_bytes_per_s,
            known=known,
            max_bytes=self._connection.max_download_bytes,
        )
