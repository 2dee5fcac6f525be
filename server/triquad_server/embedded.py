"""A server within a program: in a script, a notebook or a test, on threads of its own."""

import logging
import queue
import socket
import threading
import weakref
from collections.abc import Iterator
from concurrent.futures import Future, wait
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from triquad_format.errors import SettingsError
from triquad_format.wire.endpoints import full_endpoint

from triquad_server.errors import ServerError
from triquad_server.installed import require_libraries
from triquad_server.stop import Stop, Stops

if TYPE_CHECKING:
    from triquad_client import Client

    from triquad_server.launch_options import LaunchOptions
    from triquad_server.settings import Settings

_log = logging.getLogger("triquad_server")


class Server:
    """A map server within this program. Close it, or use it in a ``with`` statement.

    It has threads of its own, and changes neither the program's signals nor anything else that
    belongs to the process as a whole. A server that nobody has a reference to any more, or whose
    program ends, stops by itself, with its last checkpoint.
    """

    def __init__(self, options: "LaunchOptions") -> None:
        """Use :func:`serve`. Returns once the server has started."""
        (self.endpoint,) = options.network.listen
        self.map_name = options.map_name
        self._clients: weakref.WeakSet[Client] = weakref.WeakSet()
        self._ended: Future[Stop] = Future()
        stops: Stops = queue.SimpleQueue()
        self._ask_to_stop = weakref.finalize(self, stops.put, Stop.ASKED)
        started: Future[None] = Future()
        threading.Thread(
            target=_serve, args=(options, stops, started, self._ended), name="triquad-server"
        ).start()
        try:
            started.result()
        except BaseException:  # Ctrl-C too, which the thread hears of from us alone
            self._ask_to_stop()
            raise

    def __enter__(self) -> "Server":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def client(self, timeout_s: float = 10.0) -> "Client":
        """A new client of this server, which is closed with it at the latest.

        Args:
            timeout_s: for each request, as of ``triquad_client.connect``.

        Raises:
            ServerError: the server has stopped.
        """
        # The one door from the server to the client, of which the server itself needs nothing.
        from triquad_client import connect

        if self._ended.done():
            raise ServerError("the server has stopped: triquad_server.serve() starts another one")
        client = connect(self.endpoint, self.map_name, timeout_s=timeout_s)
        self._clients.add(client)
        return client

    def close(self) -> None:
        """Stop the server, with a last checkpoint if it has a store; twice does no harm.

        Ctrl-C meanwhile raises ``KeyboardInterrupt`` once all is written.

        Raises:
            StoreError: the last checkpoint cannot be written.
            ServerError: an internal error had stopped the server; the log has the details.
        """
        self._ask_to_stop()
        try:
            why = _awaited(self._ended)
        finally:
            for client in list(self._clients):
                client.close()
        if why is Stop.INTERNAL_ERROR:
            raise ServerError("an internal error had stopped the server; the log has the details")


def serve(
    *,
    store: str | Path | None = None,
    settings: "Settings | str | Path | None" = None,
    map: str = "default",  # noqa: A002 - the word of the command line and of the documentation
    listen: str | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> Server:
    """Start a map server within this program, and return once it serves.

    The very first start compiles for about a minute, as a warning in the log says.

    Args:
        store: folder for checkpoints; without one the map is not kept. The server goes on from
            the newest checkpoint there.
        settings: ``triquad_server.settings.Settings``, taken as they are, or a TOML file, over
            which the environment goes as for ``triquad-server``; ``None``: that of the environment
            alone.
        map: name of the map.
        listen: where other processes reach it, ``HOST:PORT`` or an endpoint of Zenoh; ``None``: a
            free port of the loopback.
        device: what it computes on; ``"auto"``: a GPU where there is one.

    Raises:
        ServerError: the server cannot start: :class:`ListenError`, :class:`StoreError`, or a
            library is missing.
        FormatError: a setting, the name of the map or the endpoint cannot be used.
    """
    require_libraries()
    from triquad_format.wire.keys import check_name

    from triquad_server.launch_options import LaunchOptions
    from triquad_server.net.session import NetworkOptions

    check_name("map", map)
    loaded = _loaded(settings)
    folder = None if store is None else Path(store)
    with _free_endpoint() if listen is None else nullcontext(full_endpoint(listen)) as endpoint:
        # Servers of programs on one network do not find each other: their maps have one name.
        network = NetworkOptions(listen=(endpoint,), multicast_scouting=False)
        return Server(LaunchOptions(map, network, settings=loaded, store=folder, device=device))


def _loaded(settings: "Settings | str | Path | None") -> "Settings":
    from triquad_server.settings import Settings
    from triquad_server.settings_loading import load_settings

    if isinstance(settings, Settings):
        return settings
    if not isinstance(settings, (str, Path, type(None))):
        raise SettingsError(f"settings = {settings!r}: give a Settings record or a TOML file")
    return load_settings(None if settings is None else Path(settings))


@contextmanager
def _free_endpoint() -> Iterator[str]:
    """An endpoint on a port of the loopback that nobody else is given while the context is open."""
    with closing(socket.socket()) as reserved:
        # Without this, Zenoh could not listen there as well.
        reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        reserved.bind(("127.0.0.1", 0))
        yield f"tcp/127.0.0.1:{reserved.getsockname()[1]}"


def _serve(
    options: "LaunchOptions", stops: Stops, started: "Future[None]", ended: "Future[Stop]"
) -> None:
    """Run a server, on a thread where no Ctrl-C cuts short an import or a checkpoint."""
    try:
        from triquad_server.launch import serve_until_stopped  # takes seconds

        ended.set_result(
            serve_until_stopped(options, stops, started=lambda: started.set_result(None))
        )
    except BaseException as error:
        if started.done():
            _log.error("the server stopped with an error: %s", error)
        else:
            started.set_exception(error)
        ended.set_exception(error)


def _awaited(ended: "Future[Stop]") -> Stop:
    """Why a server has stopped, once it has, however often Ctrl-C is pressed meanwhile."""
    interrupt: KeyboardInterrupt | None = None
    while not ended.done():
        try:
            wait([ended])
        except KeyboardInterrupt as pressed:
            interrupt = pressed
            _log.warning("the last checkpoint is still being written")
    if interrupt is not None:
        raise interrupt
    return ended.result()
