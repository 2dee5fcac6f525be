"""Who wants the server's memory does not get it: real processes, measured by the system."""

from collections.abc import Iterator

import numpy as np
import pytest
import triquad_client
from support import servers
from support.poses import shifted
from support.servers import RawPeer, ServerProcess
from triquad_format.wire import codec, keys

MOST_BYTES = 550_000_000
SPHERES, POINTS, RADIUS_M = 6, 40_000, 30.0


@pytest.fixture(scope="module")
def server() -> Iterator[ServerProcess]:
    with servers.server_process(["--set", f"memory.max_bytes={MOST_BYTES}"]) as process:
        yield process


def test_spheres_all_around_fill_the_map_and_no_more(server: ServerProcess) -> None:
    rng = np.random.default_rng(0)
    with triquad_client.connect(server.endpoint) as client:
        for number in range(SPHERES):
            directions = rng.normal(size=(POINTS, 3))
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            points = (RADIUS_M * directions).astype(np.float32)
            client.publish_scan(points, shifted(20.0 * number), source="liar")
            report = client.flush(servers.WAIT_S)
        assert server.resident_bytes < MOST_BYTES
        status = client.status()
        assert status.scans_dropped["map_full"] == report.refused > 0
        assert "map_full" not in str(status.warnings)
        assert "memory.max_bytes" in str(report.last_refusal)
        print(f"map {status.map_bytes / 1e6:.0f} MB, {report}")
        assert 0 < status.map_bytes < status.map_max_bytes == MOST_BYTES
        parts = status.memory_parts
        assert parts["map"] == status.map_bytes
        assert parts["program"] > 100_000_000
        assert sum(parts.values()) == pytest.approx(status.memory_bytes, rel=0.2)
        assert client.query_distance(np.zeros((10, 3)), max_distance_m=1.0).epoch > 0
        client.publish_scan(servers.sphere(500, 10.0), np.eye(4), source="honest")
        assert client.flush(servers.WAIT_S).taken >= 1, "what is small still finds room"


def test_junk_in_a_request_for_tiles_is_refused(server: ServerProcess) -> None:
    body = codec.encode(servers.tile_changes())
    assert body[0] == 0xDE or body[0] & 0xF0 == 0x80
    junk = b"\xa1j\xc6" + (12_000_000).to_bytes(4, "big") + bytes(12_000_000)
    fields = body[0] & 0x0F
    payload = bytes([0x80 | (fields + 1)]) + body[1:] + junk
    with servers.raw_session(connect=server.endpoint) as session:
        assert RawPeer(session).refusal(keys.TILE_CHANGES, payload) == "too_large"
