"""Pages of others in a browser cannot reach the map that is shown beside them."""

import asyncio
import multiprocessing
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import viser
import websockets.asyncio.client
from support.changing_store import EMPTY, write_checkpoint
from triquad_tools.viewer.sources.stored_source import StoredMap, StoredSource
from triquad_tools.viewer.viewer import Viewer
from websockets.exceptions import InvalidStatus
from websockets.typing import Subprotocol

ALLOWED = "maps.example"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address and port of a viewer."""
    path = write_checkpoint(tmp_path_factory.mktemp("map"), 1, EMPTY)
    source = StoredSource(StoredMap(path), path.name)
    with closing(Viewer(source, "127.0.0.1", 0, allowed_hosts=[ALLOWED])) as viewer:
        yield viewer.url.removeprefix("http://")


async def page_status(place: str, head: list[str]) -> int:
    """The status of the page, asked for with these lines."""
    address, port = place.split(":")
    reader, writer = await asyncio.open_connection(address, int(port))
    lines = ["GET / HTTP/1.1", *head, "Connection: close", "", ""]
    writer.write("\r\n".join(lines).encode())
    status = await reader.readline()
    writer.close()
    return int(status.split()[1])


async def first_message(place: str, host: str, origin: str | None) -> bytes | str | int:
    """What the viewer tells whoever connects; the status of a refusal."""
    address, port = place.split(":")
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    try:
        async with websockets.asyncio.client.connect(
            f"ws://{host}/",
            host=address,
            port=int(port),
            additional_headers={"Origin": origin} if origin else None,
            subprotocols=[protocol],
            compression=None,
        ) as connection:
            return await connection.recv()
    except InvalidStatus as refused:
        return refused.response.status_code


@pytest.mark.parametrize("host", ["{place}", "localhost:1", "[::1]:1", f"{ALLOWED}:80", ALLOWED])
def test_the_page_is_served_under_our_names(place: str, host: str) -> None:
    host = host.format(place=place)
    assert asyncio.run(page_status(place, [f"Host: {host}"])) == 200
    assert isinstance(asyncio.run(first_message(place, host, f"http://{host}")), bytes)


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:8080", "[", ""]
)
def test_names_that_others_made_point_here_are_refused(place: str, host: str) -> None:
    assert asyncio.run(page_status(place, [f"Host: {host}"])) == 403


def test_a_page_that_was_made_to_look_like_ours_is_refused(place: str) -> None:
    answer = first_message(place, "evil.example", "http://evil.example")
    assert asyncio.run(answer) == 403


def test_a_request_with_two_names_or_none_is_refused(place: str) -> None:
    assert asyncio.run(page_status(place, [])) == 403
    assert asyncio.run(page_status(place, [f"Host: {place}", "Host: evil.example"])) == 403


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "http://127.0.0.1", "http://127.0.0.1:1", "file://", "x"],
)
def test_pages_of_others_are_refused(place: str, origin: str) -> None:
    assert asyncio.run(first_message(place, place, origin)) == 403
    assert asyncio.run(page_status(place, [f"Host: {place}", f"Origin: {origin}"])) == 403


def test_a_program_and_an_allowed_page_are_let_in(place: str) -> None:
    assert isinstance(asyncio.run(first_message(place, place, None)), bytes)
    assert isinstance(asyncio.run(first_message(place, place, f"https://{ALLOWED}")), bytes)


def test_nobody_who_reaches_the_page_can_show_it_to_the_internet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(_: object) -> None:
        raise AssertionError("a process for a tunnel is started")

    monkeypatch.setattr(multiprocessing.Process, "start", start)
    source = StoredSource(StoredMap(write_checkpoint(tmp_path, 1, EMPTY)), "file")
    with closing(Viewer(source, "127.0.0.1", 0)) as viewer:
        viewer._server.request_share_url()  # as a message from a page has it done
