"""A client takes nothing from a server but answers to what it asked."""

import itertools
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import triquad_client
from support.attackers.hostile_server import Body, HostileServer, hostile_server, packed, told
from support.attackers.lies import LIES, QUESTIONS, TILE, Ask, Lie, out_of_bounds
from triquad_client import Client
from triquad_client.errors import BadReplyError, DownloadError
from triquad_format.errors import TriquadError
from triquad_format.wire import codec, keys

TIMEOUT_S = 9.0
MOST_BYTES = 2**20
ANY_VALUE = {
    "/tiles",
    "/tiles, shorter",
    "/stamp_ns",
    "/last_checkpoint/stamp_ns",
    "/kept_scans/since_ns",
    "/sources/default/newest/stamp_ns",
    "/sources/default/newest/points, shorter",
}
# These are replies of these kinds once more, and take longer.
REPEATED = ("filled mesh", "sdf of epoch", "sources again", "watch again", "watched tiles", "copy")
CHANGED = [name for name in QUESTIONS if name not in REPEATED]


@pytest.fixture(scope="module")
def connected() -> Iterator[tuple[HostileServer, Client]]:
    with (
        hostile_server() as server,
        triquad_client.connect(server.endpoint, timeout_s=TIMEOUT_S) as client,
    ):
        yield server, client


@pytest.fixture
def server(connected: tuple[HostileServer, Client]) -> HostileServer:
    server, _ = connected
    server.lie, server.refusal = lambda _, honest: honest, None
    return server


@pytest.fixture
def client(connected: tuple[HostileServer, Client]) -> Client:
    return connected[1]


@pytest.mark.parametrize("ask", [ask for _, ask in QUESTIONS.values()], ids=QUESTIONS)
def test_the_honest_answer_is_taken(
    server: HostileServer, client: Client, ask: Ask, tmp_path: Path
) -> None:
    assert server.endpoint
    ask(client, tmp_path / "map.triquad")


@pytest.mark.parametrize("lie", LIES, ids=lambda lie: lie.name)
def test_a_lie_is_refused_whole(
    server: HostileServer, client: Client, lie: Lie, tmp_path: Path
) -> None:
    server.lie = told(lie.operation, lie.change)
    with pytest.raises(TriquadError) as refusal:
        lie.ask(client, tmp_path / "map.triquad")
    assert isinstance(refusal.value, BadReplyError | DownloadError)
    assert str(refusal.value).isprintable()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("data", [b"", b"\x1b[2J", b"\xc1" * 100, b"\xdf\xff\xff\xff\xff"])
def test_bytes_that_are_no_message_are_refused(
    server: HostileServer, client: Client, data: bytes
) -> None:
    server.lie = lambda _asked, _honest: data
    with pytest.raises(BadReplyError):
        client.status()


@pytest.mark.parametrize("name", CHANGED)
def test_values_out_of_bounds_are_refused_one_by_one(
    server: HostileServer, client: Client, name: str, tmp_path: Path
) -> None:
    operation, ask = QUESTIONS[name]
    taken = set()
    for number in itertools.count():
        tried: list[str] = []

        def lie(body: Body, number: int = number, tried: list[str] = tried) -> None:
            lies_in_it = list(out_of_bounds(body))
            if number < len(lies_in_it):
                what, change = lies_in_it[number]
                tried.append(what)
                change()

        server.lie = told(operation, lie)
        try:
            ask(client, tmp_path / "map.triquad")
        except (BadReplyError, DownloadError):
            continue
        if not tried:
            break
        taken.add(tried[0])
    assert taken <= ANY_VALUE


def test_a_download_stays_below_what_the_client_takes(
    server: HostileServer, tmp_path: Path
) -> None:
    with triquad_client.connect(server.endpoint) as client:
        size = client.download_map(tmp_path / "map.triquad").bytes
    (tmp_path / "map.triquad").unlink()
    with triquad_client.connect(server.endpoint, max_download_bytes=size - 1) as client:
        with pytest.raises(DownloadError, match="max_download_bytes"):
            client.download_map(tmp_path / "map.triquad")
        with pytest.raises(DownloadError, match="max_download_bytes"):
            client.sync(((0, 0, 0), (1, 1, 1)), tmp_path / "map.triquad")
    assert list(tmp_path.iterdir()) == []
    with triquad_client.connect(server.endpoint, max_download_bytes=size) as client:
        client.download_map(tmp_path / "map.triquad")
    assert (tmp_path / "map.triquad").stat().st_size == size


