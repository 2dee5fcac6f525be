"""The parts of a checkpoint: those that changed, and those that older files hold."""

from collections.abc import Callable, Iterable, Iterator

from triquad_format.errors import MapFileError
from triquad_format.mapfile.index import OtherFiles
from triquad_format.mapfile.manifest import Entry
from triquad_format.mapfile.parts.pack import pack_region
from triquad_format.mapfile.parts.part import MAP, Part

from triquad_server.mapping.mapper import MapChanges
from triquad_server.mesh.preview import preview_part
from triquad_server.store.known_parts import KnownParts

_FEATURE_DTYPE = "<f2"


class StoppedError(Exception):
    """Something is more urgent: what is left of the parts is not asked for."""


def checkpoint_parts(
    changes: MapChanges, known: KnownParts | None, others: OtherFiles | None, stamp_ns: int
) -> Iterator[Part | Entry]:
    """The parts of a checkpoint; those that did not change are copied from ``others``, if given."""
    changed = {region.index: region for region in changes.record.regions}
    settings = changes.record.settings
    for index in changes.regions:
        region = changed.get(index)
        if region is not None:
            yield from pack_region(region, settings, _FEATURE_DTYPE)
            yield preview_part(region, settings, changes.epoch.distances, stamp_ns)
        elif known is not None:
            entries = known.of_region(index)
            yield from entries if others is None else copied_parts(entries, others)


def copied_parts(entries: Iterable[Entry], others: OtherFiles) -> Iterator[Part]:
    """Parts that other files hold, read and checked; the map's own part is made anew.

    Raises:
        MapFileError: one of the files cannot be read, or is damaged.
    """
    for entry in entries:
        if entry.key.topic == MAP:
            continue
        try:
            payload = others.payload(entry)
        except OSError as error:  # of reading: the file that is written is another
            raise MapFileError(f"a file that holds parts cannot be read: {error}") from error
        yield Part(entry.key, payload)


def unless(stopping: Callable[[], bool], parts: Iterator[Part]) -> Iterator[Part]:
    """The parts, until ``stopping()``.

    Raises:
        StoppedError: it says so.
    """
    for part in parts:
        if stopping():
            raise StoppedError
        yield part
