"""The maps of a server: each has a folder, threads and a share of the memory of its own."""

import gc
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

import zenoh
from triquad_format.errors import RefusedError, SettingsError
from triquad_format.mapfile.files import replacing
from triquad_format.wire import keys
from triquad_format.wire.map_messages import (
    CreateMapReply,
    CreateMapRequest,
    DropMapReply,
    DropMapRequest,
)

from triquad_server.errors import StoreError
from triquad_server.launch_options import LaunchOptions
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.memory_share import ServerMemory
from triquad_server.process.stop import Stop
from triquad_server.process.threads import Teams
from triquad_server.server_status import Health
from triquad_server.service import Service
from triquad_server.serving.operations import Lane
from triquad_server.sharing.leases import Leases, now_ms
from triquad_server.sharing.sharing import Sharing
from triquad_server.sharing.stores import Stores
from triquad_server.store.dropped import set_aside
from triquad_server.store.found_map import FoundMap, find_map

_log = logging.getLogger("triquad_server")

_CREATED_BY = "created_by"  # the file in a created map's folder that names its server's first map
_NO_LOG = (
    "no scans are kept: after a division of the network, those of one side are lost; set "
    "store.log_max_bytes"
)
_NO_PERIOD = (
    "store.period_s = 0: other servers see what this one has learnt only once it is asked for a "
    "checkpoint"
)
_OTHERS_S = 1.0  # to hear of maps of other servers


