"""A map that several servers share: they answer as one, and come and go without it being seen."""

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support import servers
from support.poses import shifted
from triquad_client import Client, RefusedError, connect
from triquad_client.net.shared_connection import SharedConnection
from triquad_format.errors import InvalidInputError
from triquad_format.mapfile.checkpoint_folder import checkpoint_files
from triquad_format.mapfile.reader import open_manifest
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.status import Status
from triquad_format.wire.shares import lease_key, share_name

from bench.campaign.cutting_proxy import CuttingProxy
from bench.clients.server_process import ServerProcess, free_endpoint, server_process

MAP = "town"
PLACES = np.arange(0.0, 120.0, 6.0)  # metres along x, where spheres are scanned: six regions
WEST, EAST = PLACES[:10], PLACES[10:]
OPTIONS = ("--set", "store.period_s=1", "--set", "store.log_max_bytes=100_000_000")


@contextmanager
def sharing(
    store: Path, endpoint: str, others: Sequence[str], *more: str | Path
) -> Iterator[ServerProcess]:
    """One of the servers of a shared map, which connects to the others."""
    links = [word for other in others for word in ("--connect", other)]
    words = ["--map", MAP, "--share", "--store", store, "--settings", servers.SMALL_FILE]
    with server_process([*words, *OPTIONS, *links, *more], endpoint) as server:
        yield server


@contextmanager
def several(store: Path, count: int) -> Iterator[list[ServerProcess]]:
    endpoints = [free_endpoint() for _ in range(count)]
    with ExitStack() as stack:
        yield [
            stack.enter_context(sharing(store, own, [one for one in endpoints if one != own]))
            for own in endpoints
        ]


@contextmanager
def client_of(*asked: ServerProcess, shares: int) -> Iterator[Client]:
    """A client that may connect to some servers, once as many are there."""
    with connect(",".join(server.endpoint for server in asked), MAP) as client:
        servers.until(lambda: len(holders(client)[0]) == shares)
        yield client


def holders(client: Client) -> tuple[frozenset[int], dict[RegionIndex, frozenset[int]]]:
    """The servers that are there, and which of them have each region."""
    connection = client._connection
    assert isinstance(connection, SharedConnection)
    return connection.shares.numbers, connection.shares.leases


def publish(client: Client, places: Sequence[float]) -> None:
    for place in places:
        client.publish_scan(servers.sphere(), shifted(place))
    report = client.flush(servers.WAIT_S)
    assert report.taken >= len(places)
    assert (report.refused, report.lost) == (0, 0)


def points_of(places: Sequence[float]) -> NDArray[np.float64]:
    sphere = servers.sphere(100).astype(np.float64)
    return np.concatenate([sphere + [place, 0.0, 0.0] for place in places])


def shows(client: Client, places: Sequence[float]) -> bool:
    """Whether the map has the surface of the spheres at all of the places."""
    seen = client.query_sdf(points_of(places)).status == Status.SURFACE
    return bool(seen.reshape(len(places), -1).mean(axis=1).min() > 0.9)


def leave_by_two_that_are_killed(store: Path) -> None:
    """Have two servers map all places, write it, and be killed."""
    with several(store, 2) as (first, second), client_of(first, shares=2) as client:
        publish(client, PLACES)
        client.checkpoint()
        for server in (second, first):
            server.process.kill()
            server.wait()


def has_all(client: Client, number: int) -> bool:
    regions = holders(client)[1]
    return len(regions) >= 6 and all(who == {number} for who in regions.values())


def test_servers_answer_as_one(tmp_path: Path) -> None:
    with (
        several(tmp_path, 2) as shared,
        client_of(*shared, shares=2) as client,
        servers.service_and_client() as alone,
    ):
        # All at once; a scan may reach regions of both.
        for one in (client, alone):
            publish(one, PLACES)
        assert {who for one in holders(client)[1].values() for who in one} == {1, 2}
        for one in (client, alone):
            one.settle(servers.WAIT_S)
        client.checkpoint()
        points = points_of(PLACES)
        inner = points + 0.3 * (np.repeat(PLACES, 100)[:, None] * [1.0, 0.0, 0.0] - points)
        for ask in (
            lambda one: one.query_distance(inner).distance_m,
            lambda one: one.query_segments(inner[:-1], inner[1:]).clearance_m,
            lambda one: one.query_rays(inner, inner - points).range_m,
        ):
            off = np.abs(ask(client) - ask(alone))
            assert np.median(off) < 0.05
        assert shows(client, PLACES)
        assert client.query_sdf(points[::-1]).status.tolist() == (
            client.query_sdf(points).status[::-1].tolist()
        )
        grid = client.query_grid(([0, -1, 0], [114, 1, 0]), 0.5)
        assert np.isfinite(grid.distance_m).all()
        box = ([-5, -5, -5], [119, 5, 5])
        assert client.mesh(box).vertices[:, 0].max() > 113
        told = client.status()
        assert (told.map_name, told.settled, told.regions) == (MAP, True, alone.status().regions)
        assert client.download_map(tmp_path / "town.triquad").bytes > 0


