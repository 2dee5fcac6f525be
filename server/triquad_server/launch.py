"""Starts and stops a server, as a process or within a program."""

import gc
import logging
import math
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import TYPE_CHECKING

import zenoh
from triquad_format.errors import SettingsError
from triquad_format.records.region import MapRecord
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import ErrorReply

from triquad_server.launch_options import LaunchOptions
from triquad_server.mapping.mapper import Mapper
from triquad_server.network import Configuration, configuration, open_session
from triquad_server.process.installed import check_device
from triquad_server.process.memory_parts import MemoryParts
from triquad_server.process.resources import allow_open_files, give_back_early, resident_bytes
from triquad_server.process.service_manager import ServiceManager
from triquad_server.process.stop import Stop, Stops, wait_for_stop
from triquad_server.process.threads import Teams
from triquad_server.service import Service
from triquad_server.settings import Settings
from triquad_server.store.restore import ValidCheckpoint
from triquad_server.store.store import Store
from triquad_server.warm_up import Report, warm_up

if TYPE_CHECKING:
    from triquad_server.monitoring.http_server import MonitoringServer

_log = logging.getLogger("triquad_server")

_SWITCH_INTERVAL_S = 0.0005
"""The time for which a thread may keep the interpreter while another waits: a query is to be
answered in a few milliseconds, which is Python's default for a single turn."""


_LATER_BYTES = 50_000_000  # of the program, for what it loads and buffers once it serves

_LEAST_ROOM_BYTES = 150_000_000  # for a map: 100 m of a street


class StoppedEarlyError(Exception):
    """The server was asked to stop before it had started."""


