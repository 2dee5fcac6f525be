"""The client: publishes scans to a map server, and asks it about the map."""

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

from triquad_client.calls import admin, changes, download, questions, sources
from triquad_client.calls.changes import ChangeReport
from triquad_client.calls.queries import MapQueries, PinnedMap
from triquad_client.calls.scans import FlushReport, ScanPublisher
from triquad_client.calls.sources import SourceReport
from triquad_client.checks import Bounds, PoseLike
from triquad_client.depth_image import Intrinsics, depth_points
from triquad_client.mesh.followed_mesh import FollowedMesh, KnownTiles
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.mesh_calls import fetch_mesh, fetch_tile, fetch_tiles
from triquad_client.mesh.mesh_watch import MeshWatch
from triquad_client.net.connection import Connection, RemoteDriver
from triquad_client.offline.synced_map import SyncedMap


class Client(MapQueries):
    """A connection to one map of a server. Close it, or use it in a ``with`` statement.

    Positions are metres in the map frame. All methods may be called from several threads, and
    raise a :class:`TriquadError` where they fail: :class:`RefusedError` where the server refuses,
    :class:`RequestTimeoutError` where it does not answer in time, :class:`InvalidInputError`
    where an argument cannot be used.
    """

    def __init__(self, connection: Connection) -> None:
        """Use :func:`triquad_client.connect`."""
        self._connection = connection
        self._driver = RemoteDriver(connection)
        self._scans = ScanPublisher(connection)
        super().__init__(self._driver.run)

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def map_name(self) -> str:
        """The map this client works with."""
        return self._connection.map_name

    def close(self) -> None:
        """End the connection. Scans that were published may still be on their way: flush first."""
        self._connection.close()

    def publish_scan(
        self,
        points: ArrayLike,
        world_from_sensor: PoseLike,
        stamp_s: float | None = None,
        source: str = "default",
        no_return: ArrayLike | None = None,
    ) -> None:
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
        self._scans.publish(points, world_from_sensor, stamp_s, source=source, no_return=no_return)

    def publish_depth(
        self,
        depth: ArrayLike,
        intrinsics: Intrinsics,
        world_from_camera: PoseLike,
        stamp_s: float | None = None,
        source: str = "default",
        stride: int = 1,
    ) -> None:
        """Send a depth image to be learnt. Returns once it is handed to the network.

        Servers ignore what is nearer than 1.5 m unless told otherwise: see ``range_min_m`` in
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
        points = depth_points(depth, intrinsics, stride)
        self.publish_scan(points, world_from_camera, stamp_s, source)

    def restart_source(self, source: str = "default") -> None:
        """Let the time of a source begin again, as that of a simulation that was started again.

        Its next scan may have any stamp. :meth:`flush` counts only those from then on.
        """
        self._scans.restart(source)

    def flush(self, timeout_s: float = 30.0, pending: int = 0) -> FlushReport:
        """Wait until what this client published is dealt with and queries see it.

        Args:
            timeout_s: how long, at most.
            pending: number of scans that may still be under way: more than 0 lets a fast
                publisher run ahead of the server by so many.

        Returns:
            What became of the scans so far.

        Raises:
            RefusedError: ``timeout``, where that was not long enough.
        """
        return self._run(self._scans.flush(timeout_s, pending))

    def settle(self, timeout_s: float = 600.0) -> ServerStatus:
        """Wait until what this client published is dealt with and nothing is left to learn.

        Raises:
            RequestTimeoutError: it still had some after ``timeout_s``.
        """
        return self._run(self._scans.settle(timeout_s))

    def pinned(self) -> PinnedMap:
        """The map as it is now, for queries that belong together."""
        return PinnedMap(self._run, self._run(questions.pin_newest()))

    def changes(
        self, since: int | ChangeReport | None = None, bounds: Bounds | None = None
    ) -> ChangeReport:
        """Where surface appeared or vanished since an epoch, a published state of the map.

        What appeared and vanished again is not listed. To follow the map, give the report before:
        its epoch, and its server, so that a restart is noticed whatever the epochs' numbers.

        Args:
            since: number of an epoch, of this run of the server; or an earlier report; ``None``:
                the newest, to which nothing is listed.
            bounds: corners of a box, metres, map frame; ``None``: everywhere.

        Raises:
            RefusedError: ``epoch_gone``: the server was restarted, does not remember as far back,
                or has not published that epoch. Ask for what you need of the map anew.
        """
        return self._run(changes.changes(since, bounds))

    def sources(self, since: SourceReport | None = None, max_points: int = 5_000) -> SourceReport:
        """Where each source of scans has been, and what its newest scan looks like.

        To follow them, give the report before: only what is new travels, and the report has all.

        Args:
            since: the report before; ``None``: nothing is known yet.
            max_points: of each newest scan, 0 to 10,000: as many of its points come, evenly drawn.

        Raises:
            NoReplyError: the server may be of a release that does not know this question.
        """
        return self._run(sources.sources(since, max_points))

    def tiles(self, bounds: Bounds | None = None, level: int = 0) -> TileList:
        """The mesh tiles that meet ``bounds``, with the epoch in which each last changed.

        Args:
            bounds: corners of a box, metres, map frame; ``None``: everywhere.
            level: of detail: 0, 1 or 2, each with cells and tiles twice as large as the one before.
        """
        return self._run(fetch_tiles(bounds, level))

    def mesh_tile(self, x: int, y: int, z: int, level: int = 0) -> Mesh:
        """The newest mesh of one tile of a level's lattice, as :meth:`tiles` names it."""
        return self._run(fetch_tile((x, y, z), level, self._connection.max_download_bytes))

    def mesh(self, bounds: Bounds | None = None, level: int = 0, fill_m: float = 0.0) -> Mesh:
        """The mesh within ``bounds`` (faces by their centroids), its tiles joined, of one epoch.

        Args:
            bounds: corners of a box, metres, map frame; ``None``: everywhere.
            level: of detail: 0, 1 or 2, each with cells twice as large as the one before.
            fill_m: also the surface up to so far from what was seen, 0 to 5 m, where the field
                continues it into ``UNKNOWN`` space; those faces are marked in ``Mesh.filled``.
        """
        limit = self._connection.max_download_bytes
        return self._run(fetch_mesh(bounds, level, limit, fill_m))

    def watch_mesh(
        self,
        bounds: Bounds | None = None,
        level: int = 0,
        max_bytes_per_s: int | None = None,
        known: KnownTiles | None = None,
    ) -> MeshWatch:
        """Follow the mesh tiles that meet ``bounds``: they are fetched once, then as they change.

        Args:
            bounds: corners of a box, metres, map frame; ``None``: everywhere.
            level: of detail: 0, 1 or 2, each with cells twice as large as the one before.
            max_bytes_per_s: what this watch may take of the network; the server may allow less.
            known: tiles of an earlier watch, which are not fetched again.

        Raises:
            InvalidInputError: an argument cannot be used, or ``known`` is of another level.
        """
        followed = FollowedMesh.initial(
            bounds,
            level,
            max_bytes_per_s=max_bytes_per_s,
            known=known,
            max_bytes=self._connection.max_download_bytes,
        )
        return MeshWatch(self._connection, followed)

    def status(self) -> ServerStatus:
        """How the server is doing."""
        return self._run(admin.status())

    def metrics(self) -> ServerMetrics:
        """How the server is doing, in figures: requests and their times, queues, memory.

        Counts and times only grow while a server runs: take the difference of two answers.
        """
        return self._run(admin.metrics())

    def checkpoint(self) -> CheckpointInfo:
        """Have the server write the map to its store now.

        Raises:
            RefusedError: ``store``, where it cannot be written.
        """
        return self._run(admin.checkpoint())

    def reset(self, bounds: Bounds | None = None) -> ResetReply:
        """Forget what was learnt within ``bounds``.

        A server with a store first writes the map as it is to a checkpoint, which stays for its
        setting ``store.protect_h``, whatever else happens.

        Args:
            bounds: corners of a box, metres, map frame; ``None``: everything is forgotten.

        Returns:
            ``epoch``: the first without it. ``kept_epoch``: the checkpoint of the map before;
            ``None`` where there is none. ``undo``: how to go back to it, or why one cannot.

        Raises:
            RefusedError: ``store``, where the map as it is cannot be kept: nothing is forgotten.
        """
        return self._run(admin.reset(bounds))

    def download_map(self, path: str | Path, training: bool = False) -> MapInfo:
        """Write the newest map to a file, checked against its digest, all of it or nothing.

        Args:
            path: the file; an older one is replaced.
            training: with the state from which training can go on.

        Raises:
            DownloadError: what arrived is not what the server announced.
            OSError: the file cannot be written.
        """
        return self._run(download.fetch(Path(path), training, self._connection.max_download_bytes))

    def download_box(self, path: str | Path, bounds: Bounds) -> MapFileInfo:
        """Write to a file what the newest map needs to answer within ``bounds``.

        Only the file's index and the parts that the box needs are sent. The file has no preview
        for MCAP viewers: ``triquad-pack`` adds one.

        Args:
            path: the file; an older one is replaced.
            bounds: corners of a box, metres, map frame.

        Raises:
            InvalidInputError: the bounds are not a box, or hold nothing.
            DownloadError: nothing of the map lies in the box, or what arrived is not valid.
            OSError: the file cannot be written.
        """
        return self._run(
            download.fetch_box(Path(path), bounds, self._connection.max_download_bytes)
        )

    def sync(self, bounds: Bounds, path: str | Path, accept_emptier: bool = False) -> SyncedMap:
        """Keep a copy of what the map needs to answer within ``bounds``, and ask that.

        What is in the file already is taken up: only the parts that changed are sent. The copy
        goes on answering when the link drops, and when this client is closed.

        Args:
            bounds: corners of a box, metres, map frame. Surfaces are known as far as it reaches:
                make it larger than where you ask by the largest distance that you ask for.
            path: the file; one that is no valid map file is replaced. :func:`open_map` opens it
                without a server.
            accept_emptier: replace a copy that is in the file already also by a map that knows less
                than half as much of the box.

        Raises:
            InvalidInputError: the bounds are not a box, or hold nothing.
            EmptierMapError: the file has a copy that knows far more, and stays as it is.
            DownloadError: what arrived is not valid.
            OSError: the file cannot be read or written.
        """
        synced = SyncedMap(Path(path), bounds, self._run, self._connection.max_download_bytes)
        synced.refresh(accept_emptier)
        return synced

    def maps(self) -> list[str]:
        """Names of all maps that can be reached, also those of other servers."""
        return self._driver.maps()
