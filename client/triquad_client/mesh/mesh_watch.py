"""Following the mesh of a box, in the thread that asks."""

from collections.abc import Iterator
from contextlib import suppress

import zenoh
from triquad_format.errors import TriquadError

from triquad_client.mesh.followed_mesh import FollowedMesh, MeshUpdate
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.watched_mesh import WatchClosedError, WatchedMesh
from triquad_client.net.call import Call, ResultT
from triquad_client.net.connection import Connection
from triquad_client.net.remote_driver import RemoteDriver


class MeshWatch(WatchedMesh):
    """The mesh tiles of a box, kept up to date by :meth:`next`; nothing is asked in between.

    Use it in a ``with`` statement, or :meth:`close` it. Where a method raises, the tiles stay,
    and it may be called again: after the server was restarted, all tiles are fetched anew, and the
    old ones stay until then. Several threads may use it: each change is told to one of them.
    """

    def __init__(self, connection: Connection, followed: FollowedMesh) -> None:
        """Use :meth:`Client.watch_mesh`."""
        super().__init__(followed)
        self._closed = False
        self._cancellation = zenoh.CancellationToken()
        self._driver = RemoteDriver(connection, self._cancellation)

    def __enter__(self) -> "MeshWatch":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[MeshUpdate]:
        """Updates as they come, until the watch is closed."""
        return iter(self.next, None)

    def next(self, timeout_s: float | None = None) -> MeshUpdate | None:
        """Wait for the next change.

        Args:
            timeout_s: how long; ``None``: for ever.

        Returns:
            What changed; ``None`` where nothing did in that time, or the watch was closed.

        Raises:
            RefusedError: the server refused.
            RequestTimeoutError: it does not answer.
        """
        with suppress(WatchClosedError):
            return self._run(self._next(timeout_s))
        return None

    def catch_up(self, timeout_s: float = 60.0) -> None:
        """Fetch all that changed until now.

        Raises:
            RequestTimeoutError: that was not all of it.
            ClosedError: the watch was closed.
        """
        self._run(self._catch_up(timeout_s))

    def mesh(self) -> Mesh:
        """The tiles as one mesh, faces by their centroids within the bounds."""
        return self._followed.mesh()

    def close(self) -> None:
        """End: :meth:`next` returns ``None``, and iteration ends, also in other threads."""
        self._closed = True
        self._cancellation.cancel()

    def _run(self, call: Call[ResultT]) -> ResultT:
        try:
            return self._driver.run(call)
        except TriquadError as error:
            if self._closed:
                raise WatchClosedError from error
            raise
