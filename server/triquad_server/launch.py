"""Starting and stopping a server: one that is a process, or one within a program."""

import functools
import logging
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing

import numpy as np
from triquad_format.errors import SettingsError
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import MapRecord
from triquad_map.questions.distance import DistanceOptions, distances

from triquad_server.device import choose_device
from triquad_server.launch_options import LaunchOptions
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.monitoring.http_server import MonitoringServer
from triquad_server.net.configuration import Configuration, configuration
from triquad_server.net.session import open_session
from triquad_server.network_defaults import network_defaults
from triquad_server.phases import Phases
from triquad_server.process.memory import give_back_early
from triquad_server.process.open_files import allow_open_files
from triquad_server.process.service_manager import ServiceManager
from triquad_server.process.stop import Stop, Stops, wait_for_stop
from triquad_server.process.threads import Teams
from triquad_server.self_question import SelfQuestion
from triquad_server.service import ServedMap, Service
from triquad_server.settings import MemorySettings, Settings
from triquad_server.store.restore import ValidCheckpoint
from triquad_server.store.store import Store
from triquad_server.supervision import Supervision

_log = logging.getLogger("triquad_server")

_SWITCH_INTERVAL_S = 0.0005
"""How long a thread may hold the interpreter while another waits: a query is to be answered in a
few milliseconds, which is Python's default for a single turn."""

_QUICK_S = 3.0
"""Compiled code that is found on disk is ready by then."""

_WARM_UP_SCANS = 6  # of rays that pass the sphere, until it is taken back
_WARM_UP_DIRECTIONS = 400
_WARM_UP_RADIUS_M = 3.0


class _StoppedEarlyError(Exception):
    """The server was asked to stop before it had started."""