def test_a_file_for_which_the_disk_has_no_room_is_not_begun(
    server: HostileServer, tmp_path: Path
) -> None:
    server.lie = told(keys.MAP_INFO, lambda body: body.update(bytes=2**52))
    with (
        triquad_client.connect(server.endpoint, max_download_bytes=2**53) as client,
        pytest.raises(DownloadError, match="free on its disk"),
    ):
        client.download_map(tmp_path / "map.triquad")
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_full_amid_a_file_is_an_error_that_names_it(
    server: HostileServer, tmp_path: Path
) -> None:
    path = tmp_path / "map.triquad"
    code = f"""
import resource, triquad_client
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
with triquad_client.connect({server.endpoint!r}) as client:
    client.download_map({str(path)!r})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith("OSError")
    assert str(path) in last
    assert list(tmp_path.iterdir()) == []


def watched(count: int, tile: bytes) -> Callable[[str, bytes], bytes]:
    """The lie that so many tiles changed, and are all like this one."""
    index = [(number, 0, 0) for number in range(count)]
    changed = {"tiles": packed(index, "<i4"), "changed": packed(np.ones(count), "<i8")}
    list_lie = told(keys.TILE_CHANGES, lambda body: body.update(changed))

    def fill(body: Body) -> None:
        asked = body["sizes"]["shape"][0]
        body.update(sizes=packed([len(tile)] * asked, "<i8"), data=tile * asked)

    tile_lie = told(keys.MESH, fill)
    return lambda asked, honest: tile_lie(asked, list_lie(asked, honest))


def test_a_watch_holds_no_more_than_the_client_takes(server: HostileServer) -> None:
    count = 32
    server.lie = watched(count, TILE)
    with (
        triquad_client.connect(server.endpoint, max_download_bytes=count * 48) as client,
        client.watch_mesh() as watch,
    ):
        assert watch.next(0.0) is not None
        assert len(watch.tiles) == count
    with (
        triquad_client.connect(server.endpoint, max_download_bytes=count * 48 - 1) as client,
        client.watch_mesh() as watch,
    ):
        with pytest.raises(DownloadError, match="max_download_bytes"):
            watch.next(0.0)
        assert not watch.tiles


def test_a_tile_of_a_few_bytes_that_would_fill_the_memory_is_not_made(
    server: HostileServer,
) -> None:
    server.lie = watched(1, (2**25).to_bytes(4, "little") * 2 + TILE[8:])
    with (
        triquad_client.connect(server.endpoint, max_download_bytes=MOST_BYTES) as client,
        client.watch_mesh() as watch,
        pytest.raises(DownloadError, match="max_download_bytes"),
    ):
        watch.next(0.0)


def test_a_mesh_of_more_bytes_than_the_client_takes_is_refused(server: HostileServer) -> None:
    with (
        triquad_client.connect(server.endpoint, max_download_bytes=40) as client,
        pytest.raises(DownloadError, match="max_download_bytes"),
    ):
        client.mesh()


@pytest.mark.parametrize(
    "refusal",
    [
        {"code": "busy\x1b[2J", "message": "wait"},
        {"code": "busy", "message": "\x1b]0;owned\x07\u202e\nERROR disk is gone"},
        {"code": "busy", "message": "x" * 60_000},
        {"code": "busy"},
    ],
)
def test_the_words_of_a_refusal_are_shown_as_what_they_are(
    server: HostileServer, client: Client, refusal: dict[str, str]
) -> None:
    body = {"triquad": codec.PROTOCOL_VERSION, "kind": "ErrorReply", **refusal}
    server.refusal = codec.msgpack.packb(body)
    with pytest.raises(TriquadError) as caught:
        client.status()
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 5_000
