"""A map as its server finds it: what its folder holds, and the settings that it has."""

import logging
from collections.abc import Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import SettingsError
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import MapRecord
from triquad_map.compiled.team import Split

from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.process.memory_share import MemoryShare, ServerMemory
from triquad_server.settings import Settings
from triquad_server.store.restore import ValidCheckpoint
from triquad_server.store.store import Store

_log = logging.getLogger("triquad_server")


@dataclass(frozen=True)
class FoundMap:
    """A map before it is served."""

    name: str
    settings: Settings  # with the field that it was begun with
    memory: MemoryShare
    opened: ExitStack  # closes the store, and leaves the share to the other maps
    store: Store | None = None
    record: MapRecord | None = None  # without what stays in the store; None: it begins

    @property
    def cold(self) -> Mapping[RegionIndex, ColdRegion]:
        """The regions that stay in the store until they are needed."""
        return {} if self.store is None else self.store.regions.known


def find_map(
    name: str,
    settings: Settings,
    root: Path | None,
    *,
    memory: ServerMemory,
    split: Split,
    restore: int | None = None,
) -> FoundMap:
    """Open the store of a map, and read its newest checkpoint.

    Args:
        name: of the map.
        settings: of the server.
        root: folder with a folder for each map; ``None``: maps are not kept.
        memory: of the server, of which the map has a share from now on.
        split: shares the work of a question.
        restore: the epoch of an older checkpoint that the map goes back to.

    Raises:
        StoreError: the store cannot be used.
        SettingsError: lengths that are given do not agree with the map's field.
    """
    with ExitStack() as stack:
        share = memory.open()
        stack.callback(memory.close, share)
        if root is None:
            return FoundMap(name, settings, share, stack.pop_all())
        store = Store(root, name, settings.store, lambda: share.cache_bytes, split)
        stack.enter_context(closing(store))
        if restore is not None:
            store.restore(restore)
        newest = store.newest()
        if newest is None:
            return FoundMap(name, settings, share, stack.pop_all(), store)
        _log.info("restoring epoch %d from %s", newest.record.epoch, newest.path)
        own = _settings_of(name, newest, settings)
        return FoundMap(name, own, share, stack.pop_all(), store, newest.record)


def _settings_of(name: str, newest: ValidCheckpoint, settings: Settings) -> Settings:
    """Return the settings for a restored map, which keeps its own field.

    Raises:
        SettingsError: lengths that are given do not agree with it.
    """
    record = newest.record
    if record.name != name:
        _log.warning("the checkpoint is of a map named '%s'", record.name)
    if record.settings == settings.field:
        return settings
    _log.warning("the restored map keeps its own [field] settings: %s", record.settings)
    try:
        kept = settings.with_field(record.settings)
    except SettingsError as error:
        raise SettingsError(f"for the restored map: {error}") from error
    if record.settings.leaf_m != settings.field.leaf_m:
        _log.warning(
            "lengths that are not set follow its leaf_m = %g, not the %g that is set",
            record.settings.leaf_m,
            settings.field.leaf_m,
        )
    return kept
