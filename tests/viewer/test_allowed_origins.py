"""Pages of others in a browser cannot reach the map that is shown beside them."""

import asyncio
import multiprocessing
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import viser
import websockets.asyncio.client
from support.files.changing_store import EMPTY, write_checkpoint
from triquad_tools.viewer import allowed_origins
from triquad_tools.viewer.allowed_origins import refusal
from triquad_tools.viewer.sources import FileSource
from triquad_tools.viewer.viewer import Viewer
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.typing import Subprotocol

ALLOWED = "maps.example"
PLACE = "127.0.0.1:8080"


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    path = write_checkpoint(tmp_path_factory.mktemp("map"), 1, EMPTY)
    with closing(Viewer(FileSource(path, "file"), "127.0.0.1", 0, allowed_hosts=[ALLOWED])) as made:
        yield made


def is_refused(*head: tuple[str, str]) -> bool:
    return refusal(Headers(head), [ALLOWED]) is not None


@pytest.mark.parametrize("host", [PLACE, "localhost:1", "[::1]:1", f"{ALLOWED}:80", ALLOWED])
def test_our_names_and_our_own_page_are_answered(host: str) -> None:
    assert not is_refused(("Host", host))
    assert not is_refused(("Host", host), ("Origin", f"http://{host}"))
    assert not is_refused(("Host", host), ("Origin", f"https://{ALLOWED}"))


@pytest.mark.parametrize(
    "host",
    ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:8080", "[", ""],
)
def test_names_that_others_made_point_here_are_refused(host: str) -> None:
    assert is_refused(("Host", host))
    assert is_refused(("Host", PLACE), ("Host", host))
    assert is_refused()


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "http://127.0.0.1", "http://127.0.0.1:1", "file://", "x"],
)
def test_pages_of_others_are_refused(origin: str) -> None:
    assert is_refused(("Host", PLACE), ("Origin", origin))


async def first_message(viewer: Viewer, origin: str | None) -> bytes | str | int:
    """What the viewer tells whoever connects; the status of a refusal."""
    try:
        async with websockets.asyncio.client.connect(
            viewer.url.replace("http", "ws"),
            additional_headers={"Origin": origin} if origin else None,
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            compression=None,
        ) as connection:
            return await connection.recv()
    except InvalidStatus as refused:
        return refused.response.status_code


def test_the_map_is_told_to_our_page_and_to_programs_alone(viewer: Viewer) -> None:
    for origin in (None, viewer.url, f"https://{ALLOWED}"):
        assert isinstance(asyncio.run(first_message(viewer, origin)), bytes)
    assert asyncio.run(first_message(viewer, "http://evil.example")) == 403


def test_a_browser_that_leaves_at_once_is_no_error(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The viewer's library silences it, too, from the first request of a process on.
    own = [one for one in allowed_origins._log.filters if type(one).__name__ != "NoHttpErrors"]
    monkeypatch.setattr(allowed_origins._log, "filters", own)
    path = write_checkpoint(tmp_path, 1, EMPTY)
    with closing(Viewer(FileSource(path, "file"), "127.0.0.1", 0)) as viewer:
        address = urlsplit(viewer.url)
        with socket.create_connection((address.hostname, address.port)) as browser:
            browser.sendall(b"GET / HTTP/1.1\r\nHost:")
        # What is answered later was seen later.
        assert isinstance(asyncio.run(first_message(viewer, None)), bytes)
    assert caplog.messages == []


def test_nobody_who_reaches_the_page_can_show_it_to_the_internet(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(_: object) -> None:
        raise AssertionError("a process for a tunnel is started")

    monkeypatch.setattr(multiprocessing.Process, "start", start)
    viewer._server.request_share_url()  # as a message from a page has it done
