"""The client: publishes scans to a map server, and asks it about the map."""

from __future__ import annotations

from pathlib import Path

from triquad_format.records.arrays import Doubles
from triquad_format.wire.codec import known_origin

from triquad_client.calls.changes import ChangeCalls
from triquad_client.calls.corrections import CorrectionCalls
from triquad_client.calls.download import DownloadCalls
from triquad_client.calls.point_queries import pin_newest
from triquad_client.calls.queries import MapQueries, PinnedMap
from triquad_client.calls.server import ServerCalls
from triquad_client.checks import Bounds
from triquad_client.errors import brief, brief_errors
from triquad_client.mesh.followed_mesh import FollowedMesh, KnownTiles
from triquad_client.mesh.mesh_calls import MeshCalls
from triquad_client.mesh.mesh_watch import MeshWatch
from triquad_client.net.connection import Connection
from triquad_client.net.opening import open_connection
from triquad_client.offline.synced_map import SyncedMap

MAX_DOWNLOAD_BYTES = 2**30
"""Some hundred times the map of a town; larger ones need a limit of the caller's."""


@brief_errors
class Client(CorrectionCalls, MapQueries, MeshCalls, ChangeCalls, DownloadCalls, ServerCalls):
    """A connection to one map of a server. Close it, or use it in a ``with`` statement.

    Positions are metres in the map frame, or from the map's origin where it was connected with
    ``coordinates="local"``. All methods may be called from several threads, and raise a
    :class:`TriquadError` where they fail: :class:`RefusedError` where the server refuses,
    :class:`RequestTimeoutError` where it does not answer in time, :class:`InvalidInputError`
    where an argument cannot be used.
    """

    def __init__(self, connection: Connection) -> None:
        """Use :func:`triquad_client.connect`."""
        super().__init__(connection)
        self._server = connection

    def __repr__(self) -> str:
        state = ", closed" if self._connection.is_closed else ""
        return f"Client(map {self.map_name!r} {self._connection.where}{state})"

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def map_name(self) -> str:
        """The map this client works with."""
        return self._connection.map_name

    @property
    def origin_m(self) -> Doubles:
        """[3] metres, map frame: from where the map counts; 0 0 0 unless its scans lie far away.

        The first scan of the map decides: ask once it is taken in. Raises as :meth:`status`.
        """
        return known_origin(self.status().origin_m)

    def close(self) -> None:
        """End the connection. Scans that were published may still be on their way: flush first."""
        self._connection.close()

    def pinned(self) -> PinnedMap:
        """Return the map as it is now, for queries that belong together."""
        return PinnedMap(self._connection, pin_newest(self._connection))

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
            max_bytes_per_s: what the tiles of this watch may take of the network.
            known: tiles of an earlier watch, which are not fetched again.

        Raises:
            InvalidInputError: an argument cannot be used, or ``known`` is of another level.
        """
        most = self._connection.max_download_bytes
        followed = FollowedMesh.initial(bounds, level, known, max_bytes=most)
        return MeshWatch(self._connection, followed, max_bytes_per_s)

    def sync(self, bounds: Bounds, path: str | Path, accept_emptier: bool = False) -> SyncedMap:
        """Keep a copy of what the map needs to answer within ``bounds``, and ask that.

        What is in the file already is used: only the parts that changed are sent. The copy
        goes on answering when the link drops, and when this client is closed.

        Args:
            bounds: corners of a box, metres, map frame. Surfaces are known as far as it reaches:
                make it larger than where you ask by the largest distance that you ask for.
            path: the file; an older map is replaced, also a damaged one, and nothing else.
                :func:`open_map` opens it without a server.
            accept_emptier: replace a copy that is in the file already also by a map that knows less
                than half as much of the box.

        Raises:
            InvalidInputError: the bounds are not a box, or contain nothing; or the file is there,
                and is not a triquad map.
            EmptierMapError: the file has a copy that knows far more, and stays as it is.
            DownloadError: what arrived is not valid.
            OSError: the file cannot be read or written.
        """
        synced = SyncedMap(path, bounds, self._connection)
        synced.refresh(accept_emptier)
        return synced


@brief
def connect(
    endpoint: str | None = None,
    map: str = "default",  # noqa: A002 - the word of the command line and of the documentation
    *,
    timeout_s: float | None = None,
    config: str | Path | None = None,
    max_download_bytes: int = MAX_DOWNLOAD_BYTES,
    coordinates: str = "map",
) -> Client:
    """Connect to a map server.

    Args:
        endpoint: of the server, or of a router that leads to it: a host such as ``robot`` or
            ``robot:7447``, or an endpoint of Zenoh; several, with commas between them, where one is
            enough: when it goes, the next is connected to. ``None``: where ``config`` says, and
            otherwise port 7447 of this machine.
        map: name of the map.
        timeout_s: for connecting and for each request, by default ten seconds: so long a server is
            waited for that is not there yet; a warning says so. By default, one that says what it
            does to start is waited for ten minutes.
        config: Zenoh configuration file (JSON5), such as one of triquad-keys with credentials.
        max_download_bytes: the largest map file that is fetched from the server, and the most that
            the mesh of a box may take of memory, whatever the server announces.
        coordinates: ``"map"``: all places are in the map frame, as the poses of its scans are;
            ``"local"``: they are relative to :attr:`Client.origin_m`.

    Raises:
        ConnectError: nothing listens at the endpoint, it does not let us in, or it still starts.
        UnknownMapError: no server there has this map.
        InvalidInputError: there cannot be an endpoint or a map of this name.
    """
    return Client(
        open_connection(
            endpoint,
            map,
            timeout_s,
            config,
            max_download_bytes=max_download_bytes,
            coordinates=coordinates,
        )
    )
