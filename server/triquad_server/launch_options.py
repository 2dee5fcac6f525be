"""The options that a server is started with; quick to import."""

from dataclasses import dataclass
from pathlib import Path

from triquad_format.wire.keys import check_name

from triquad_server.errors import ServerError
from triquad_server.network import NetworkOptions
from triquad_server.settings import Settings


@dataclass(frozen=True)
class LaunchOptions:
    """The options that a server is started with."""

    map_names: tuple[str, ...]  # at least one; those that its clients create come to these
    network: NetworkOptions
    settings: Settings
    store: Path | None
    device: str  # "cpu" or "cuda"
    restore: int | None = None  # the epoch that the only map is restored to; None: the newest
    share: bool = False  # other servers have regions of the only map, too

    def __post_init__(self) -> None:
        """Refuse bad names, and to restore without a store, or which of several maps is not clear.

        Raises:
            FormatError: a map cannot have this name.
            ServerError: there is no store; or a map is named twice.
        """
        for name in self.map_names:
            check_name("map", name)
            if self.map_names.count(name) > 1:
                raise ServerError(f"--map {name} is given twice")
        if self.restore is not None and self.store is None:
            raise ServerError("--restore needs the --store that the map is taken from")
        if self.share and (self.store is None or len(self.map_names) > 1 or self.restore):
            raise ServerError(
                "--share is for one map, with the --store that all its servers share, and without "
                "--restore"
            )
        if self.restore is not None and len(self.map_names) > 1:
            raise ServerError(
                "--restore is for one map: start the server with that --map alone, stop it, and "
                "start it with all of them"
            )
