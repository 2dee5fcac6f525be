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

    map_name: str
    network: NetworkOptions
    settings: Settings
    store: Path | None
    device: str  # "cpu" or "cuda"
    restore: int | None = None  # the epoch that the map is restored to; None: the newest

    def __post_init__(self) -> None:
        """Refuse a bad name, and to restore without a store.

        Raises:
            FormatError: the map cannot have this name.
            ServerError: there is no store.
        """
        check_name("map", self.map_name)
        if self.restore is not None and self.store is None:
            raise ServerError("--restore needs the --store that the map is taken from")
