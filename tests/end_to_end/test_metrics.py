"""The figures of a server with a real map, asked by the real client over the loopback."""

import numpy as np
import pytest
import triquad_client
from support import servers
from triquad_client import ServerMetrics


def figures(client: triquad_client.Client, done) -> ServerMetrics:
    """The figures, once they show what is ``done``: a request counts after its reply is sent."""
    for _ in range(1000):
        metrics = client.metrics()
        if done(metrics):
            return metrics
    raise AssertionError(f"never came: {metrics}")


def test_every_answer_is_counted_and_timed(client):
    servers.learn(client)
    before = client.metrics()
    for _ in range(20):
        client.query_sdf(servers.sphere(1000))
    now = figures(client, lambda m: m.operations["query/sdf"].answered == 20)
    asked = now.operations["query/sdf"]
    assert asked.pending == 0
    assert asked.refused == {}
    assert asked.received_bytes > 20 * 12_000
    assert asked.sent_bytes > 20 * 5_000
    assert asked.waits.count == 20
    assert 0 <= asked.waits.sum_s < asked.answers.sum_s
    half, most = (now.answer_time_s("query/sdf", q, since=before) for q in (0.5, 0.99))
    assert 0 < half <= most < servers.WAIT_S
    assert now.answer_time_s("query/sdf", 0.5, since=now) is None
    assert now.answer_time_s("query/nothing", 0.5) is None
    assert now.operations["query/metrics"].answered > 0


def test_scans_are_counted_by_source(client):
    points = servers.sphere()
    for source in ("front", "rear", "front"):
        client.publish_scan(points, np.eye(4), source=source)
    client.flush(servers.WAIT_S)
    metrics = client.metrics()
    assert metrics.scan_bytes_received > 3 * points.nbytes
    taken = {name: source.taken for name, source in metrics.sources.items()}
    assert taken == {"front": 2, "rear": 1}
    assert 0 <= metrics.sources["rear"].age_s < servers.WAIT_S


def test_memory_and_time_are_told_by_part(client):
    servers.learn_all(client)
    client.mesh()
    metrics = client.metrics()
    assert metrics.resident_bytes > 2**20
    assert metrics.mapper_s["training"] > 0
    assert metrics.mapper_s["scans"] > 0
    assert sum(metrics.mapper_s.values()) == pytest.approx(metrics.uptime_s, abs=1)
    assert metrics.problem is None


def test_connected_clients_are_listed(client, endpoint):
    before = client.metrics().sessions
    with triquad_client.connect(endpoint) as other:
        assert len(other.metrics().sessions) == len(before) + 1
        assert set(other.metrics().sessions.values()) == {"client"}


def test_checkpoints_are_counted_and_timed(tmp_path):
    with servers.service_and_client(store=tmp_path) as client:
        before = client.metrics().checkpoints
        assert (before.written, before.last_duration_s, before.age_s) == (0, None, None)
        servers.learn(client)
        client.checkpoint()
        now = client.metrics().checkpoints
        assert (now.written, now.failed) == (1, 0)
        assert now.last_duration_s > 0
        assert now.age_s >= 0
