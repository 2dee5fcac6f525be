"""Map files that are open: each once, and those that were used last for a while."""

import threading
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from triquad_client import open_map

from triquad_tools.viewer.sources.file_source import FileSource
from triquad_tools.viewer.sources.tile_maker import TileMaker

_KEPT = 4


@dataclass
class _OpenMap:
    """A map and how many use it."""

    source: FileSource
    users: int = 0


class OpenMaps:
    """Opens map files, and closes them some time after their last user; for several threads."""

    def __init__(self, kept: int = _KEPT) -> None:
        """``kept`` maps stay open at most, unless more are in use."""
        self._kept = kept
        self._maker = TileMaker()
        self._maps: OrderedDict[Path, _OpenMap] = OrderedDict()
        self._opening = threading.Lock()  # one at a time: it takes all cores
        self._changing = threading.Lock()

    def use(self, path: Path) -> FileSource:
        """The map in a file, until :meth:`release`.

        Raises:
            MapFileError: it is no map file, is damaged, or needs a newer reader.
            OSError: it cannot be read.
        """
        with self._opening:
            with self._changing:
                known = self._maps.get(path)
            if known is None:
                known = _OpenMap(FileSource(open_map(path), path, self._maker))
            with self._changing:
                known.users += 1
                self._maps[path] = known
                self._maps.move_to_end(path)
                self._forget()
            return known.source

    def release(self, path: Path) -> None:
        """It is used no longer; to be called as often as :meth:`use`."""
        with self._changing, suppress(KeyError):  # all may be closed already
            self._maps[path].users -= 1
            self._forget()

    def close(self) -> None:
        """Close all maps; nobody uses them any more."""
        self._maker.close()
        with self._changing:
            for known in self._maps.values():
                known.source.opened.close()
            self._maps.clear()

    def _forget(self) -> None:
        unused = [path for path, known in self._maps.items() if not known.users]
        for path in unused[: max(0, len(self._maps) - self._kept)]:
            self._maps.pop(path).source.opened.close()
