"""Copies of a server's map that stay current, and answer when the link drops."""

import io
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import triquad_client
from mcap.writer import Writer as McapWriter
from support import servers
from support.files.file_damage import rot
from support.poses import shifted
from triquad_client import (
    Client,
    ClosedError,
    ConnectError,
    EmptierMapError,
    InvalidInputError,
    RefusedError,
    SyncedMap,
    SyncReport,
    UnknownMapError,
)

FAR_M = 60.0  # from the first room to the second: in another region
WHOLE = ((-10, -10, -10), (FAR_M + 10, 10, 10))
FIRST = ((-10, -10, -10), (10, 10, 10))
POINTS = np.random.default_rng(0).uniform(-6, 6, (3000, 3))


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """Of a server that has learnt two rooms, of which tests change some."""
    with servers.service_and_client() as client:
        learn(client, 0.0)
        learn(client, FAR_M)
        yield client


def learn(client: Client, x_m: float, radius_m: float = 4.0) -> None:
    """Have the server learn a room, and settle."""
    servers.learn_all(client, 1, servers.sphere(radius_m=radius_m), shifted(x_m))


def assert_same_answers(local: SyncedMap, client: Client, points: np.ndarray = POINTS) -> None:
    have, want = local.query_distance(points), client.query_distance(points)
    assert have.epoch == want.epoch
    np.testing.assert_array_equal(have.status, want.status)
    assert np.quantile(np.abs(have.distance_m - want.distance_m), 0.99) < 1e-3


def test_a_copy_answers_as_the_server(client: Client, tmp_path: Path) -> None:
    path = tmp_path / "copy.triquad"
    local = client.sync(WHOLE, path)
    assert local.epoch == client.status().epoch
    assert_same_answers(local, client)
    assert_same_answers(local, client, POINTS + (FAR_M, 0, 0))
    with triquad_client.open_map(path) as offline:
        again = offline.query_distance(POINTS)
    np.testing.assert_array_equal(again.distance_m, local.query_distance(POINTS).distance_m)


def test_a_copy_holds_what_its_box_needs_and_no_more(client: Client, tmp_path: Path) -> None:
    whole, first = (client.sync(box, tmp_path / "copy.triquad") for box in (WHOLE, FIRST))
    assert_same_answers(first, client)
    assert 0 < first.report.parts < whole.report.parts
    assert not first.query_distance(POINTS + (FAR_M, 0, 0)).found.any()


def test_only_what_changed_travels(client: Client, tmp_path: Path) -> None:
    local = client.sync(WHOLE, tmp_path / "copy.triquad")
    everything = local.report
    assert everything.parts_kept == 0
    unchanged = local.refresh()
    assert (unchanged.bytes_received, unchanged.parts_received) == (0, 0)
    learn(client, FAR_M, radius_m=3.0)
    changed = local.refresh()
    assert changed == local.report
    assert changed.epoch == client.status().epoch
    assert 0 < changed.parts_received < everything.parts
    assert changed.parts_kept + changed.parts_received >= everything.parts
    assert changed.bytes_received < 0.75 * everything.bytes_received
    assert_same_answers(local, client, POINTS + (FAR_M, 0, 0))


def test_the_copy_of_an_earlier_run_is_taken_up(client: Client, tmp_path: Path) -> None:
    path = tmp_path / "copy.triquad"
    before = client.sync(WHOLE, path).report
    again = client.sync(WHOLE, path)
    assert again.report.parts_received == 0
    assert again.report.parts_kept == before.parts
    assert again.report.bytes_received < 0.2 * before.bytes_received
    assert_same_answers(again, client)


def test_a_damaged_copy_is_mended(client: Client, tmp_path: Path) -> None:
    path = tmp_path / "copy.triquad"
    parts = client.sync(WHOLE, path).report.parts
    rot(path)
    mended = client.sync(WHOLE, path)
    assert mended.report.parts_received >= 1
    assert mended.report.parts_kept + mended.report.parts_received == parts
    assert_same_answers(mended, client)
    for content in (b"", path.read_bytes()[:-50], path.read_bytes()[:20]):
        path.write_bytes(content)
        assert client.sync(WHOLE, path).report.parts_received == parts
        assert triquad_client.open_map(path).epoch == client.status().epoch


@pytest.mark.parametrize("way", ["sync", "refresh", "download_map"])
def test_what_is_no_map_is_never_replaced(client: Client, tmp_path: Path, way: str) -> None:
    path = tmp_path / "notes.txt"
    if way == "refresh":
        write = client.sync(WHOLE, path).refresh
    elif way == "sync":
        write = partial(client.sync, WHOLE, path)
    else:
        write = partial(client.download_map, path)
    recording = io.BytesIO()
    writer = McapWriter(recording)
    writer.start(profile="ros2", library="triquad")
    writer.finish()
    whole = recording.getvalue()
    for content in (b"something else", b"triquad checkpoint\n", whole, whole[:-50]):
        path.write_bytes(content)
        with pytest.raises(
            InvalidInputError, match=r"notes\.txt is there.*another name, or delete"
        ):
            write()
        assert path.read_bytes() == content
    path.unlink()
    write()
    write()  # an older map is replaced


