"""Who wants the server's memory does not get it: real processes, measured by the system."""

from collections.abc import Iterator

import numpy as np
import pytest
import triquad_client
from support import servers
from support.poses import shifted
from support.servers import RawPeer, ServerProcess
from triquad_format.wire import codec, keys

MAP_BYTES = 200_000_000
EPOCHS_BYTES = 50_000_000
BESIDE = 250_000_000  # for code that is compiled late, replay samples and what is in between
SPHERES, POINTS, RADIUS_M = 6, 40_000, 30.0


@pytest.fixture(scope="module")
def server() -> Iterator[ServerProcess]:
    limits = [f"memory.max_bytes={MAP_BYTES}", f"memory.epochs_bytes={EPOCHS_BYTES}"]
    arguments = [text for limit in limits for text in ("--set", limit)]
    with servers.server_process(arguments) as process:
        yield process


def test_spheres_all_around_fill_the_map_and_no_more(server: ServerProcess) -> None:
    rng = np.random.default_rng(0)
    before = server.resident_bytes
    with triquad_client.connect(server.endpoint) as client:
        for number in range(SPHERES):
            directions = rng.normal(size=(POINTS, 3))
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            points = (RADIUS_M * directions).astype(np.float32)
            client.publish_scan(points, shifted(20.0 * number), source="liar")
            report = client.flush(servers.WAIT_S)
        grown = server.resident_bytes - before
        print(f"grown by {grown / 1e6:.0f} MB")
        assert grown < MAP_BYTES + EPOCHS_BYTES + BESIDE
        status = client.status()
        assert status.scans_dropped["map_full"] == report.refused > 0
        assert "map_full" not in str(status.warnings)
        assert "memory.max_bytes" in str(report.last_refusal)
        print(f"map {status.map_bytes / 1e6:.0f} MB, {report}")
        assert 0 < status.map_bytes <= status.map_max_bytes == MAP_BYTES
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