def run_server(options: LaunchOptions, stops: Stops) -> Stop:
    """Serve until something is put into ``stops``, and return it: this process does nothing else.

    Raises:
        ServerError: the server cannot start; its subclasses name the cause.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    give_back_early()
    allow_open_files()
    _stop_where_a_thread_ends(stops)
    if options.store is None:
        _log.warning("no --store: the map is not kept when the server stops")
    manager = ServiceManager()
    try:
        with opened(options, stops, manager.starting, owns_process=True) as service:
            # A quarter of a million objects, most of them numba's, stay: a collection that goes
            # through them stops all threads for a tenth of a second.
            gc.collect()
            gc.freeze()
            health = service.health
            manager.notify("READY=1", status=health.summary())
            why = wait_for_stop(stops, lambda: manager.serving(health.summary, health.stuck))
            manager.stopping()
    except StoppedEarlyError:
        why = stops.get()
        manager.stopping()
    return why


def _stop_where_a_thread_ends(stops: Stops) -> None:
    """Ask to stop if an exception ends a thread: without any of them, the server works in part."""
    tell = threading.excepthook

    def tell_and_stop(args: threading.ExceptHookArgs) -> None:
        tell(args)
        stops.put(Stop.INTERNAL_ERROR)

    threading.excepthook = tell_and_stop


@contextmanager
def opened(
    options: LaunchOptions,
    stops: Stops,
    starting: Report = lambda _: None,
    *,
    owns_process: bool = False,
) -> Iterator[Service]:
    """Yield a server; after the context, it has written a last checkpoint and is closed.

    Signals, and what else belongs to the process as a whole, are left as they are.

    Args:
        options: what the server is started with.
        stops: where it may be asked to stop before it has started.
        starting: is told the stages of the start.
        owns_process: the process does nothing else: its memory is the server's.

    Raises:
        ServerError: the server cannot start; its subclasses name the cause.
        StoppedEarlyError: it was asked to stop before it had started.
    """
    try:
        with ExitStack() as stack:
            yield _open(options, stops, starting, stack, owns_process=owns_process)
    except StoppedEarlyError:
        _log.info("stopped")
        raise
    _log.info("stopped")


def _open(
    options: LaunchOptions, stops: Stops, starting: Report, stack: ExitStack, *, owns_process: bool
) -> Service:
    """Open all parts of a server, to be closed by ``stack``."""
    check_device(options.device)
    settings = options.settings
    network = configuration(options.network, options.map_name, settings)
    monitoring = _open_monitoring(settings, stack)
    session = stack.enter_context(closing(open_session(network)))
    with closing(StartingNotice(session, options.map_name)) as notice:

        def begins(stage: str) -> None:
            notice.stage = stage
            starting(stage)

        teams = stack.enter_context(closing(Teams()))
        store = _open_store(options, begins, stack, teams)
        before = resident_bytes()
        restored, settings = _restored(store, options, begins)
        restored_bytes = resident_bytes() - before  # of the map, where it is read whole
        warm_up(settings, options.device, teams, _before_each_step(stops, begins))
        begins("opening the map")
        program = resident_bytes() - restored_bytes if owns_process else 0
        parts = _memory_parts(settings, program)
        record = None if restored is None else restored.record
        del restored
        cold = {} if store is None else store.regions.known
        mapper = Mapper(
            options.map_name, settings, options.device, record, teams, cold=cold, beside=parts.total
        )
        if store is not None:
            store.log_scans(settings.field.leaf_m)
        service = Service(session, mapper, settings, store, parts, failed=stops.put)
        stack.enter_context(closing(service))
    if monitoring is not None:
        stack.enter_context(monitoring.showing(service.health))
    _log_who_gets_in(network)
    _log_ready(options, network, service.epoch)
    return service


def _restored(
    store: Store | None, options: LaunchOptions, starting: Report
) -> tuple[ValidCheckpoint | None, Settings]:
    """Return the newest checkpoint, if there is one, and the settings that hold for its map."""
    if store is None:
        return None, options.settings
    starting("restoring the newest checkpoint")
    restored = store.newest()
    if restored is None:
        return None, options.settings
    _log.info("restoring epoch %d from %s", restored.record.epoch, restored.path)
    return restored, _settings_of(restored.record, options)


def _memory_parts(settings: Settings, program: int) -> MemoryParts:
    """Return what takes memory besides the map: of a process of its own, the ``program`` as well.

    Raises:
        SettingsError: it leaves no room for a map.
    """
    if not program:
        return MemoryParts()
    most, least = settings.memory.max_bytes, program + _LATER_BYTES + _LEAST_ROOM_BYTES
    if most < least:
        raise SettingsError(
            f"memory.max_bytes = {most}: the program alone takes {program / 1e6:.0f} MB; give the "
            f"server at least {math.ceil(least / 1e6)}_000_000"
        )
    return MemoryParts(program + _LATER_BYTES)


def _open_monitoring(settings: Settings, stack: ExitStack) -> "MonitoringServer | None":
    """Open the port for metrics, if one is configured, before all that takes time."""
    if settings.metrics.port == 0:
        return None
    # Only where it is wanted, since Python's HTTP server takes a while to import.
    from triquad_server.monitoring.http_server import MonitoringServer

    return stack.enter_context(closing(MonitoringServer(settings.metrics)))


def _open_store(
    options: LaunchOptions, starting: Report, stack: ExitStack, teams: Teams
) -> Store | None:
    """Open the store, if there is one, restored to an older checkpoint if one is asked for."""
    if options.store is None:
        return None
    settings, root = options.settings, options.store
    cache_bytes = settings.memory.cache_bytes
    store = Store(root, options.map_name, settings.store, cache_bytes, teams.answer)
    stack.enter_context(closing(store))
    if options.restore is not None:
        starting(f"taking the map back to epoch {options.restore}")
        store.restore(options.restore)
    return store


def _settings_of(record: MapRecord, options: LaunchOptions) -> Settings:
    """Return the settings for a restored map, which keeps its own field.

    Raises:
        SettingsError: lengths that are given do not agree with it.
    """
    settings = options.settings
    if record.name != options.map_name:
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


def _before_each_step(stops: Stops, starting: Report) -> Report:
    """Report a step of the warm-up, and end the start if the server is asked to stop."""

    def begin(step: str) -> None:
        if not stops.empty():
            raise StoppedEarlyError
        starting(f"preparing compiled code: {step}")

    return begin


def _log_who_gets_in(network: Configuration) -> None:
    if not network.own_access_control:
        _log.info("access: as the Zenoh configuration says")
    elif network.listens_beyond or network.connect:
        _log.info(
            "access: without credentials, whoever reaches this server from beyond this machine may "
            "question and follow the map and publish scans; only programs of this machine may "
            "reset it or write checkpoints; triquad-keys gives others that right, and encrypts "
            "(docs/security.md)"
        )
    else:
        _log.info("access: programs of this machine; --listen tcp/0.0.0.0:7447 lets others connect")


def _log_ready(options: LaunchOptions, network: Configuration, epoch: int) -> None:
    endpoints = ", ".join(network.listen) or f"a {network.mode} of {', '.join(network.connect)}"
    _log.info(
        "ready: map '%s' on %s, epoch %d, %s, store %s",
        options.map_name,
        endpoints,
        epoch,
        options.device,
        options.store or "none",
    )


class StartingNotice:
    """Tells clients, until it is closed, that the server of a map is there but not ready."""

    def __init__(self, session: zenoh.Session, map_name: str) -> None:
        """Begin to refuse questions."""
        self.stage = "it has just begun"
        # Zenoh's own thread answers: the others may be compiling.
        self._queryable = session.declare_queryable(
            keys.all_queries_key(map_name), zenoh.handlers.Callback(self._refuse, indirect=False)
        )

    def close(self) -> None:
        """Refuse no more."""
        self._queryable.undeclare()

    def _refuse(self, query: zenoh.Query) -> None:
        reply = codec.encode(ErrorReply("starting", self.stage))
        with query:
            query.reply_err(reply, encoding=keys.encoding(ErrorReply))