@pytest.mark.parametrize("name", ["", ".", None, 7])
def test_a_map_is_written_to_a_file_that_has_a_name(client: Client, name: Any) -> None:
    for write in (partial(client.sync, WHOLE, name), partial(client.download_map, name)):
        with pytest.raises(InvalidInputError, match=f"path = {name!r} is no file: give the name"):
            write()


def test_it_answers_while_the_server_is_gone_and_outlives_one_that_lost_its_map(
    tmp_path: Path,
) -> None:
    path, endpoint = tmp_path / "copy.triquad", servers.free_endpoint()
    with servers.running_service(endpoint=endpoint):
        client = triquad_client.connect(endpoint, timeout_s=5.0)
        learn(client, 0.0)
        local = client.sync(FIRST, path)
        before, data, age_s = local.query_distance(POINTS), path.read_bytes(), local.age_s
    with pytest.raises(ConnectError, match="down"):
        refresh_until_the_link_is_lost(local)
    assert local.age_s > age_s
    np.testing.assert_array_equal(local.query_distance(POINTS).distance_m, before.distance_m)
    assert triquad_client.open_map(path).epoch == before.epoch
    with client, servers.running_service(endpoint=endpoint):
        with pytest.raises(EmptierMapError, match="The copy stays as it is.*accept_emptier=True"):
            refresh_once_linked(local)
        # A program that was started again, too, has the file alone.
        with pytest.raises(EmptierMapError):
            client.sync(FIRST, path)
        assert path.read_bytes() == data
        np.testing.assert_array_equal(local.query_distance(POINTS).status, before.status)
        taken = client.sync(FIRST, path, accept_emptier=True)
        assert not taken.query_distance(POINTS).status.any()
        learn(client, 0.0)
        taken.refresh()
        assert_same_answers(taken, client)
    with pytest.raises(ClosedError):
        local.refresh()
    assert local.query_distance(POINTS).epoch == local.epoch


def refresh_until_the_link_is_lost(local: SyncedMap) -> None:
    """Raises what refreshing does then: that a server is gone is noticed some time after."""
    deadline = time.monotonic() + servers.WAIT_S
    while time.monotonic() < deadline:
        with suppress(UnknownMapError):
            local.refresh()


def refresh_once_linked(local: SyncedMap) -> SyncReport:
    """The link is set up again some time after it was lost."""
    deadline = time.monotonic() + servers.WAIT_S
    while True:
        try:
            return local.refresh()
        except ConnectError:
            assert time.monotonic() < deadline
            time.sleep(0.1)


def test_a_copy_has_one_epoch(client: Client, tmp_path: Path) -> None:
    local = client.sync(FIRST, tmp_path / "copy.triquad")
    before = local.epoch
    local.query_sdf(POINTS, at_epoch=before)
    learn(client, 0.0, radius_m=3.5)
    assert local.query_sdf(POINTS).epoch == before
    local.refresh()
    assert local.query_sdf(POINTS).epoch == local.epoch > before
    with pytest.raises(RefusedError) as refusal:
        local.query_sdf(POINTS, at_epoch=before)
    assert refusal.value.code == "epoch_gone"


def test_of_an_unknown_place_nothing_is_known_until_it_is(tmp_path: Path) -> None:
    with servers.service_and_client() as client:
        local = client.sync(FIRST, tmp_path / "copy.triquad")
        assert not local.query_distance(POINTS).status.any()
        learn(client, 0.0)
        local.refresh()
        assert_same_answers(local, client)
        client.reset(FIRST)
        local.refresh()
        assert not local.query_distance(POINTS).status.any()


def test_bounds_that_hold_nothing_are_refused(client: Client, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="hold nothing"):
        client.sync(((0, 0, 0), (0, 1, 1)), tmp_path / "copy.triquad")
    with pytest.raises(OSError, match="nowhere"):
        client.sync(FIRST, tmp_path / "nowhere" / "copy.triquad")


SYNCING = """
import sys, triquad_client
with triquad_client.connect(sys.argv[1]) as client:
    while True:
        client.sync(((-10, -10, -10), (70, 10, 10)), sys.argv[2])
        print("synced", flush=True)
"""


def test_a_process_that_is_killed_leaves_a_whole_copy(tmp_path: Path) -> None:
    path = tmp_path / "copy.triquad"
    with servers.running_service() as endpoint, triquad_client.connect(endpoint) as client:
        learn(client, 0.0)
        epoch = client.status().epoch
        for rounds in (1, 3):
            command = [sys.executable, "-c", SYNCING, endpoint, str(path)]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
                assert process.stdout is not None
                for _ in range(rounds):
                    assert process.stdout.readline() == "synced\n"
                process.kill()
            assert triquad_client.open_map(path).epoch == epoch