class Maps:
    """Serves the maps of a server, and opens and drops some while it runs."""

    def __init__(
        self,
        session: zenoh.Session,
        options: LaunchOptions,
        teams: Teams,
        memory: ServerMemory,
        failed: Callable[[Stop], None],
    ) -> None:
        """Begin without maps.

        Args:
            session: that clients reach.
            options: what the server was started with.
            teams: that share the work of all maps.
            memory: that maps share.
            failed: called with the reason if an error ends mapping.
        """
        self._session = session
        self._options = options
        self._teams = teams
        self._memory = memory
        self._failed = failed
        self._changing = threading.Lock()  # while a map is opened or dropped
        self._open: dict[str, ExitStack] = {}  # what closes a map, by its name
        self._services: dict[str, Service] = {}  # replaced where it changes: others read it

    @property
    def services(self) -> Sequence[Service]:
        """The maps in the order in which they were opened."""
        return tuple(self._services.values())

    @property
    def healths(self) -> Sequence[Health]:
        """What tells how each map is doing."""
        return [service.health for service in self.services]

    def summary(self) -> str:
        """Return a line on what the server does, and what keeps it from that."""
        return "; ".join(health.summary() for health in self.healths)

    def stuck(self, longest_s: float) -> str | None:
        """Return what is at the same work for longer than ``longest_s``."""
        found = (health.stuck(longest_s) for health in self.healths)
        return next(filter(None, found), None)

    def begin(self, found: Sequence[FoundMap]) -> None:
        """Serve the maps that a server begins with, before any other is created."""
        with self._changing:
            for one in found:
                self._serve(one)

    def _serve(self, found: FoundMap) -> None:
        """Serve a map from now on."""
        mapper = Mapper(
            found.name,
            found.settings,
            self._options.device,
            found.record,
            self._teams,
            cold=found.cold if found.shared is None else {},
            memory=found.memory,
        )
        if found.store is not None:
            found.store.log_scans(found.settings.field.leaf_m)
        shared = self._shared(found, mapper)
        scans_of = None if found.shared is None else found.shared.map_name
        service = Service(
            self._session, mapper, found.settings, found.store, self._failed, scans_of
        )
        found.opened.enter_context(closing(service))
        if shared is not None:
            sharing = Sharing(*shared, service.mapper, service.health.checkpoints)
            found.opened.enter_context(closing(sharing))
            service.health.warned_by.append(sharing.warnings)
        if shared is None:
            service.operations.serve(CreateMapRequest, self._create, Lane.FILES)
            service.operations.serve(
                DropMapRequest, lambda request: self._drop(request, asked=found.name), Lane.FILES
            )
        self._open[found.name] = found.opened
        self._services = {**self._services, found.name: service}

    def _shared(self, found: FoundMap, mapper: Mapper) -> tuple[Leases, Stores] | None:
        """Return what is needed to share a map, if it is; it is left to others once closed."""
        shared, store = found.shared, found.store
        if shared is None or store is None:
            return None
        leases = Leases(self._session, shared.map_name, shared.number)
        found.opened.enter_context(closing(leases))
        stores = Stores(store, mapper.field, lambda: found.memory.cache_bytes, self._teams.answer)
        found.memory.add("regions of other servers", lambda: stores.cache_bytes, stores.clear)
        stores.refresh()
        stores.check()
        leases.wait_for_others(_OTHERS_S)
        if leases.is_taken:
            raise StoreError(
                f"another server is number {shared.number} of map '{shared.map_name}', but has not "
                f"locked {store.folder}: do all have the same --store?"
            )
        mapper.share(leases.may_have, now_ms)
        mapper.regions.all.others_have(stores.newest(leases))
        _log.info("map '%s' is shared: this is its server %d", shared.map_name, shared.number)
        if not found.settings.store.log_max_bytes:
            _log.warning(_NO_LOG)
        if not found.settings.store.period_s:
            _log.warning(_NO_PERIOD)
        return leases, stores

    def close(self) -> None:
        """Close all maps, each with a last checkpoint; what is opened or dropped is waited for.

        Raises:
            StoreError: a last checkpoint cannot be written; all else is closed.
        """
        with self._changing, ExitStack() as stack:
            for service in self.services:
                service.operations.stop()
            for closing_map in self._open.values():
                stack.push(closing_map)
            self._open = {}

    def _create(self, request: CreateMapRequest) -> CreateMapReply:
        """Open another map, which is opened again where the server is started again.

        Raises:
            RefusedError: there is one, or it cannot be opened.
        """
        name = request.name
        with self._while_changing():
            if name in self._services or self._is_elsewhere(name):
                raise RefusedError("map_exists", f"there is a map named {name!r} already")
            try:
                self._memory.check(len(self._services) + 1)
            except SettingsError as error:
                raise RefusedError("busy", str(error)) from error
            try:
                self._open_another(name)
            except (StoreError, SettingsError, OSError) as error:
                raise RefusedError("store", str(error)) from error
        _log.info("map '%s' is created", name)
        return CreateMapReply(tuple(self._services))

    def _drop(self, request: DropMapRequest, asked: str) -> DropMapReply:
        """Close a map, and set its folder aside; ``asked`` is the map that was asked for it.

        Raises:
            RefusedError: it is not here, or that very one, or cannot be written a last time.
        """
        name, root = request.name, self._options.store
        if name == asked:
            text = "the map of this client is not dropped: ask as a client of another of its maps"
            raise RefusedError("bad_request", text)
        with self._while_changing():
            if name not in self._services:
                there = ", ".join(self._services)
                raise RefusedError("no_map", f"this server has no map {name!r}, but {there}")
            try:
                if root is not None:
                    self._services[name].health.checkpoints.write()
                self._close(name)
                kept = None if root is None else set_aside(root / name)
            except (StoreError, OSError) as error:
                still = "goes on" if name in self._services else "is closed, and stays in the store"
                raise RefusedError("store", f"map {name!r} {still}: {error}") from error
        _log.warning("map '%s' is dropped; what it was is kept in %s", name, kept or "no folder")
        return DropMapReply(tuple(self._services), None if kept is None else str(kept))

    def _open_another(self, name: str) -> None:
        """Serve a map from its folder, which is marked to be opened again.

        Raises:
            StoreError: the folder cannot be used.
            SettingsError: the server's settings do not fit the map in it.
            OSError: it cannot be marked.
        """
        root, settings = self._options.store, self._options.settings
        found = find_map(name, settings, root, memory=self._memory, split=self._teams.answer)
        with ExitStack() as undo:
            undo.callback(found.opened.close)
            if root is not None:
                self._mark(root / name)
                undo.callback((root / name / _CREATED_BY).unlink)
            self._serve(found)
            undo.pop_all()

    def _mark(self, folder: Path) -> None:
        """Have the map in a folder opened again where the server is started again."""
        with replacing(folder / _CREATED_BY) as stream:
            stream.write(f"{self._options.map_names[0]}\n".encode())

    def _close(self, name: str) -> None:
        """Close a map, with a last checkpoint, and free its memory."""
        stack = self._open.pop(name)
        self._services = {key: one for key, one in self._services.items() if key != name}
        try:
            stack.close()
        finally:
            _collect()

    def _is_elsewhere(self, name: str) -> bool:
        """Return whether another server in reach has a map of this name."""
        key = keys.alive_key(name, "*")
        return any(
            one.ok is not None for one in self._session.liveliness().get(key, timeout=_OTHERS_S)
        )

    @contextmanager
    def _while_changing(self) -> Iterator[None]:
        """Open or drop a map; nobody waits, since who does may be what is to be closed.

        Raises:
            RefusedError: another one is being opened or dropped.
        """
        if not self._changing.acquire(blocking=False):
            raise RefusedError("busy", "another map is being opened or dropped: try again")
        try:
            yield
        finally:
            self._changing.release()


def created_maps(root: Path, first: str) -> list[str]:
    """Return the maps of a store that were created by the server whose first map is this one."""
    found = []
    for file in sorted(root.glob(f"*/{_CREATED_BY}")):
        with suppress(OSError):  # as of a folder that this user may not read
            if file.read_bytes().strip() == first.encode() and keys.is_name(file.parent.name):
                found.append(file.parent.name)
    return found


def _collect() -> None:
    """Free what a closed map has left in cycles, also where the start has frozen it."""
    was_frozen = gc.get_freeze_count() > 0
    gc.unfreeze()
    gc.collect()
    if was_frozen:
        gc.freeze()
