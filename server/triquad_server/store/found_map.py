"""A map as its server finds it: what its folder holds, and the settings that it has."""

import logging
import time
from collections.abc import Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from triquad_format.errors import SettingsError
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import MapRecord
from triquad_format.wire.shares import MAX_SHARES, number_of_share, share_name
from triquad_map.compiled.team import Split

from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.errors import StoreError, StoreInUseError
from triquad_server.process.memory_share import MemoryShare, ServerMemory
from triquad_server.settings import Settings
from triquad_server.store.lock import StoreLock
from triquad_server.store.restore import ValidCheckpoint, newest_valid
from triquad_server.store.store import Store

_log = logging.getLogger("triquad_server")

_CANNOT_BE_SHARED = (
    "cannot be shared: its newest checkpoint is a map file, which a server without --share turns "
    "into one of its own, or it counts from an origin other than 0 0 0, as coordinates of UTM make"
)
_RENAMED_S = 0.5  # for another server that is at it
_IS_SHARED = "shared"  # the file in the folder of a server of a shared map


@dataclass(frozen=True)
class SharedName:
    """A map that several servers share, and which of them this is."""

    map_name: str
    number: int


@dataclass(frozen=True)
class FoundMap:
    """A map before it is served."""

    name: str
    settings: Settings  # with the field that it was begun with
    memory: MemoryShare
    opened: ExitStack  # closes the store, and leaves the share to the other maps
    store: Store | None = None
    record: MapRecord | None = None  # without what stays in the store; None: it begins
    shared: SharedName | None = None  # None: this server alone has the map

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
        _check_alone(root, name)
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


def find_share(
    name: str, settings: Settings, root: Path, *, memory: ServerMemory, split: Split
) -> FoundMap:
    """Be one of the servers of a shared map: that of the lowest number that no other is.

    The first one goes on with a map that was not shared so far. Arguments and errors are those of
    :func:`find_map`.
    """
    _share_folder(root / name, root / share_name(name, 1))
    for number in range(1, MAX_SHARES + 1):
        with suppress(StoreInUseError):
            own = share_name(name, number)
            if (root / own).exists() and not is_share_folder(root / own):
                continue  # another map has this name
            found = find_map(own, settings, root, memory=memory, split=split)
            (root / own / _IS_SHARED).touch()
            return replace(found, shared=SharedName(name, number))
    raise StoreError(f"{MAX_SHARES} servers share map {name!r} already: more are not possible")


def _check_alone(root: Path, name: str) -> None:
    """Raise :class:`StoreError` where a map of this name is in the folders of several servers."""
    shared = [
        str(folder)
        for folder in root.glob(f"{name}.*")
        if number_of_share(name, folder.name) is not None and is_share_folder(folder)
    ]
    if shared:
        raise StoreError(
            f"map {name!r} is shared, in {', '.join(sorted(shared))}: start with --share, or have "
            "one server take it over (docs/scale.md)"
        )


def is_share_folder(folder: Path) -> bool:
    """Return whether a folder is that of one of the servers of a shared map."""
    return (folder / _IS_SHARED).exists()


def _share_folder(alone: Path, first: Path) -> None:
    """Have the folder of a map that was not shared so far be that of the first server.

    Raises:
        StoreError: a server has it, or what is in it cannot be shared.
    """
    if first.exists() or not alone.is_dir():
        return
    try:
        with closing(StoreLock(alone)):
            newest = newest_valid(alone)
            if newest is not None and (newest.record.regions or any(newest.record.origin)):
                raise StoreError(f"{alone} {_CANNOT_BE_SHARED}")
            (alone / _IS_SHARED).touch()
            alone.rename(first)
    except (StoreInUseError, FileNotFoundError) as error:
        time.sleep(_RENAMED_S)
        if first.exists():
            return  # another server was faster
        raise StoreError(str(error)) from error
    _log.warning("map '%s' is shared from now on: its folder is %s", alone.name, first)


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
