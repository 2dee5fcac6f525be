"""Runs a server within a program: in a script, a notebook or a test, on threads of its own."""

import logging
import queue
import socket
import threading
import weakref
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from triquad_format.errors import SettingsError
from triquad_format.wire.endpoints import full_endpoint

from triquad_server.errors import ServerError
from triquad_server.process.installed import require_libraries
from triquad_server.process.stop import Stop, Stops, wait_for_stop

if TYPE_CHECKING:
    from triquad_client import Client

    from triquad_server.launch_options import LaunchOptions
    from triquad_server.settings import Settings

_log = logging.getLogger("triquad_server")

_WAKE_S = 0.2  # for when two threads wait for the end


class _Run:
    """Runs a server on a thread of its own, where no Ctrl-C interrupts an import or a checkpoint.

    Other threads wait for it by what C code alone locks: the locks of Python's own conditions and
    futures may be in disorder after a ``KeyboardInterrupt``.
    """

    def __init__(self) -> None:
        self.stops: Stops = queue.SimpleQueue()
        self.has_ended = False
        self._started: queue.SimpleQueue[BaseException | None] = queue.SimpleQueue()
        self._why = Stop.ASKED
        self._error: BaseException | None = None
        self._running = threading.Lock()
        self._running.acquire()

    def serve(self, options: "LaunchOptions") -> None:
        """Serve until asked to stop; runs on the thread."""
        is_started = False
        try:
            from triquad_server.launch import opened  # takes seconds

            with opened(options, self.stops):
                is_started = True
                self._started.put(None)
                self._why = wait_for_stop(self.stops)
        except BaseException as error:
            self._error = error
            if is_started:
                _log.error("the server ended with an error: %s", error)  # maybe nobody closes it
            self._started.put(error)
        finally:
            self.has_ended = True
            self._running.release()

    def wait_for_start(self) -> None:
        """Wait until it serves; raises the error that keeps it from serving."""
        error = self._started.get()
        if error is not None:
            raise error

    def wait_for_end(self) -> Stop:
        """Wait for the end, however often Ctrl-C is pressed meanwhile; return why it has stopped.

        Raises:
            KeyboardInterrupt: it was pressed; the server has ended.
            ServerError: the server could not do what is due at its end.
        """
        interrupt: KeyboardInterrupt | None = None
        while not self.has_ended:
            try:
                self._running.acquire(timeout=_WAKE_S)  # nobody releases it after the thread
            except KeyboardInterrupt as pressed:
                interrupt = pressed
        if interrupt is not None:
            raise interrupt
        if self._error is not None:
            raise self._error
        return self._why


class Server:
    """A map server within this program. Close it, or use it in a ``with`` statement.

    It has threads of its own, and changes neither the program's signals nor anything else that
    belongs to the process as a whole. A server that nobody has a reference to any more, or whose
    program ends, stops by itself, with its last checkpoint.
    """

    def __init__(self, options: "LaunchOptions") -> None:
        """Start a server, and return once it has started; use :func:`serve` instead."""
        (self.endpoint,) = options.network.listen
        self.map_name = options.map_names[0]
        self._clients: weakref.WeakSet[Client] = weakref.WeakSet()
        self._run = _Run()
        self._ask_to_stop = weakref.finalize(self, self._run.stops.put, Stop.ASKED)
        threading.Thread(target=self._run.serve, args=(options,), name="triquad-server").start()
        try:
            self._run.wait_for_start()
        except BaseException:  # Ctrl-C too, which only this thread passes on
            self._ask_to_stop()
            raise

    def __repr__(self) -> str:
        state = ", stopped" if self._run.has_ended else ""
        return f"Server(map {self.map_name!r} at {self.endpoint}{state})"

    def __enter__(self) -> "Server":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def client(self, timeout_s: float = 10.0) -> "Client":
        """Return a new client of this server, which is closed with it at the latest.

        Args:
            timeout_s: the time limit of each request, as of ``triquad_client.connect``.

        Raises:
            ServerError: the server has stopped.
        """
        # The only import of the client by the server, which itself needs nothing of it.
        from triquad_client import connect

        if self._run.has_ended:
            raise ServerError("the server has stopped: triquad_server.serve() starts another one")
        client = connect(self.endpoint, self.map_name, timeout_s=timeout_s)
        self._clients.add(client)
        return client

    def close(self) -> None:
        """Stop the server, with a last checkpoint if it has a store; closing twice does no harm.

        Ctrl-C meanwhile raises ``KeyboardInterrupt`` once all is written.

        Raises:
            StoreError: the last checkpoint cannot be written.
            ServerError: the server had stopped by itself; the log has the details.
        """
        self._ask_to_stop()
        try:
            why = self._run.wait_for_end()
        finally:
            for client in list(self._clients):
                client.close()
        if why is not Stop.ASKED:
            raise ServerError(f"the server had stopped, {why.value}; the log has the details")


def serve(
    *,
    store: str | Path | None = None,
    settings: "Settings | str | Path | None" = None,
    map: str = "default",  # noqa: A002 - the word of the command line and of the documentation
    listen: str | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    restore: int | None = None,
) -> Server:
    """Start a map server within this program, and return once it serves.

    The very first start compiles for half a minute or more, as a warning in the log says.

    Args:
        store: folder for checkpoints; without one the map is not kept. The server goes on from
            the newest checkpoint there.
        settings: ``triquad_server.settings.Settings``, taken as they are, or a TOML file, over
            which the environment goes as for ``triquad-server``; ``None``: that of the environment
            alone.
        map: name of the map.
        listen: where other processes reach it, ``HOST:PORT`` or an endpoint of Zenoh; ``None``: a
            free port of the loopback.
        device: what it trains on; ``"cuda"``: a GPU.
        restore: the epoch of an older checkpoint of the store, to which the map is restored,
            such as ``client.reset().kept_epoch``; ``None``: the newest.

    Raises:
        ServerError: the server cannot start: :class:`ListenError`, :class:`StoreError`, or a
            library is missing.
        FormatError: a setting, the name of the map or the endpoint cannot be used.
    """
    require_libraries()
    from triquad_server.launch_options import LaunchOptions
    from triquad_server.network import NetworkOptions

    loaded = _loaded(settings)
    folder = None if store is None else Path(store)
    with _free_endpoint() if listen is None else nullcontext(full_endpoint(listen)) as endpoint:
        network = NetworkOptions(listen=(endpoint,))
        options = LaunchOptions((map,), network, loaded, folder, device, restore)
        return Server(options)


def _loaded(settings: "Settings | str | Path | None") -> "Settings":
    from triquad_server.settings import Settings
    from triquad_server.settings.loading import load_settings

    if isinstance(settings, Settings):
        return settings
    if not isinstance(settings, (str, Path, type(None))):
        raise SettingsError(f"settings = {settings!r}: give a Settings record or a TOML file")
    return load_settings(None if settings is None else Path(settings))


@contextmanager
def _free_endpoint() -> Iterator[str]:
    """Yield an endpoint on a loopback port that no one else is given while the context is open."""
    with closing(socket.socket()) as reserved:
        # Without this, Zenoh could not listen there as well.
        reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        reserved.bind(("127.0.0.1", 0))
        yield f"tcp/127.0.0.1:{reserved.getsockname()[1]}"
