"""Where sources have been and what they see, asked by the real client over the loopback."""

import logging

import numpy as np
import pytest
import triquad_client
from support import servers
from triquad_client import Client, FlushReport, InvalidInputError, NoReplyError, SourceReport
from triquad_format.records.arrays import Doubles

BOX = ((2.5, -1, -1), (3.5, 1, 1))


def pose(x: float, y: float = 0.0) -> Doubles:
    """A sensor that looks along the y axis."""
    return np.array([[0, -1, 0, x], [1, 0, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)


def drive(client: Client, xs: list[float], source: str = "lidar", y: float = 0.0) -> None:
    """Take scans of a sphere around the sensor, which is at each of ``xs`` in turn."""
    for x in xs:
        client.publish_scan(servers.sphere(500), pose(x, y), source=source)
    client.flush(servers.WAIT_S)


def trail(report: SourceReport, source: str = "lidar") -> list[float]:
    """The x of each position of a trail."""
    return report.sources[source].trail[:, 0].tolist()


def lines(report: SourceReport, source: str = "lidar") -> list[list[float]]:
    """The x along each line of a trail."""
    return [line[:, 0].tolist() for line in report.sources[source].lines()]


def test_a_program_follows_the_sources_with_the_report_before(client):
    report = client.sources()
    assert report.sources == {}
    drive(client, [1, 2, 3])
    first = client.sources(report)
    assert trail(first) == [1, 2, 3]
    drive(client, [4, 5])
    drive(client, [7, 8], source="camera", y=3)
    report = client.sources(since=first)
    assert trail(report) == [1, 2, 3, 4, 5]
    assert trail(report, "camera") == [7, 8]
    assert trail(first) == [1, 2, 3]  # what a program holds stays as it is
    scans = {name: source.scans for name, source in report.sources.items()}
    assert scans == {"lidar": 5, "camera": 2}
    at_once = client.sources()
    assert (trail(at_once), trail(at_once, "camera")) == ([1, 2, 3, 4, 5], [7, 8])
    assert client.sources(report) is report


def test_the_newest_scan_lies_in_the_map_frame(client):
    client.publish_scan(servers.sphere(500), pose(1.0), stamp_s=10.0)
    client.publish_scan(servers.sphere(500), pose(9000.0, -7), stamp_s=12.5)
    client.flush(servers.WAIT_S)
    newest = client.sources().sources["default"].newest
    assert newest.stamp_ns == 12_500_000_000
    np.testing.assert_array_equal(newest.world_from_sensor, pose(9000.0, -7))
    np.testing.assert_array_equal(newest.position_m, [9000, -7, 0])
    assert 0 < len(newest.points) == newest.points_used <= 500
    sent = servers.sphere(500) @ pose(9000.0, -7)[:3, :3].T + (9000.0, -7, 0)
    apart = np.linalg.norm(newest.points_m[:, None] - sent, axis=2).min(axis=1)
    assert apart.max() < 1e-5
    some = client.sources(max_points=100).sources["default"].newest
    assert len(np.unique(some.points, axis=0)) == len(some.points) == 100
    assert client.sources(max_points=0).sources["default"].newest.points.shape == (0, 3)


def test_refused_scans_leave_no_trace(client):
    drive(client, [1])
    before = client.sources()
    client.publish_scan(servers.sphere(50, radius_m=0.5), pose(2), source="lidar")  # too near
    client.publish_scan(servers.sphere(50), pose(200_000), source="lidar")
    client.publish_scan(servers.sphere(50), pose(200_000), source="elsewhere")
    assert client.flush(servers.WAIT_S).refused == 3
    after = client.sources(before)
    assert after.revision == before.revision
    assert (list(after.sources), trail(after)) == (["lidar"], [1])


def test_a_sensor_that_stands_adds_nothing_but_its_newest_scan(client):
    drive(client, [1, 1.05, 1.1, 1.05])
    report = client.sources()
    assert trail(report) == [1]
    assert lines(report) == [[1, 1.05]]
    assert report.sources["lidar"].scans == 4


def test_no_line_is_drawn_where_a_sensor_jumped(client, endpoint):
    drive(client, [1, 2])
    before = client.sources()
    drive(client, [60, 61])
    with triquad_client.connect(endpoint) as later:  # whose clock may be an earlier one
        later.publish_scan(servers.sphere(500), pose(62), stamp_s=5.0, source="lidar")
        later.flush(servers.WAIT_S)
        later.publish_scan(servers.sphere(500), pose(3), stamp_s=6.0, source="lidar")
        later.flush(servers.WAIT_S)
    for report in (client.sources(), client.sources(before)):
        assert lines(report) == [[1, 2], [60, 61, 62], [3, 3]]
        assert report.sources["lidar"].newest.stamp_ns == 6_000_000_000


def test_what_a_reset_forgets_leaves_the_trail(client):
    drive(client, [1, 2, 3, 4, 5])
    drive(client, [3], source="camera")
    before = client.sources()
    client.reset(BOX)
    for report in (client.sources(), client.sources(before)):
        assert list(report.sources) == ["lidar"]
        assert lines(report) == [[1, 2], [4, 5, 5]]
    drive(client, [6, 3])
    client.reset(BOX)
    forgotten = client.sources(before)
    assert forgotten.sources["lidar"].newest is None
    assert lines(forgotten) == [[1, 2], [4, 5, 6]]
    drive(client, [7])
    assert lines(client.sources(forgotten)) == [[1, 2], [4, 5, 6], [7, 7]]
    client.reset()
    assert client.sources(forgotten).sources == {}
    drive(client, [8])
    assert lines(client.sources(forgotten)) == [[8, 8]]


def test_after_a_restart_everything_is_anew(tmp_path):
    with servers.service_and_client(store=tmp_path) as client:
        drive(client, [1, 2, 3])
        before = client.sources()
        client.checkpoint()
    with servers.service_and_client(store=tmp_path) as client:
        empty = client.sources(before)
        assert empty.sources == {}
        assert empty.server != before.server
        drive(client, [4, 5])
        assert trail(client.sources(before)) == trail(client.sources(empty)) == [4, 5]


def test_what_cannot_be_asked_is_refused(client):
    drive(client, [1])
    for bad in (-1, 10_001, 1.5, "many", True, None):
        with pytest.raises(InvalidInputError, match="max_points = "):
            client.sources(max_points=bad)
    for bad in (1, "since", {}):
        with pytest.raises(InvalidInputError, match="since = "):
            client.sources(since=bad)

    report = client.sources()
    for revision in (-(2**63), -1, 99, 2**63 - 1):
        assert trail(client.sources(SourceReport(report.server, revision, {}))) == [1]


def test_a_server_that_does_not_know_the_question_is_told_apart():
    with (
        servers.answering({}) as endpoint,
        triquad_client.connect(endpoint) as client,
        pytest.raises(NoReplyError, match="older than this question"),
    ):
        client.sources()


def half_near() -> np.ndarray:
    return np.concatenate([servers.sphere(500, 1.0), servers.sphere(500, 6.0)])


def test_a_publisher_learns_what_a_setting_takes_of_its_scans_and_is_told_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with servers.service_and_client() as client, caplog.at_level(logging.WARNING):
        reports: list[FlushReport] = []
        for _ in range(2):
            for _ in range(12):
                client.publish_scan(half_near(), np.eye(4), source="cam")
            reports.append(client.flush(servers.WAIT_S))
        status = client.status()
    (text,) = reports[0].warnings
    assert text.startswith("source 'cam': range_min_m = 1.5 drops 50 % of its points: set ")
    assert reports[1].warnings == (text,)
    assert status.warnings == (text,)
    assert status.scans_taken == 24
    for logger in ("triquad_client", "triquad_server.intake.scan_warnings"):
        assert [r.getMessage() for r in caplog.records if r.name == logger] == [text]
