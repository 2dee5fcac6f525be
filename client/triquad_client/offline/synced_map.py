"""A map that answers from a copy of the server's, also while the link is down."""

from pathlib import Path

from triquad_client.calls.queries import MapQueries
from triquad_client.checks import Bounds
from triquad_client.net.call import Run
from triquad_client.offline.local_copy import LocalCopy, SyncReport


class SyncedMap(LocalCopy, MapQueries):
    """The part of a map that a box needs, copied to this machine; several threads may ask it.

    Queries are answered from the copy: what it does not have is unknown. Each is answered from one
    epoch, and ``at_epoch`` may be none but :attr:`epoch`.
    """

    def __init__(self, path: Path, bounds: Bounds, run: Run) -> None:
        """Use ``Client.sync``."""
        LocalCopy.__init__(self, path, bounds)
        MapQueries.__init__(self, self._answer)
        self._ask_server = run

    def refresh(self) -> SyncReport:
        """Fetch what changed on the server. Where that fails, the copy stays as it was.

        Raises:
            TriquadError: the server cannot be reached, as for any call of :class:`Client`.
            DownloadError: what arrived is not valid.
            OSError: the file cannot be written.
        """
        return self._ask_server(self._update())
