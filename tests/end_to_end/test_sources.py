"""Where sources have been and what they see, asked by the real client over the loopback."""

import numpy as np
from support import servers
from triquad_client import Client, SourceReport


def pose(x: float, y: float = 0.0) -> np.ndarray:
    """A sensor that looks along the y axis."""
    return np.array([[0, -1, 0, x], [1, 0, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)


def drive(client: Client, xs: "list[float]", source: str = "lidar", y: float = 0.0) -> None:
    """Scans of a sphere around the sensor, which is at each of ``xs`` in turn."""
    for x in xs:
        client.publish_scan(servers.sphere(500), pose(x, y), source=source)
    client.flush(servers.WAIT_S)


def trail(report: SourceReport, source: str = "lidar") -> list[float]:
    """The x of each position of a trail."""
    return report.sources[source].trail[:, 0].tolist()


def test_a_program_follows_the_sources_with_the_report_before(client):
    report = client.sources()
    assert report.sources == {}
    drive(client, [1, 2, 3])
    first = client.sources(report)
    assert trail(first) == [1, 2, 3]
    drive(client, [4, 5])
    drive(client, [7, 8], source="camera", y=3)
    report = client.sources(first)
    assert trail(report) == [1, 2, 3, 4, 5]
    assert trail(report, "camera") == [7, 8]
    assert trail(first) == [1, 2, 3]  # what a program holds stays as it is
    assert {name: source.scans for name, source in report.sources.items()} == {
        "lidar": 5,
        "camera": 2,
    }
    assert trail(client.sources()) == trail(report)  # the same as all at once


def test_the_newest_scan_lies_in_the_map_frame(client):
    client.publish_scan(servers.sphere(500), pose(1.0), stamp_s=10.0, source="lidar")
    client.publish_scan(servers.sphere(500), pose(9000.0, -7), stamp_s=12.5, source="lidar")
    client.flush(servers.WAIT_S)
    newest = client.sources().sources["lidar"].newest
    assert newest.stamp_ns == 12_500_000_000
    np.testing.assert_array_equal(newest.world_from_sensor, pose(9000.0, -7))
    np.testing.assert_array_equal(newest.position_m, [9000, -7, 0])
    assert len(newest.points) == newest.points_used
    sent = servers.sphere(500) @ pose(9000.0, -7)[:3, :3].T + (9000.0, -7, 0)
    apart = np.linalg.norm(newest.points[:, None] - sent, axis=2).min(axis=1)
    assert apart.max() < 1e-5
