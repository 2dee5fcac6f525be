"""The service with a real map, asked by the real client over the loopback."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import triquad_client
from support import servers
from triquad_client import Status
from triquad_format.wire import codec, keys
from triquad_format.wire.status_messages import ServerStatus
from triquad_server.settings import ServiceSettings

POSE = np.eye(4)
PROBES = np.concatenate([servers.sphere(50, radius) for radius in (2.0, 3.9, 4.0, 4.1)])


def test_what_was_flushed_shows_in_the_next_answer(client):
    before = client.query_sdf(PROBES).epoch
    report = servers.learn(client)
    assert (report.taken, report.refused, report.lost) == (2, 0, 0)
    result = client.query_sdf(servers.sphere(100))
    assert result.epoch > before
    assert (result.status == Status.SURFACE).all()
    assert (client.query_sdf(servers.sphere(100, 2.0)).status == Status.FREE).all()


def test_settling_begins_with_what_was_just_published(client):
    large = servers.sphere(400_000)  # long on its way
    for count in range(1, 4):
        client.publish_scan(large, np.eye(4))
        assert client.settle(servers.WAIT_S).scans_taken == count


def test_flush_with_nothing_published_returns_at_once(client):
    report = client.flush()
    assert (report.taken, report.refused, report.lost, report.last_refusal) == (0, 0, 0, None)


def test_flush_lets_a_publisher_run_ahead(client):
    for _ in range(6):
        client.publish_scan(servers.sphere(), POSE)
        assert client.flush(servers.WAIT_S, pending=3).lost == 0
    assert client.flush(servers.WAIT_S).taken == 6


def test_flush_of_more_sources_than_requests_may_wait():
    few = ServiceSettings(request_queue=8)
    settings = servers.SMALL.model_copy(update={"service": few})
    with servers.service_and_client(settings) as client:
        for number in range(100):
            client.publish_scan(servers.sphere(20), POSE, source=f"camera{number}")
        assert client.flush(servers.WAIT_S).taken == 100


def test_large_queries_are_answered_from_one_epoch_while_the_map_changes(client, endpoint):
    servers.learn(client)
    probes = np.tile(PROBES, (1500, 1))  # 300 000 points: several requests
    stop = threading.Event()

    def publish():
        with triquad_client.connect(endpoint) as publisher:
            while not stop.is_set():
                servers.learn(publisher, 1)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        epochs = set()
        for _ in range(5):
            servers.learn(client, 1)  # returns once a new epoch is out
            result = client.query_sdf(probes)
            rows = result.sdf.reshape(1500, -1)
            # The part of a request in which a point travels moves its origin, by less than 1 um.
            assert np.allclose(rows, rows[0], rtol=0, atol=1e-4)
            assert (result.status.reshape(1500, -1) == result.status[: len(PROBES)]).all()
            epochs.add(result.epoch)
    finally:
        stop.set()
        thread.join()
    assert len(epochs) == 5


def test_many_threads_may_ask_at_once(client):
    epoch = servers.learn_all(client).epoch
    expected = client.query_sdf(PROBES, gradient=True)
    with ThreadPoolExecutor(8) as pool:
        asked = [pool.submit(client.query_sdf, PROBES, gradient=True) for _ in range(64)]
        results = [each.result() for each in asked]
    for result in results:
        assert result.epoch == epoch
        assert np.array_equal(result.sdf, expected.sdf)
        assert np.array_equal(result.gradient, expected.gradient)


def test_tiles_make_one_mesh(client):
    servers.learn_all(client)
    mesh = client.mesh()
    distance = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(distance - servers.RADIUS_M).mean() < 0.2  # after little training
    with client.watch_mesh() as watch:
        watch.catch_up()
        assert len(watch.tiles) > 1
        steps = mesh.vertices / watch.tile_side_m
    border = mesh.vertices[(np.abs(steps - np.round(steps)) < 1e-6).any(axis=1)]
    assert len(border) > 100
    assert len(np.unique(np.round(border, 5), axis=0)) == len(border)
    assert mesh.epoch == client.status().epoch


def test_holes_of_a_mesh_are_filled_where_that_is_asked_for(client):
    client.reset()
    points = servers.sphere(20_000)
    servers.learn_all(client, 5, points[np.abs(points[:, 0]) > 0.3])
    plain, mesh = client.mesh(), client.mesh(fill_m=np.float64(0.6))
    assert plain.filled is None
    assert (~mesh.filled).sum() == len(plain.faces)
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    assert mesh.filled.sum() > 100
    assert np.abs(centres[mesh.filled, 0]).min() < 0.1
    assert (client.query_sdf(centres[mesh.filled]).status != Status.FREE).all()
    assert client.mesh(((50, 50, 50), (60, 60, 60)), fill_m=0.6).filled.shape == (0,)


def test_the_status_is_published(endpoint):
    with servers.raw_session(connect=endpoint) as session:
        subscriber = session.declare_subscriber(keys.status_key(servers.MAP))
        sample = subscriber.recv()
        status = codec.decode(ServerStatus, sample.payload.to_bytes())
    assert status.map_name == servers.MAP
    assert status.memory_bytes > 2**20
    assert str(sample.encoding) == keys.encoding(ServerStatus)
