"""Starts and stops a server, as a process or within a program."""

import gc
import logging
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from typing import TYPE_CHECKING

import zenoh
from triquad_format.errors import SettingsError
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import ErrorReply

from triquad_server.errors import StoreError
from triquad_server.launch_options import LaunchOptions
from triquad_server.maps import Maps, created_maps
from triquad_server.network import Configuration, configuration, open_session
from triquad_server.process.installed import check_device
from triquad_server.process.memory_share import ServerMemory
from triquad_server.process.resources import allow_open_files, give_back_early, resident_bytes
from triquad_server.process.service_manager import ServiceManager
from triquad_server.process.stop import Stop, Stops, wait_for_stop
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings
from triquad_server.store.found_map import FoundMap, find_map, find_share
from triquad_server.warm_up import Report, warm_up

if TYPE_CHECKING:
    from triquad_server.monitoring.http_server import MonitoringServer

_log = logging.getLogger("triquad_server")

_SWITCH_INTERVAL_S = 0.0005
"""The time for which a thread may keep the interpreter while another waits: a query is to be
answered in a few milliseconds, which is Python's default for a single turn."""


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
        with opened(options, stops, manager.starting, owns_process=True) as maps:
            # A quarter of a million objects, most of them numba's, stay: a collection that goes
            # through them stops all threads for a tenth of a second.
            gc.collect()
            gc.freeze()
            manager.notify("READY=1", status=maps.summary())
            why = wait_for_stop(stops, lambda: manager.serving(maps.summary, maps.stuck))
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
) -> Iterator[Maps]:
    """Yield a server; after the context, it has written last checkpoints and is closed.

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
) -> Maps:
    """Open all parts of a server, to be closed by ``stack``."""
    check_device(options.device)
    settings = options.settings
    network = configuration(options.network, settings, waits=not options.share)
    monitoring = _open_monitoring(settings, stack)
    session = stack.enter_context(closing(open_session(network)))
    created = [] if options.store is None else created_maps(options.store, options.map_names[0])
    names = tuple(dict.fromkeys([*options.map_names, *created]))
    with closing(StartingNotice(session, names)) as notice:

        def begins(stage: str) -> None:
            notice.stage = stage
            starting(stage)

        teams = stack.enter_context(closing(Teams()))
        before, memory = resident_bytes(), ServerMemory(settings.memory.max_bytes)
        begins("restoring the newest checkpoint")
        found = _found(names, options, memory, teams, stack)
        restored_bytes = resident_bytes() - before  # of maps that are read whole
        for own in {one.settings.field: one.settings for one in found}.values():
            warm_up(own, options.device, teams, _before_each_step(stops, begins))
        begins("opening the map")
        if owns_process:
            memory.count_program(resident_bytes() - restored_bytes)
        memory.check(len(options.map_names))
        maps = Maps(session, options, teams, memory, failed=stops.put)
        stack.enter_context(closing(maps))
        maps.begin(found)
    if monitoring is not None:
        stack.enter_context(monitoring.showing(lambda: maps.healths))
    _log_who_gets_in(network)
    _log_ready(options, network, maps)
    return maps


def _found(
    names: Sequence[str],
    options: LaunchOptions,
    memory: ServerMemory,
    teams: Teams,
    stack: ExitStack,
) -> list[FoundMap]:
    """Find the maps of a server, to be closed by ``stack``.

    One that a client has created, and that cannot be opened, does not keep the others from it.
    """
    found = []
    for name in names:
        is_named = name in options.map_names
        restore = options.restore if is_named else None
        if options.share and options.store is not None:
            one = find_share(
                name, options.settings, options.store, memory=memory, split=teams.answer
            )
            stack.enter_context(one.opened)
            return [one]
        try:
            one = find_map(
                name,
                options.settings,
                options.store,
                memory=memory,
                split=teams.answer,
                restore=restore,
            )
        except (StoreError, SettingsError) as error:
            if is_named:
                raise
            _log.error("map '%s', which a client has created, is not opened: %s", name, error)
            continue
        stack.enter_context(one.opened)
        found.append(one)
    return found


def _open_monitoring(settings: Settings, stack: ExitStack) -> "MonitoringServer | None":
    """Open the port for metrics, if one is configured, before all that takes time."""
    if settings.metrics.port == 0:
        return None
    # Only where it is wanted, since Python's HTTP server takes a while to import.
    from triquad_server.monitoring.http_server import MonitoringServer

    return stack.enter_context(closing(MonitoringServer(settings.metrics)))


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


def _log_ready(options: LaunchOptions, network: Configuration, maps: Maps) -> None:
    endpoints = ", ".join(network.listen) or f"a {network.mode} of {', '.join(network.connect)}"
    for health in maps.healths:
        _log.info(
            "ready: map '%s' on %s, epoch %d, %s, store %s",
            health.map_name,
            endpoints,
            health.epochs.newest.number,
            options.device,
            options.store or "none",
        )


class StartingNotice:
    """Tells clients, until it is closed, that the server of maps is there but not ready."""

    def __init__(self, session: zenoh.Session, map_names: Sequence[str]) -> None:
        """Begin to refuse questions."""
        self.stage = "it has just begun"
        # Zenoh's own thread answers: the others may be compiling.
        refuse = zenoh.handlers.Callback(self._refuse, indirect=False)
        self._queryables = [
            session.declare_queryable(keys.all_queries_key(name), refuse) for name in map_names
        ]

    def close(self) -> None:
        """Refuse no more."""
        for queryable in self._queryables:
            queryable.undeclare()

    def _refuse(self, query: zenoh.Query) -> None:
        reply = codec.encode(ErrorReply("starting", self.stage))
        with query:
            query.reply_err(reply, encoding=keys.encoding(ErrorReply))
