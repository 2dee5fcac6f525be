"""A server process and the service manager that started it, over a real socket."""

import os
import queue
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field

import numpy as np
import pytest
import triquad_client
from support import servers
from support.servers import ServerProcess
from triquad_format.wire import codec, keys
from triquad_format.wire.status_messages import ServerStatus, StatusRequest
from triquad_server.process.service_manager import ServiceManager

WATCHDOG_S = 2

HANGS_WHEN_TOLD = """
import sys, threading
from triquad_map.questions.answers import Answers
from triquad_server.cli import main
from triquad_server.mapping.mapper import Mapper

may_go_on = {"mapper": threading.Event(), "workers": threading.Event()}

def hanging(part, owner, name):
    work = getattr(owner, name)
    may_go_on[part].set()
    def wait_and_work(*arguments, **named):
        may_go_on[part].wait()
        return work(*arguments, **named)
    setattr(owner, name, wait_and_work)

def listen():
    for line in sys.stdin:
        part, _, word = line.strip().partition(" ")
        (may_go_on[part].clear if word == "hang" else may_go_on[part].set)()
        print(line, end="", flush=True)

hanging("mapper", Mapper, "ingest")
hanging("workers", Answers, "answer")
threading.Thread(target=listen, daemon=True).start()
sys.exit(main())
"""


@dataclass
class Manager:
    """Hears what a server tells, a datagram at a time."""

    address: str  # as the environment has it
    heard: list[list[str]] = field(default_factory=list)
    _datagrams: "queue.SimpleQueue[list[str]]" = field(default_factory=queue.SimpleQueue)

    def wait_for(self, line: str) -> list[str]:
        """The lines of the next datagram that has a line which begins with ``line``."""
        until = time.monotonic() + servers.WAIT_S
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


@pytest.fixture
def manager(tmp_path, monkeypatch) -> Iterator[Manager]:
    with service_manager(str(tmp_path / "notify")) as manager:
        monkeypatch.setenv("NOTIFY_SOCKET", manager.address)
        monkeypatch.setenv("WATCHDOG_USEC", str(WATCHDOG_S * 1_000_000))
        yield manager


def server_that_hangs_when_told(arguments: list[str]) -> AbstractContextManager[ServerProcess]:
    """A server whose mapper or workers hang as soon as they have something to do."""
    program, pipe = ["-c", HANGS_WHEN_TOLD], subprocess.PIPE
    return servers.server_process(arguments, program=program, stdin=pipe, stdout=pipe)


def tell(server: ServerProcess, word: str) -> None:
    """Tell a part of a server to "hang" or to "go on"; it has heard it once this returns."""
    assert server.process.stdin is not None
    assert server.process.stdout is not None
    server.process.stdin.write(f"{word}\n")
    server.process.stdin.flush()
    assert server.process.stdout.readline().strip() == word


def assert_answers_at_once(endpoint: str) -> None:
    """No client that tries again: a single request."""
    host, port = endpoint.removeprefix("tcp/").split(":")
    socket.create_connection((host, int(port))).close()
    with servers.raw_session("client", connect=endpoint) as session:
        answer = servers.RawPeer(session).ask(keys.STATUS, codec.encode(StatusRequest()))
    assert isinstance(answer, bytes)
    assert codec.decode(ServerStatus, answer).epoch >= 1


def told(manager: Manager, key: str) -> list[str]:
    return [line for lines in manager.heard for line in lines if line.startswith(f"{key}=")]


