"""Robots with ROS 2 and a server, over Zenoh: clouds and poses in, a map to ask."""

import logging

import numpy as np
import pytest
from support import servers
from support.ros_messages import CLOUD
from support.ros_robot import T0, robot, shifted
from support.ros_server import AT, MAST, accounted, serving, stand, until
from triquad_client import Client, ServerStatus, Status
from triquad_server.ros2.intake import silence
from triquad_server.settings import SourceSettings

WAYS = ["rmw", "bridge"]


def finds_sphere(client: Client, centre: tuple[float, float, float]) -> bool:
    """Whether the map has the sphere that the lidar sees around it."""
    until(client, lambda status: status.settled)
    answer = client.query_sdf(np.array(centre) + servers.sphere(500))
    is_surface = answer.status == Status.SURFACE
    return bool(is_surface.mean() > 0.95 and np.abs(answer.sdf).mean() < 0.1)


@pytest.mark.parametrize(("way", "mode"), [("rmw", "peer"), ("bridge", "client")])
def test_clouds_and_transforms_become_a_map(way: str, mode: str) -> None:
    with serving() as (endpoint, client), robot(endpoint, way, mode) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(r2, 0, 1)
        for number in range(4):
            r2.cloud(0.2 * number + 0.1, servers.sphere())
        status = until(client, lambda status: accounted(status) == 4)
        assert status.scans_taken == 4, status
        assert finds_sphere(client, (AT[0], AT[1], AT[2] + 0.5))


def test_clouds_wait_for_their_transforms_and_stay_in_order() -> None:
    with serving(waiting_s=30.0) as (endpoint, client), robot(endpoint) as r2:
        for number in range(4):
            r2.cloud(0.2 * number + 0.1, servers.sphere())
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        for second in (1, 0):  # the later pose before the earlier one, and both after the clouds
            r2.tf(second, ("odom", "base_link", shifted(*AT)))
        # Last, and on the same topic: only there messages keep their order for sure.
        for second in (0, 1):
            r2.tf(second, ("map", "odom", shifted()))
        status = until(client, lambda status: accounted(status) == 4)
        assert (status.scans_taken, status.scans_lost) == (4, {}), status


def test_what_cannot_be_placed_is_counted_by_its_reason(caplog: pytest.LogCaptureFixture) -> None:
    with serving(waiting_s=0.2) as (endpoint, client), robot(endpoint) as r2:
        r2.cloud(0, servers.sphere())
        until(client, lambda status: status.scans_dropped.get("no_transform") == 1)
        stand(r2, 10, 10.1, 20)
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        for second in (5, 15, 25):
            r2.cloud(second, servers.sphere())
        status = until(client, lambda status: accounted(status) == 4)
    assert status.scans_dropped == {
        "no_transform": 1,
        "pose_early": 1,
        "pose_gap": 1,
        "pose_late": 1,
    }
    assert status.scans_lost == {}
    assert "/points: 1 lost, no_transform: " in caplog.text
    assert "set ros2.clock" in caplog.text


