"""The map of a store as it was at a moment that one page chooses."""

from collections.abc import Mapping
from contextlib import suppress
from typing import NamedTuple

from triquad_client.calls.queries import MapQueries
from triquad_client.checks import Bounds
from triquad_client.mesh.followed_mesh import TileIndex

from triquad_tools.console.command import ToolError
from triquad_tools.viewer.sources.file_source import FileSource
from triquad_tools.viewer.sources.history import DamagedError, History, Moment
from triquad_tools.viewer.sources.map_source import MapState
from triquad_tools.viewer.sources.tile_cache import MadeTile

_COARSE_S = 5.0  # after so long, a map is shown with what there is of its mesh


class _Shown(NamedTuple):
    """What is shown: exchanged as a whole, since several threads ask."""

    moment: Moment
    source: FileSource


class HistorySource:
    """A map that changes whenever another moment is chosen; closed by who opened it."""

    grows = False

    def __init__(self, history: History, moment: Moment) -> None:
        """Open the map; use :func:`newest_of`.

        Raises:
            DamagedError: it cannot be shown.
        """
        self.history = history
        source = history.use(moment)
        source.prepare(_COARSE_S)
        self._shown = _Shown(moment, source)
        self.sizes = source.sizes
        self.title = f"{source.opened.name} in {history.folder}"

    @property
    def moment(self) -> Moment:
        """Which is shown."""
        return self._shown.moment

    @property
    def queries(self) -> MapQueries:
        """Answers for the moment that is shown."""
        return self._shown.source.queries

    def state(self) -> MapState:
        """What is shown."""
        return self._shown.source.state()

    def follow(self, level: int, bounds: Bounds | None = None) -> "HistoryFollower":
        """The mesh tiles of a level that meet ``bounds``, of whatever moment is shown."""
        return HistoryFollower(self, level, bounds)

    def move(self, moment: Moment) -> None:
        """Show another moment.

        Raises:
            DamagedError: it cannot be shown; the one before still is.
            ToolError: its mesh cannot be made, or is of other cells.
        """
        source = self.history.use(moment)
        try:
            if source.sizes != self.sizes:
                raise ToolError(f"{moment} was mapped with other leaves: open it by itself")
            source.prepare(_COARSE_S)
        except Exception:
            self.history.release(moment)
            raise
        before, self._shown = self._shown, _Shown(moment, source)
        self.history.release(before.moment)

    def close(self) -> None:
        """Show nothing any longer."""
        self.history.release(self.moment)


class HistoryFollower:
    """Mesh tiles of a level within a box; they change together when another moment is shown."""

    def __init__(self, source: HistorySource, level: int, bounds: Bounds | None) -> None:
        self._source = source
        self._level = level
        self._bounds = bounds
        self._moment = source.moment
        self._follower = self._opened(self._moment).follow(level, bounds)
        self._changing = False
        self.tiles: Mapping[TileIndex, MadeTile] = {}
        """The tiles as of the last refresh, by their indices; of one moment."""
        self.complete = False
        """Whether the last refresh left nothing waiting."""

    def refresh(self) -> None:
        """Take up what is made within a short time; until all is, the moment before is shown."""
        if self._source.moment != self._moment:
            self.close()
            self._moment = self._source.moment
            self._follower = self._opened(self._moment).follow(self._level, self._bounds)
            self._changing = True
        self._follower.refresh()
        self.complete = self._follower.complete
        self._changing &= not self.complete
        if not self._changing:
            self.tiles = self._follower.tiles

    def moved(self, bounds: Bounds) -> "HistoryFollower":
        """Follow another box instead."""
        self._bounds = bounds
        self._follower = self._follower.moved(bounds)
        if not self._changing:
            self.tiles = self._follower.tiles
        return self

    def close(self) -> None:
        """Follow no longer."""
        self._follower.close()
        self._source.history.release(self._moment)

    def _opened(self, moment: Moment) -> FileSource:
        return self._source.history.use(moment)


def newest_of(history: History) -> HistorySource:
    """The newest moment that can be shown.

    Raises:
        ToolError: there is none.
    """
    while moments := history.moments:
        with suppress(DamagedError):
            return HistorySource(history, moments[-1])
    raise ToolError(
        f"{history.folder}: no checkpoint can be shown; triquad-pack --recover saves what is intact"
    )
