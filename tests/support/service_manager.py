"""A service manager for the tests: a real socket that a server process tells how it does."""

import os
import queue
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from support.servers import WAIT_S


@dataclass
class Manager:
    """Hears what a server tells, a datagram at a time."""

    address: str  # as the environment has it
    heard: list[list[str]] = field(default_factory=list)
    _datagrams: "queue.SimpleQueue[list[str]]" = field(default_factory=queue.SimpleQueue)

    def wait_for(self, line: str) -> list[str]:
        """The lines of the next datagram that has a line which begins with ``line``."""
        until = time.monotonic() + WAIT_S
        while True:
            lines = self._datagrams.get(timeout=max(0.0, until - time.monotonic()))
            if any(told.startswith(line) for told in lines):
                return lines

    def listen(self, receiver: socket.socket) -> None:
        while lines := receiver.recv(65_536).decode().split("\n"):
            if lines == [""]:
                return
            self.heard.append(lines)
            self._datagrams.put(lines)


@contextmanager
def service_manager(address: str) -> Iterator[Manager]:
    """Listens at a path, or at an abstract socket, which begins with @."""
    bound = "\0" + address[1:] if address.startswith("@") else address
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(bound)
        manager = Manager(address)
        thread = threading.Thread(target=manager.listen, args=(receiver,))
        thread.start()
        try:
            yield manager
        finally:
            receiver_address = receiver.getsockname()
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.sendto(b"", receiver_address)
            thread.join()
    if not address.startswith("@"):
        os.unlink(address)