def test_what_was_asked_of_an_epoch_stays(tmp_path: Path) -> None:
    with several(tmp_path, 2) as shared, client_of(*shared, shares=2) as client:
        publish(client, PLACES[::2])
        pinned, before = client.pinned(), client.status().epoch
        publish(client, PLACES[1::2])
        assert shows(client, PLACES)
        old = pinned.query_sdf(points_of(PLACES))
        assert old.epoch == pinned.epoch
        assert np.array_equal(
            old.status, client.query_sdf(points_of(PLACES), at_epoch=old.epoch).status
        )
        assert (old.status == Status.SURFACE).mean() < 0.7
        changes = client.changes(before)
        low = np.array([box.minimum for box in changes.boxes])
        high = np.array([box.maximum for box in changes.boxes])
        assert low[:, 0].min() < 22.0
        assert high[:, 0].max() > 100.0
        with pytest.raises(RefusedError, match="epoch_gone"):
            client.query_sdf(points_of(PLACES), at_epoch=1)


def test_where_one_is_killed_the_others_answer(tmp_path: Path) -> None:
    with several(tmp_path, 3) as shared, client_of(*shared, shares=3) as client:
        publish(client, PLACES)
        servers.until(lambda: client.status().regions_cold == 0)  # one of them has each
        client.settle(servers.WAIT_S)
        client.checkpoint()
        for killed, left in ((shared[0], 2), (shared[2], 1)):  # the client is linked to the first
            killed.process.kill()
            killed.wait()
            servers.until(
                lambda left=left: shows(client, PLACES) and len(holders(client)[0]) == left
            )
            assert client.mesh(([-5, -5, -5], [5, 5, 5])).vertices.size
        servers.until(lambda: has_all(client, 2))
        publish(client, PLACES + 1.0)
        client.reset(([60.0, -9.0, -9.0], [130.0, 9.0, 9.0]))
        assert shows(client, PLACES[:8])
        assert not shows(client, PLACES[-2:])


def test_who_joins_takes_regions_and_leaves_them(tmp_path: Path) -> None:
    ends = [free_endpoint() for _ in range(2)]
    with sharing(tmp_path, ends[0], [ends[1]]) as first, client_of(first, shares=1) as client:
        publish(client, PLACES)
        client.settle(servers.WAIT_S)
        assert has_all(client, 1)
        with sharing(tmp_path, ends[1], [ends[0]]) as second:
            with client_of(second, first, shares=2) as other:
                parted = {frozenset({1}), frozenset({2})}

                def is_parted() -> bool:
                    assert shows(client, PLACES)
                    assert shows(other, PLACES)
                    return {frozenset(who) for who in holders(other)[1].values()} == parted

                servers.until(is_parted)
                publish(other, PLACES + 2.0)
            second.process.terminate()
            while second.process.poll() is None:
                assert shows(client, PLACES)
                assert shows(client, PLACES + 2.0)
            assert second.wait() == 0, second.log
        servers.until(lambda: has_all(client, 1))
        assert shows(client, PLACES)
        assert shows(client, PLACES + 2.0)
        first.process.terminate()
        assert first.wait() == 0, first.log
    with sharing(tmp_path, ends[1], []) as again, client_of(again, shares=1) as client:
        assert has_all(client, 1), (holders(client), again.log)
        assert shows(client, PLACES)
        assert shows(client, PLACES + 2.0)


def test_after_the_network_was_divided_nothing_is_missing(tmp_path: Path) -> None:
    end = free_endpoint()
    with (
        sharing(tmp_path, end, []) as first,
        closing(CuttingProxy(end)) as between,
        sharing(tmp_path, free_endpoint(), [between.endpoint]) as second,
        client_of(first, shares=2) as west,
        client_of(second, shares=2) as east,
    ):
        publish(west, PLACES[::5])
        west.checkpoint()
        between.hold()
        between.cut()
        servers.until(lambda: len(holders(west)[0]) == len(holders(east)[0]) == 1)
        publish(west, WEST)
        publish(east, EAST)
        between.heal()
        servers.until(lambda: len(holders(west)[0]) == 2)
        servers.until(lambda: all(len(who) == 1 for who in holders(west)[1].values()))
        servers.until(lambda: shows(west, PLACES) and shows(east, PLACES))
        first.wait_for("that it kept are taken in")


def test_a_map_that_was_not_shared_is_gone_on_with(tmp_path: Path) -> None:
    words = ["--map", MAP, "--store", tmp_path, "--settings", servers.SMALL_FILE]
    with server_process(words) as alone, connect(alone.endpoint, MAP) as client:
        servers.learn_all(client)
        with server_process([*words, "--share"], ready=False) as refused:
            assert refused.wait() == 4
            assert "in use by another server" in refused.log
        alone.process.terminate()
        assert alone.wait() == 0
    with several(tmp_path, 2) as shared, client_of(*shared, shares=2) as client:
        servers.until(lambda: len(holders(client)[1]) == 1)
        assert shows(client, [0.0])
    assert not (tmp_path / MAP).exists()
    with server_process(words, ready=False) as refused:
        assert refused.wait() == 4
        assert "is shared, in" in refused.log
    second = tmp_path / f"{MAP}.2"
    with sharing(tmp_path, free_endpoint(), []) as last:
        servers.until(lambda: not second.exists())
        last.process.terminate()
        assert last.wait() == 0, last.log
    (tmp_path / f"{MAP}.1").rename(tmp_path / MAP)
    with server_process(words) as alone, connect(alone.endpoint, MAP) as client:
        assert shows(client, [0.0])