def test_it_is_ready_once_it_answers_and_says_when_it_stops(manager, arguments) -> None:
    with servers.server_process(arguments, ready=False) as server:
        ready = manager.wait_for("READY=1")
        assert_answers_at_once(server.endpoint)
        assert ready[1].startswith("STATUS=serving map 'default': epoch 1")
        stages = told(manager, "STATUS")[:-1]
        assert stages[0] == "STATUS=restoring the newest checkpoint"
        assert "STATUS=preparing compiled code: step 3 of 6: questions" in stages
        assert told(manager, "EXTEND_TIMEOUT_USEC")
        with triquad_client.connect(server.endpoint) as client:
            epoch = servers.learn_all(client, 2).epoch
        manager.wait_for(f"STATUS=serving map 'default': epoch {epoch}, 2 scans taken")
        server.process.send_signal(signal.SIGTERM)
        manager.wait_for("STOPPING=1")
        assert server.wait() == 0
    assert [line for lines in manager.heard for line in lines].count("READY=1") == 1


def test_an_abstract_socket_will_do(tmp_path, monkeypatch) -> None:
    with service_manager(f"@triquad-{tmp_path.name}-{id(tmp_path)}") as manager:
        monkeypatch.setenv("NOTIFY_SOCKET", manager.address)
        ours = ServiceManager()
        ours.notify("READY=1", status="serving")
        assert manager.wait_for("READY=1") == ["READY=1", "STATUS=serving"]
    assert ours.watchdog_s is None  # the manager did not ask


def test_asked_to_stop_while_it_starts_it_says_that_it_stops(manager, arguments) -> None:
    with servers.server_process(arguments, ready=False) as server:
        manager.wait_for("STATUS=preparing compiled code")
        server.process.send_signal(signal.SIGTERM)
        manager.wait_for("STOPPING=1")
        assert server.wait() == 0
    assert told(manager, "READY") == []
    assert server.lines[-1].endswith("stopped\n")
    assert "Traceback" not in server.log


def assert_nothing_more_is_well(manager: Manager, server: ServerProcess, why: str) -> None:
    server.wait_for(f"gets no more signs that all is well: {why}")
    before = len(manager.heard)
    for _ in range(4):  # with each of which all would be well, if it were
        manager.wait_for("STATUS=")
    assert not any("WATCHDOG=1" in lines for lines in manager.heard[before:])


def test_while_a_part_hangs_the_watchdog_is_not_told_that_all_is_well(manager, arguments) -> None:
    with server_that_hangs_when_told(arguments) as server:
        manager.wait_for("WATCHDOG=1")
        tell(server, "mapper hang")
        with triquad_client.connect(server.endpoint) as client:
            client.publish_scan(servers.sphere(), np.eye(4))
            assert_nothing_more_is_well(manager, server, "mapping makes no progress: it is at scan")
            assert_answers_at_once(server.endpoint)  # all else goes on
            tell(server, "mapper go on")
            assert client.flush(servers.WAIT_S).taken == 1
        manager.wait_for("WATCHDOG=1")
        tell(server, "workers hang")
        with triquad_client.connect(server.endpoint, timeout_s=servers.WAIT_S) as client:
            asking = threading.Thread(target=client.query_sdf, args=(servers.sphere(10),))
            asking.start()
            assert_nothing_more_is_well(manager, server, "a question gets no answer")
            tell(server, "workers go on")
            asking.join()
        manager.wait_for("WATCHDOG=1")


def test_given_up_by_the_watchdog_it_leaves_the_stacks_of_its_threads(manager, arguments) -> None:
    # The interpreter reads the stacks of threads that may go on meanwhile. In one of some dozens
    # of times one does, and its reading ends early.
    for _ in range(3):
        with servers.server_process(arguments) as server:
            manager.wait_for("READY=1")
            server.process.send_signal(signal.SIGABRT)  # as systemd does
            assert server.wait() < 0
        if 'mapper_thread.py", line' in server.log:
            return
    raise AssertionError(server.log)


@pytest.mark.parametrize("address", ["vsock:2:1234", "/nowhere/at/all"])
def test_a_manager_that_cannot_be_told_stops_nothing(manager, monkeypatch, address, caplog):
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    ServiceManager().notify("READY=1")
    assert "the service manager could not be notified of READY=1" in caplog.text
    assert manager.heard == []