def test_clouds_that_are_no_scans_are_refused_with_the_reason(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with serving() as (endpoint, client), robot(endpoint) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(r2, 0, 1)
        flat = r2.messages.cloud(servers.sphere(10), T0)
        flat.fields = flat.fields[:2]
        r2.send("/points", CLOUD, flat)
        r2.cloud(0.1, servers.sphere(), topic="/registered", frame="map")
        r2.cloud(0.1, np.full((10, 3), np.nan), topic="/empty")
        r2.wire.publish("/points", CLOUD, b"\0\1\0\0 no cloud")
        status = until(client, lambda status: accounted(status) == 4)
        r2.cloud(0.2, servers.sphere())
        until(client, lambda status: status.scans_taken == 1)
    assert status.scans_dropped == {
        "no_xyz": 1,
        "registered": 1,
        "empty": 1,
        "decode": 1,
    }
    assert "the cloud has no field z" in caplog.text


def test_only_chosen_topics_are_mapped_and_others_are_named(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(silence, "AFTER_S", 1.0)
    caplog.set_level(logging.INFO)
    with serving(clouds=["/front/points"]) as (endpoint, client), robot(endpoint) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(r2, 0, 1)
        r2.cloud(0.1, servers.sphere(), topic="/rear/points")
        until(client, lambda _: "wanted are /front/points" in caplog.text)
        assert "/rear/points (sensor_msgs/msg/PointCloud2)" in caplog.text
        r2.cloud(0.2, servers.sphere(), topic="/front/points")
        status = until(client, lambda status: accounted(status) == 1)
        assert status.scans_taken == 1
        assert client.flush().taken == 0  # nothing of the client's own


@pytest.mark.parametrize("way", WAYS)
def test_sensors_are_sources_of_their_own(way: str) -> None:
    box = {"lidar.front": SourceSettings(range_max_m=2.0), "rear": SourceSettings()}
    with serving(sources=box) as (endpoint, client), robot(endpoint, way) as r2:
        r2.tf(0, ("base_link", "front", shifted(x=5)), static=True)
        r2.tf(0, ("base_link", "rear", shifted(x=-5)), static=True)
        stand(r2, 0, 1)
        for number in range(3):
            r2.cloud(0.1 * number, servers.sphere(), topic="/lidar/front", frame="front")
            r2.cloud(0.1 * number, servers.sphere(), topic="/rear", frame="rear")
        status = until(client, lambda status: accounted(status) == 6)
        assert status.scans_taken == 6, status
        assert finds_sphere(client, (AT[0] - 5, AT[1], AT[2]))
        # Of the front one, all lies beyond the range that its own section sets.
        assert not finds_sphere(client, (AT[0] + 5, AT[1], AT[2]))
        seen = client.sources().sources
        assert seen["rear"].trail.tolist() == [[AT[0] - 5, AT[1], AT[2]]]
        assert seen["lidar.front"].trail.tolist() == [[AT[0] + 5, AT[1], AT[2]]]
        assert len(seen["lidar.front"].newest.points) == 0 < len(seen["rear"].newest.points)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", ["odometry", "pose"])
def test_poses_come_from_a_topic(kind: str, way: str) -> None:
    topic = {"odometry": "/odom", "pose": "/pose"}[kind]
    frames = {"map_frame": {"odometry": "/odom", "pose": "/map"}[kind], "body_frame": "/body"}
    with serving(poses=topic, **frames) as (endpoint, client), robot(endpoint, way) as r2:
        r2.tf(0, ("body", "lidar", MAST), static=True)
        for second in (0, 1):
            # What transforms say of the body does not count then.
            r2.tf(second, ("map", "body", shifted(x=99)))
            if kind == "odometry":
                r2.odometry(second, shifted(*AT), "body")
            else:
                r2.pose(second, shifted(*AT))
        r2.cloud(0.5, servers.sphere())
        until(client, lambda status: status.scans_taken == 1)
        assert finds_sphere(client, (AT[0], AT[1], AT[2] + 0.5))


@pytest.mark.parametrize(
    ("way", "options"), [("rmw", {}), ("bridge", {}), ("bridge", {"old": True})]
)
def test_a_server_that_starts_late_learns_the_static_transforms(
    way: str, options: dict[str, bool]
) -> None:
    router = servers.free_endpoint()
    with servers.raw_session("router", listen=router), robot(router, way, **options) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        with serving(connect=(router,)) as (_, client):
            stand(r2, 0, 1)
            r2.cloud(0.5, servers.sphere())
            status = until(client, lambda status: accounted(status) == 1)
            assert status.scans_taken == 1, status


def test_depth_images_are_mapped_with_the_camera_beside_them() -> None:
    matrix = np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]])
    forward = shifted(*AT)
    forward[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # the optical axis is the map's x
    wall = np.full((120, 160), 3000, np.uint16)
    with serving(depth=["/camera/depth"]) as (endpoint, client), robot(endpoint) as r2:
        for second in (0, 1):
            r2.tf(second, ("map", "optical", forward))
        r2.depth(0.1, wall)
        until(client, lambda status: status.scans_dropped == {"no_camera_info": 1})
        # The camera publishes what it sees as a cloud too, which nobody chose.
        r2.cloud(0.1, np.zeros((10, 3)), topic="/camera/points", frame="map")
        r2.camera(0.2, wall.shape, matrix)
        times = (0.2 + number / 1000 for number in range(800))

        def is_mapped(status: ServerStatus) -> bool:
            if status.scans_taken == 0:  # the camera may be heard of later than an image
                r2.depth(next(times), wall)
            return status.scans_taken > 0 and status.settled

        until(client, is_mapped)
        at_wall = np.array([[AT[0] + 3, AT[1] + y, AT[2] + z] for y in (-1, 0, 1) for z in (-1, 1)])
        assert (client.query_sdf(at_wall).status == Status.SURFACE).all()
        assert client.status().scans_dropped.keys() == {"no_camera_info"}


def test_other_domains_and_namespaces_are_not_heard() -> None:
    ours: list[tuple[str, dict[str, object]]] = [
        ("rmw", {"domain": 7, "namespace": "/robot1"}),
        ("bridge", {"namespace": "robot1"}),
    ]
    others: list[tuple[str, dict[str, object]]] = [
        ("rmw", {"domain": 0, "namespace": "/robot1"}),
        ("rmw", {"domain": 7}),
        ("bridge", {}),
    ]
    with serving(domain=7, namespace="/robot1") as (endpoint, client):
        for way, options in [*others, *ours]:
            with robot(endpoint, way, **options) as r2:
                r2.tf(0, ("base_link", "lidar", MAST), static=True)
                stand(r2, 0, 1)
                r2.cloud(0.5, servers.sphere())
        status = until(client, lambda status: accounted(status) == 2)
        assert (status.scans_taken, status.scans_dropped) == (2, {}), status


def test_clouds_that_wait_are_bounded_and_all_accounted_for() -> None:
    with serving(waiting_clouds=3, waiting_s=60.0) as (endpoint, client), robot(endpoint) as r2:
        for number in range(10):
            r2.cloud(0.1 * number, servers.sphere(), topic=f"/lidar{number % 2}")
        until(client, lambda status: status.scans_dropped == {"no_transform": 7})
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(r2, 0, 1)
        status = until(client, lambda status: accounted(status) == 10)
        assert (status.scans_taken, status.scans_lost) == (3, {}), status


def test_clouds_that_the_network_lost_are_counted() -> None:
    with serving() as (endpoint, client), robot(endpoint) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(r2, 0, 1)
        r2.cloud(0.1, servers.sphere())
        r2.wire.skip("/points", 2)
        r2.cloud(0.4, servers.sphere())
        status = until(client, lambda status: status.scans_taken == 2)
        assert status.scans_dropped == {"not_received": 2}


def test_a_better_frame_that_turns_up_late_is_named(caplog: pytest.LogCaptureFixture) -> None:
    with serving() as (endpoint, client), robot(endpoint) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        for second in (0, 1):
            r2.tf(second, ("odom", "base_link", shifted(*AT)))
        r2.cloud(0.5, servers.sphere())
        until(client, lambda status: status.scans_taken == 1)
        r2.tf(0, ("map", "odom", shifted(x=99)), static=True)
        for taken in range(2, 30):  # the transform may come after the first clouds
            r2.cloud(0.5 + 0.01 * taken, servers.sphere())
            until(client, lambda status, taken=taken: status.scans_taken == taken)
            if "set ros2.map_frame" in caplog.text:
                break
        assert finds_sphere(client, (AT[0], AT[1], AT[2] + 0.5))
    assert 'set ros2.map_frame = "map"' in caplog.text


def test_tokens_with_impossible_names_stop_nothing() -> None:
    with serving() as (endpoint, client), robot(endpoint, "bridge") as r2:
        cloud = "sensor_msgs§msg§PointCloud2"
        dds = "sensor_msgs::msg::dds_::PointCloud2_"
        for token in (
            f"@/x/@ros2_lv/MP/§§/{cloud}/q",
            f"@/x/@ros2_lv/MP/a§§b/{cloud}/q",
            f"@ros2_lv/0/x/0/1/MP/%/%/n/%%/{dds}/RIHS01_0/q",
            f"@ros2_lv/0/x/0/1/MP/%/%/n/%a/{dds}/%/q",
            "@ros2_lv/0/x/0/1/MP/%/%/n/%a/no_type/RIHS01_0/q",
        ):
            r2.session.liveliness().declare_token(token)
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(r2, 0, 1)
        r2.cloud(0.5, servers.sphere())
        until(client, lambda status: status.scans_taken == 1)


def test_a_server_started_with_the_flag_says_what_it_maps() -> None:
    with (
        servers.server_process(["--ros2", "--settings", "/dev/null"]) as server,
        robot(server.endpoint) as r2,
    ):
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(r2, 0, 1)
        r2.cloud(0.5, servers.sphere())
        server.wait_for("ros2: mapping in the frame 'map'")
        assert "ros2: listening in domain 0" in server.log
        assert "ros2: found /points (sensor_msgs/msg/PointCloud2)" in server.log
        server.process.terminate()
        assert server.wait() == 0
