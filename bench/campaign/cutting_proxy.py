"""A TCP proxy whose connections can be cut, stalled and restored."""

import contextlib
import select
import socket
import threading


class CuttingProxy:
    """Forwards what arrives at its own port of the loopback, until it is cut or stalled."""

    def __init__(self, endpoint: str) -> None:
        """Begin to accept; ``endpoint`` is the server's, such as ``tcp/127.0.0.1:7447``."""
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        self._server = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._lock = threading.Lock()
        self._flowing = threading.Event()
        self._flowing.set()
        self._accepting = True
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def cut(self) -> int:
        """End all connections at once, also amid a message; return how many there were."""
        with self._lock:
            pairs, self._pairs = self._pairs, []
        for pair in pairs:
            for end in pair:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
        return len(pairs)

    def hold(self) -> None:
        """Forward nothing, but keep the connections."""
        self._flowing.clear()

    def heal(self) -> None:
        """Forward again."""
        self._flowing.set()

    def close(self) -> None:
        """End all connections and accept no more."""
        self._accepting = False
        self.heal()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._threads[0].join()
        self.cut()
        for thread in self._threads[1:]:
            thread.join()

    def _accept(self) -> None:
        while self._accepting:
            try:
                near, _ = self._listener.accept()
                far = socket.create_connection(self._server)
            except OSError:
                continue
            with self._lock:
                self._pairs.append((near, far))
            thread = threading.Thread(target=self._pass_on, args=(near, far))
            self._threads.append(thread)
            thread.start()

    def _pass_on(self, near: socket.socket, far: socket.socket) -> None:
        with near, far, contextlib.suppress(OSError):
            while True:
                readable, _, _ = select.select([near, far], [], [])
                self._flowing.wait()
                for end in readable:
                    data = end.recv(65_536)
                    if not data:
                        self._forget(near, far)
                        return
                    (far if end is near else near).sendall(data)

    def _forget(self, near: socket.socket, far: socket.socket) -> None:
        with self._lock:
            if (near, far) in self._pairs:
                self._pairs.remove((near, far))
