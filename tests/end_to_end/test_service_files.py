"""The files of a service with a real map: downloads, and checkpoints in its store."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event

import numpy as np
import pytest
import triquad_client
from support import servers
from triquad_client import RefusedError, RequestTimeoutError
from triquad_format.mapfile.reader import read_map
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import MapChunk, MapChunkRequest, ResetRequest
from triquad_server.store.store import Store


def test_a_downloaded_map_is_the_map(client, tmp_path):
    servers.learn_all(client)
    path = tmp_path / "map.triquad"
    info = client.download_map(path)
    assert path.stat().st_size == info.bytes
    record = read_map(path)
    assert record.epoch == info.epoch == client.status().epoch
    assert len(record.regions) == 1
    assert record.regions[0].training is None
    assert client.download_map(path) == info
    client.download_map(path, training=True)
    assert read_map(path).regions[0].training is not None
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.triquad"]


def test_a_checkpoint_may_take_longer_than_a_reply(tmp_path, monkeypatch):
    begun, let, write = Event(), Event(), Store.write

    def held_write(self, *what):
        begun.set()
        assert let.wait(servers.WAIT_S)
        return write(self, *what)

    with (
        servers.running_service(store=tmp_path) as endpoint,
        triquad_client.connect(endpoint, timeout_s=2.0) as client,
        ThreadPoolExecutor(1) as pool,
    ):
        servers.learn(client)
        monkeypatch.setattr(Store, "write", held_write)
        with pytest.raises(
            RequestTimeoutError, match=r"has been at it for \d+ s, and will finish it"
        ):
            client.checkpoint(timeout_s=0.5)
        assert begun.is_set()
        patient = pool.submit(client.checkpoint)
        assert client.status().last_checkpoint is None, "others are answered meanwhile"
        let.set()
        assert patient.result(servers.WAIT_S) == client.status().last_checkpoint


def test_chunks_of_other_files_or_beyond_the_end_are_refused(client, endpoint, tmp_path):
    info = client.download_map(tmp_path / "map.triquad")
    with servers.raw_session(connect=endpoint) as session:
        peer = servers.RawPeer(session)
        assert peer.refusal(keys.MAP_CHUNK, MapChunkRequest("00" * 32, 0, 10)) == "chunk_gone"
        for offset, length in ((-1, 10), (info.bytes, 10), (2**62, 10), (0, 0), (0, -1)):
            request = MapChunkRequest(info.sha256, offset, length)
            assert peer.refusal(keys.MAP_CHUNK, request) == "bad_request"
        data = (tmp_path / "map.triquad").read_bytes()
        for length, end in ((5, 8), (2**62, None)):
            answer = peer.ask(keys.MAP_CHUNK, codec.encode(MapChunkRequest(info.sha256, 3, length)))
            assert codec.decode(MapChunk, answer).data == data[3:end]


def test_without_a_store_checkpoints_are_refused_and_the_status_says_so(client):
    with pytest.raises(RefusedError, match="without a store") as caught:
        client.checkpoint()
    assert caught.value.code == "store"
    assert "not kept" in client.status().store_error


def test_a_checkpoint_writes_what_changed_and_the_next_server_has_all(tmp_path):
    def stored_bytes():
        return sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())

    def learn_at(client, *places_m):
        for pose[0, 3] in places_m:
            client.publish_scan(servers.sphere(), pose)
        client.settle(servers.WAIT_S)

    pose = np.eye(4)
    probes = np.concatenate([servers.sphere(200) + [x_m, 0, 0] for x_m in (0, 75)])
    with servers.service_and_client(store=tmp_path) as client:
        learn_at(client, 0, 25, 50, 75)
        whole, whole_bytes = client.checkpoint(), stored_bytes()
        learn_at(client, 75)
        part = client.checkpoint()
        assert client.checkpoint() == client.status().last_checkpoint == part
        assert part.bytes > whole.bytes / 2
        assert stored_bytes() - whole_bytes < whole.bytes / 2
        before = client.query_sdf(probes)
    with servers.service_and_client(store=tmp_path) as client:
        assert client.status().last_checkpoint.epoch == part.epoch == before.epoch
        servers.assert_same_map(before, client.query_sdf(probes))


def test_a_reset_while_the_last_checkpoint_is_written_is_not_acknowledged(tmp_path, monkeypatch):
    replies = []
    write = Store.write

    def reset_meanwhile(store, *checkpoint):
        with servers.raw_session(connect=endpoint) as session:
            request = ResetRequest(np.full(3, -np.inf), np.full(3, np.inf))
            replies.append(servers.RawPeer(session).ask(keys.RESET, codec.encode(request)))
        return write(store, *checkpoint)

    with servers.running_service(store=tmp_path) as endpoint:
        with triquad_client.connect(endpoint) as client:
            servers.learn(client)
        monkeypatch.setattr(Store, "write", reset_meanwhile)
    assert replies == [None]
