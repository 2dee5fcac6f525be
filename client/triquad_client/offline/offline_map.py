"""A map file that answers as a server does, without one."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from triquad_format.errors import RefusedError
from triquad_format.mapfile.checkpoint_folder import checkpoint_files, map_folder
from triquad_format.mapfile.reader import MapFile, read_map_file
from triquad_format.records.region import MapRecord
from triquad_map.questions.answers import Answers, QuestionLimits
from triquad_map.record_view import open_view
from triquad_map.view import MapView

from triquad_client.calls.queries import MapQueries
from triquad_client.errors import ClosedError
from triquad_client.net.call import Batch, BlockingDriver, Call, ResultT

_NO_LIMITS = QuestionLimits(points=2**62, searches=2**62)
"""Nobody else waits."""


class LocalDriver(BlockingDriver):
    """Runs calls over the map in a record, as fast as possible here; for several threads."""

    def __init__(self, record: MapRecord) -> None:
        self._open = open_view(record)
        self._view = self._open.view
        self._answers = Answers(self._epoch, _NO_LIMITS)

    @property
    def compiled(self) -> bool:
        """Whether compiled code answers, as in a server; else numpy, which is far slower."""
        return self._open.compiled

    def close(self) -> None:
        """End the threads that compiled code works on; nothing may be asked any more."""
        self._open.close()

    async def _replies(self, batch: Batch) -> list[Any]:
        return [self._answers.answer(batch.request(item).message) for item in batch.items]

    @contextmanager
    def _epoch(self, number: int) -> Iterator[MapView]:
        """The view, where its epoch is asked for, or the newest."""
        if number not in (0, self._view.epoch):
            raise RefusedError(
                "epoch_gone", f"epoch {number} is not kept; kept is [{self._view.epoch}]"
            )
        yield self._view


class OfflineMap(MapQueries):
    """A map in memory; several threads may ask it.

    Its queries are those of :class:`Client`, with the same results and errors; the epoch is always
    the same.
    """

    def __init__(self, file: MapFile) -> None:
        """Use :func:`open_map`."""
        super().__init__(self._answer)
        driver = LocalDriver(file.record)
        self._driver: LocalDriver | None = driver
        self.name = file.record.name
        self.epoch = file.record.epoch
        self.stamp_ns = file.manifest.stamp_ns
        """When its epoch was written, nanoseconds since 1970; 0: the file does not tell."""
        self.compiled = driver.compiled
        """Whether compiled code answers, as in the server; else numpy, which is far slower."""

    def __enter__(self) -> "OfflineMap":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the map; later queries raise :class:`ClosedError`."""
        driver, self._driver = self._driver, None
        if driver is not None:
            driver.close()

    def _answer(self, call: Call[ResultT]) -> ResultT:
        driver = self._driver
        if driver is None:
            raise ClosedError("the map is closed")
        return driver.run(call)


def open_map(path: str | Path) -> OfflineMap:
    """The map in a file, read whole and checked.

    With numba installed (``pip install 'triquad[fast]'``) it answers as fast as a server. The
    surfels, on which distances hang, are made at the first question that needs them: half a second
    for 100 m of street.

    Args:
        path: a map file, beside which the other files lie that hold parts of it; or a server's
            store, of which the newest checkpoint is taken.

    Raises:
        MapFileError: it is no map file, is damaged, or needs a newer reader.
        OSError: it cannot be read.
    """
    chosen = Path(path)
    if chosen.is_dir():
        chosen = checkpoint_files(map_folder(chosen))[0].path
    return OfflineMap(read_map_file(chosen))