def test_what_was_reset_does_not_come_back_from_a_server_that_went(tmp_path: Path) -> None:
    with several(tmp_path, 2) as (first, second), client_of(first, shares=2) as client:
        publish(client, PLACES)
        client.checkpoint()
        second.process.kill()
        servers.until(lambda: has_all(client, 1))
        assert shows(client, PLACES)
        servers.until(lambda: not (tmp_path / f"{MAP}.2").exists())
        client.reset()
        first.process.terminate()
        assert first.wait() == 0, first.log
    with several(tmp_path, 2) as shared, client_of(*shared, shares=2) as client:
        assert client.status().regions == 0
        publish(client, PLACES[:1])
        assert shows(client, PLACES[:1])
        assert not shows(client, PLACES[1:])


def test_a_server_does_not_start_beside_a_store_that_cannot_be_read(tmp_path: Path) -> None:
    leave_by_two_that_are_killed(tmp_path)
    newest, *older = sorted((tmp_path / f"{MAP}.2").glob("*.checkpoint"), reverse=True)
    newest.write_bytes(b"rot")
    words = ["--map", MAP, "--share", "--store", tmp_path, "--settings", servers.SMALL_FILE]
    if older:
        with server_process(words) as again, client_of(again, shares=1) as client:
            servers.until(lambda: len(holders(client)[1]) > 0)
    for file in (tmp_path / f"{MAP}.2").glob("*.checkpoint"):
        file.write_bytes(b"rot")
    with server_process(words, ready=False) as refused:
        assert refused.wait() == 4
        assert f"{MAP}.2 has no valid checkpoint of a shared map: move it away" in refused.log


def test_a_region_that_cannot_be_read_is_begun_again_once_its_folder_is_moved_away(
    tmp_path: Path,
) -> None:
    leave_by_two_that_are_killed(tmp_path)
    folder = tmp_path / f"{MAP}.2"
    newest, *older = checkpoint_files(folder)
    for file in older:
        file.path.unlink()
    rotten = open_manifest(newest).entries[0]
    (folder / "parts" / rotten.name).write_bytes(bytes(rotten.stored))

    def refused(client: Client) -> bool:
        before = client.flush(servers.WAIT_S).refused
        client.publish_scan(servers.sphere(), shifted(25.6 * rotten.key.region[0]))
        return client.flush(servers.WAIT_S).refused > before

    with sharing(tmp_path, free_endpoint(), []) as again, client_of(again, shares=1) as client:
        servers.until(lambda: refused(client))
        told = client.flush(servers.WAIT_S).last_refusal
        assert told is not None
        assert f"{folder} cannot be taken" in told
        assert "restore that folder from a backup, or move it away" in told
        assert any(str(folder) in line for line in client.status().warnings)
        folder.rename(tmp_path / "aside")
        servers.until(lambda: not refused(client))
        again.process.terminate()
        again.wait()
        assert again.log.count("restore that folder") < 5, "each turn tells it again"


def test_a_clock_that_is_ahead_is_told(tmp_path: Path) -> None:
    with (
        several(tmp_path, 1) as (server,),
        client_of(server, shares=1) as client,
        servers.raw_session(connect=server.endpoint) as session,
    ):
        assert client.status().warnings == ()
        ahead_ms = (time.time_ns() + 90 * 10**9) // 10**6
        token = session.liveliness().declare_token(lease_key(MAP, 2, (9, 9, 9), ahead_ms))
        servers.until(lambda: "90 s ahead" in str(client.status().warnings))
        token.undeclare()
        token = session.liveliness().declare_token(
            lease_key(MAP, 2, (9, 9, 9), time.time_ns() // 10**6)
        )
        servers.until(lambda: client.status().warnings == ())
        token.undeclare()


def test_what_a_shared_map_cannot_do_is_refused(tmp_path: Path) -> None:
    with several(tmp_path, 1) as (server,), client_of(server, shares=1) as client:
        for ask in (
            lambda: client.correct_poses("default", [1.0], [np.eye(4)]),
            lambda: client.create_map("other"),
            lambda: client.drop_map("other"),
        ):
            with pytest.raises(RefusedError, match="several servers share"):
                ask()
        with pytest.raises(InvalidInputError):
            client.query_sdf([[np.nan, 0, 0]])
        with connect(server.endpoint, share_name(MAP, 1)) as one:
            assert one.status().map_name == f"{MAP}.1"
    for words in (["--share"], ["--share", "--store", "x", "--map", "a", "--map", "b"]):
        with server_process(words, ready=False) as refused:
            assert refused.wait() == 2
            assert "--share is for one map" in refused.log