def run_server(options: LaunchOptions, stops: Stops) -> Stop:
    """Serve until something is put into ``stops``, and return it: this process does nothing else.

    Raises:
        ServerError: the server cannot start; subclasses tell what is in the way.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    give_back_early()
    allow_open_files()
    _stop_where_a_thread_ends(stops)
    if options.store is None:
        _log.warning("no --store: the map is not kept when the server stops")
    with closing(Supervision(ServiceManager())) as supervision:
        return serve_until_stopped(options, stops, supervision)


def _stop_where_a_thread_ends(stops: Stops) -> None:
    """Ask to stop where an exception ends a thread: without any of them this serves but in part."""
    tell = threading.excepthook

    def tell_and_stop(args: threading.ExceptHookArgs) -> None:
        tell(args)
        stops.put(Stop.INTERNAL_ERROR)

    threading.excepthook = tell_and_stop


def serve_until_stopped(options: LaunchOptions, stops: Stops, phases: Phases) -> Stop:
    """Serve until something is put into ``stops``, write a last checkpoint, and return it.

    Signals, and what else belongs to the process as a whole, are left as they are.

    Args:
        options: what the server is started with.
        stops: where it is asked to stop; before it has started, too.
        phases: hears how it goes.

    Raises:
        ServerError: the server cannot start; subclasses tell what is in the way.
    """
    try:
        with ExitStack() as stack:
            _open(options, stops, phases, stack)
            why = wait_for_stop(stops)
            _log.info("stopping, %s", why.value)
            phases.stopping()
    except _StoppedEarlyError:
        why = stops.get()
        phases.stopping()
    _log.info("stopped")
    return why


def _open(options: LaunchOptions, stops: Stops, phases: Phases, stack: ExitStack) -> None:
    """Open all parts of a server, to be closed by ``stack``."""
    device = choose_device(options.device)
    settings = options.settings
    network = configuration(options.network, network_defaults(options.map_name, settings))
    monitoring = _open_monitoring(settings, stack)
    store = None
    restored = None
    if options.store is not None:
        store = Store(options.store, options.map_name, settings.store)
        stack.enter_context(closing(store))
        if options.restore is not None:
            phases.starting(f"taking the map back to epoch {options.restore}")
            store.restore(options.restore)
        phases.starting("restoring the newest checkpoint")
        restored = _restored(store, options)
    if restored is not None:
        settings = _settings_of(restored.record, settings)
    teams = stack.enter_context(closing(Teams()))
    _prepare(settings, device, teams, next_stage=_unless_stopped(stops, phases))
    phases.starting("opening the map")
    mapper = Mapper(
        options.map_name,
        settings,
        device,
        record=restored.record if restored else None,
        teams=teams,
    )
    session = stack.enter_context(closing(open_session(network)))
    served = ServedMap(
        name=options.map_name,
        mapper=mapper,
        device=device,
        store=store,
        restored=restored.info if restored else None,
        teams=teams,
    )
    failed = functools.partial(stops.put, Stop.INTERNAL_ERROR)
    service = Service(session, served, settings, failed=failed)
    stack.enter_context(closing(service))
    if monitoring is not None:
        stack.enter_context(monitoring.showing(service.metrics))
    _log_who_gets_in(network)
    _log_ready(options, network, service.epoch, device)
    question = SelfQuestion(session, options.map_name, service.own_name)
    phases.serving(service.health, question)


def _open_monitoring(settings: Settings, stack: ExitStack) -> MonitoringServer | None:
    """The port for metrics, where one is wanted: it listens before all else takes its time."""
    if settings.metrics.port == 0:
        return None
    return stack.enter_context(closing(MonitoringServer(settings.metrics)))


def _restored(store: Store, options: LaunchOptions) -> ValidCheckpoint | None:
    """The checkpoint from which the map goes on, if there is one."""
    restored = store.newest()
    if restored is None:
        return None
    record = restored.record
    _log.info("restoring epoch %d from %s", record.epoch, restored.path)
    if record.name != options.map_name:
        _log.warning("the checkpoint is of a map named '%s'", record.name)
    return restored


def _settings_of(record: MapRecord, settings: Settings) -> Settings:
    """The settings for a restored map, which keeps its own field.

    Raises:
        SettingsError: lengths that are given do not go with it.
    """
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


def _unless_stopped(stops: Stops, phases: Phases) -> Callable[[str], None]:
    """What tells the next stage of the start, or ends the start if the server is asked to stop."""

    def next_stage(stage: str) -> None:
        if not stops.empty():
            raise _StoppedEarlyError
        phases.starting(stage)

    return next_stage


def _prepare(
    settings: Settings, device: str, teams: Teams, *, next_stage: Callable[[str], None]
) -> None:
    """Have all kernels compiled; whoever waits for it is told how it goes.

    Raises:
        _StoppedEarlyError: of ``next_stage``: the server is asked to stop.
    """
    _log.info("preparing compiled code")
    started = time.monotonic()

    def report(stage: str) -> None:
        next_stage(f"preparing compiled code: {stage}")
        seconds = time.monotonic() - started
        if seconds > _QUICK_S:
            _log.info("%.0f s so far; next: %s", seconds, stage)

    warm_up(settings, device, teams, report=report)


def warm_up(
    settings: Settings,
    device: str,
    teams: Teams | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> None:
    """Map and ask a made-up sphere, let it vanish, and forget it.

    Compiling takes a minute at the very first start; then the compiled code is found on disk.
    ``report`` is told what comes next.
    """
    count = min(_WARM_UP_DIRECTIONS, settings.scan.max_points)
    directions = np.random.default_rng(0).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = min(max(_WARM_UP_RADIUS_M, settings.scan.range_min_m), settings.scan.range_max_m)
    teams = teams or Teams()
    settings = settings.model_copy(update={"memory": MemorySettings()})  # with room for it
    mapper = Mapper("warm-up", settings, device, teams=teams)
    report("taking in scans")
    rays = mapper.ingest((directions * radius).astype(np.float32), np.eye(4))
    mapper.regions[0].growth_by(rays)
    report("training")
    mapper.train()
    mapper.publish()
    report("what is gone")
    for _ in range(_WARM_UP_SCANS):
        mapper.ingest((2 * directions * radius).astype(np.float32), np.eye(4))
    epoch = mapper.publish()
    again = Mapper("warm-up", settings, device, mapper.changes_since(None).record, teams)
    again.publish()
    region = again.regions[0]
    blocks = region.evidence.surface_blocks()
    region.field.hold(region.field.tree.rows_under(blocks, BLOCK_VOXELS))
    region.field.live_view().evaluate(rays.ends.astype(np.float32), gradient=True)
    region.pool.focus(blocks)  # as if it were seen anew
    again.train()
    report("queries")
    epoch.query(directions, gradient=True)
    distances(epoch, directions, DistanceOptions(unknown_distance=True))
    report("meshes")
    cache = TileCache(settings.mesh, teams.meshing)
    cache.refresh(epoch)
    cache.make(0, (0, 0, 0))


def _log_who_gets_in(network: Configuration) -> None:
    """Say whom the network lets in, and what they may do."""
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


def _log_ready(options: LaunchOptions, network: Configuration, epoch: int, device: str) -> None:
    endpoints = ", ".join(network.listen) or f"a {network.mode} of {', '.join(network.connect)}"
    _log.info(
        "ready: map '%s' on %s, epoch %d, %s, store %s",
        options.map_name,
        endpoints,
        epoch,
        device,
        options.store or "none",
    )
