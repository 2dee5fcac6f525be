"""Robots with ROS 2, the bridge and a server, over Zenoh: clouds and poses in, a map to ask."""

import logging
from collections.abc import Iterator

import numpy as np
import pytest
from support import servers
from support.poses import shifted
from support.ros.ros_bridge import AT, MAST, Bridged, bridging, stand
from support.ros.ros_robot import T0, robot, stamp
from support.ros_messages import CLOUD, PATH
from triquad_client import Client, Status
from triquad_server.settings import SourceSettings
from triquad_tools.ros2.intake import drop_log, intake


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """A server with a source that sees 2 m far, which other tests do not use."""
    sources = {"lidar.near": SourceSettings(range_max_m=2.0)}
    settings = servers.SMALL.model_copy(update={"sources": sources})
    with servers.running_service(settings) as endpoint:
        yield endpoint


def finds_sphere(client: Client, centre: tuple[float, float, float]) -> bool:
    """Whether the map has the sphere that the lidar sees around it."""
    client.settle(servers.WAIT_S)
    answer = client.query_sdf(np.array(centre) + servers.sphere(500))
    is_surface = answer.status == Status.SURFACE
    return bool(is_surface.mean() > 0.95 and np.abs(answer.sdf).mean() < 0.1)


def finds_its_sphere(bridged: Bridged) -> bool:
    """Whether the map has the sphere around the lidar on its mast."""
    bridged.settle()
    return finds_sphere(bridged.client, (AT[0], AT[1], AT[2] + 0.5))


@pytest.mark.parametrize(("way", "mode"), [("rmw", "peer"), ("bridge", "client")])
def test_clouds_and_transforms_become_a_map(endpoint: str, way: str, mode: str) -> None:
    with bridging(endpoint) as bridged, robot(endpoint, way, mode) as r2:
        stand(r2, 0, 1)
        for number in range(4):
            r2.cloud(0.2 * number + 0.1, servers.sphere())
        bridged.wait_for(lambda: bridged.accounted == 4)
        assert (bridged.taken, bridged.bridge.published) == (4, 4), bridged.bridge.dropped
        newest = bridged.client.sources().sources["points"].newest
        np.testing.assert_allclose(newest.position_m, (AT[0], AT[1], AT[2] + 0.5), atol=1e-6)
        apart = np.linalg.norm(newest.points[:, None] - servers.sphere(), axis=2).min(axis=1)
        assert apart.max() < 1e-3, "the server has the points that the robot sent"
        assert finds_its_sphere(bridged)


def test_rays_from_elsewhere_are_refused(endpoint: str, caplog: pytest.LogCaptureFixture) -> None:
    points = np.concatenate([servers.sphere(), 2 * servers.sphere()])
    with bridging(endpoint) as bridged, robot(endpoint) as r2:
        stand(r2, 0, 1)
        r2.cloud(0.1, points)
        bridged.wait_for(lambda: bridged.bridge.dropped == {"ray_origin": 1})
    assert "/points: 1 dropped, ray_origin: 50% of the points lie behind others" in caplog.text
    assert "--ray-origin TOPIC=X,Y,Z says where the sensor sits" in caplog.text
    with bridging(endpoint, "--ray-origin", "/points=0,0,0.5") as bridged, robot(endpoint) as r2:
        stand(r2, 0, 1)
        r2.cloud(0.1, points)
        bridged.wait_for(lambda: bridged.taken == 1)
        newest = bridged.client.sources().sources["points"].newest
    np.testing.assert_allclose(newest.position_m, (AT[0], AT[1], AT[2] + 1.0), atol=1e-6)
    assert newest.points_m[:, 2].max() > AT[2] + 0.5 + servers.sphere()[:, 2].max()


def test_clouds_wait_for_their_transforms_and_stay_in_order(endpoint: str) -> None:
    with bridging(endpoint, "--wait-s", 30) as bridged, robot(endpoint) as r2:
        for number in range(4):
            r2.cloud(0.2 * number + 0.1, servers.sphere())
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        for second in (1, 0):  # the later pose before the earlier one, and both after the clouds
            r2.tf(second, ("odom", "base_link", shifted(*AT)))
        # Last, and on the same topic: only there messages keep their order for sure.
        for second in (0, 1):
            r2.tf(second, ("map", "odom", shifted()))
        bridged.wait_for(lambda: bridged.accounted == 4)
        assert (bridged.taken, bridged.lost) == (4, 0), bridged.bridge.dropped


def test_clouds_that_the_network_lost_are_counted(endpoint: str) -> None:
    with bridging(endpoint) as bridged, robot(endpoint) as r2:
        stand(r2, 0, 1)
        r2.cloud(0.1, servers.sphere())
        r2.wire.skip("/points", 2)
        r2.cloud(0.4, servers.sphere())
        bridged.wait_for(lambda: bridged.taken == 2)
        assert bridged.bridge.dropped == {"not_received": 2}


def test_clouds_that_are_no_scans_are_refused_with_the_reason(
    endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    with bridging(endpoint) as bridged, robot(endpoint) as r2:
        declare = r2.session.liveliness().declare_token
        kind = CLOUD.replace("/", "§")
        no_names = [declare(f"@/x/@ros2_lv/MP/{name}/{kind}/q") for name in ("§§", "a§§b", "%")]
        stand(r2, 0, 1)
        flat = r2.messages.cloud(servers.sphere(10), T0)
        flat.fields = flat.fields[:2]
        r2.send("/points", CLOUD, flat)
        r2.cloud(0.1, servers.sphere(), topic="/registered", frame="map")
        r2.cloud(0.1, np.full((10, 3), np.nan), topic="/empty")
        r2.wire.publish("/points", CLOUD, b"\0\1\0\0 no cloud")
        bridged.wait_for(lambda: bridged.accounted == 4)
        r2.cloud(0.2, servers.sphere())
        bridged.wait_for(lambda: bridged.taken == 1)
        reasons = ("no_xyz", "registered", "empty", "decode")
        assert bridged.bridge.dropped == dict.fromkeys(reasons, 1)
        del no_names
    assert "the cloud has no field z" in caplog.text


def test_two_that_publish_one_transform_are_told(
    endpoint: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(intake, "LOG_PERIOD_S", 0.1)
    with bridging(endpoint) as bridged, robot(endpoint) as r2:
        for number in range(60):
            r2.tf(0.1 * number, ("odom", "base_link", shifted(x=0.1 * number + number % 2)))
        bridged.wait_for(lambda: "odom from base_link jumps to and fro" in caplog.text)


def test_only_chosen_topics_are_mapped_and_others_are_named(
    endpoint: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drop_log, "AFTER_S", 1.0)
    caplog.set_level(logging.INFO)
    with robot(endpoint) as r2:
        r2.cloud(0.1, servers.sphere(), topic="/rear/points")  # so that it is found at once
        with bridging(endpoint, "--clouds", "/front/points") as bridged:
            stand(r2, 0, 1)
            r2.cloud(0.1, servers.sphere(), topic="/rear/points")
            bridged.wait_for(lambda: "wanted are /front/points" in caplog.text)
            assert "/rear/points (sensor_msgs/msg/PointCloud2)" in caplog.text
            r2.cloud(0.2, servers.sphere(), topic="/front/points")
            bridged.wait_for(lambda: bridged.accounted == 1)
            assert bridged.taken == 1


def test_sensors_are_sources_of_their_own(endpoint: str) -> None:
    with bridging(endpoint) as bridged, robot(endpoint) as r2:
        r2.tf(0, ("base_link", "front", shifted(x=5)), static=True)
        r2.tf(0, ("base_link", "rear", shifted(x=-5)), static=True)
        stand(r2, 0, 1)
        for number in range(3):
            r2.cloud(0.1 * number, servers.sphere(), topic="/lidar/near", frame="front")
            r2.cloud(0.1 * number, servers.sphere(), topic="/rear", frame="rear")
        bridged.wait_for(lambda: bridged.accounted == 6)
        assert bridged.taken == 6, bridged.bridge.dropped
        assert finds_sphere(bridged.client, (AT[0] - 5, AT[1], AT[2]))
        # Of the front one, all lies beyond the range that its own section sets.
        assert not finds_sphere(bridged.client, (AT[0] + 5, AT[1], AT[2]))
        seen = bridged.client.sources().sources
        assert seen["rear"].trail[-1].tolist() == [AT[0] - 5, AT[1], AT[2]]
        assert seen["lidar.near"].trail[-1].tolist() == [AT[0] + 5, AT[1], AT[2]]
        assert len(seen["lidar.near"].newest.points) == 0 < len(seen["rear"].newest.points)


@pytest.mark.parametrize("way", ["rmw", "bridge"])
def test_scans_of_livox_are_clouds_too(endpoint: str, way: str) -> None:
    kind = "livox_ros_driver2/msg/CustomMsg"
    with bridging(endpoint) as bridged, robot(endpoint, way) as r2:
        r2.tf(0, ("base_link", "livox", MAST), static=True)
        stand(r2, 0, 1)
        points = servers.sphere()
        offsets_ns = np.linspace(0, 1e8, len(points))

        def send(number: int) -> None:
            message = r2.messages.livox(points, offsets_ns, stamp(0.5) + number, kind)
            r2.send("/livox/lidar", kind, message)

        bridged.send_until(send, lambda: bridged.taken > 0)
        assert finds_its_sphere(bridged)


@pytest.mark.parametrize("frame", ["odom", "map", ""])
def test_a_rare_correction_stays_and_two_parents_are_refused(endpoint: str, frame: str) -> None:
    chosen = ("--map-frame", frame) if frame else ()
    with bridging(endpoint, *chosen) as bridged, robot(endpoint) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        r2.tf(0, ("map", "slam", shifted()))
        for second in range(8):
            r2.tf(second, ("odom", "base_link", shifted(*AT)), ("slam", "base_link", shifted(*AT)))
        r2.cloud(6.5, servers.sphere())
        bridged.wait_for(lambda: bridged.accounted == 1)
        assert bridged.bridge.dropped == ({} if frame else {"two_parents": 1})
        assert not frame or finds_its_sphere(bridged)


@pytest.mark.parametrize(
    ("topic", "frame", "way"),
    [
        ("/odom", "/odom", "rmw"),
        ("/pose", "/map", "bridge"),
        ("/path", "/map", "rmw"),
    ],
)
def test_poses_come_from_a_topic(endpoint: str, topic: str, frame: str, way: str) -> None:
    frames = ("--map-frame", frame, "--body-frame", "/body")
    with bridging(endpoint, "--poses", topic, *frames) as bridged, robot(endpoint, way) as r2:
        r2.tf(0, ("body", "lidar", MAST), static=True)
        for second in (0, 1):
            # What transforms say of the body does not count then.
            r2.tf(second, ("map", "body", shifted(x=99)))
            match topic:
                case "/odom":
                    r2.odometry(second, shifted(*AT), "body")
                case "/pose":
                    r2.pose(second, shifted(*AT))
                case "/path":
                    stamps = [stamp(each) for each in range(second + 1)]
                    path = r2.messages.path(stamps, [shifted(*AT)] * len(stamps), "map")
                    r2.send(topic, PATH, path)
        r2.cloud(0.5, servers.sphere())
        bridged.wait_for(lambda: bridged.taken == 1)
        assert finds_its_sphere(bridged)


@pytest.mark.parametrize(
    ("way", "options"), [("rmw", {}), ("bridge", {}), ("bridge", {"old": True})]
)
def test_a_bridge_that_starts_late_learns_the_static_transforms(
    endpoint: str, way: str, options: dict[str, bool]
) -> None:
    """At a router of the nodes' own, which the server has nothing to do with."""
    router = servers.free_endpoint()
    with servers.raw_session("router", listen=router), robot(router, way, **options) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        with bridging(endpoint, router=router) as bridged:
            for second in (0, 1):
                r2.tf(second, ("map", "base_link", shifted(*AT)))
            r2.cloud(0.5, servers.sphere())
            bridged.wait_for(lambda: bridged.accounted == 1)
            assert bridged.taken == 1, bridged.bridge.dropped


@pytest.mark.parametrize("topic", ["/camera/depth", "/camera/depth/compressedDepth"])
def test_depth_images_are_mapped_with_the_camera_next_to_them(endpoint: str, topic: str) -> None:
    matrix = np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]])
    forward = shifted(*AT)
    forward[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # the optical axis is the map's x
    wall = np.full((120, 160), 3000, np.uint16)
    with bridging(endpoint, "--depth", topic) as bridged, robot(endpoint) as r2:
        for second in (0, 1):
            r2.tf(second, ("map", "optical", forward))
        r2.depth(0.1, wall, topic)
        bridged.wait_for(lambda: bridged.bridge.dropped == {"no_camera_info": 1})
        # The camera publishes what it sees as a cloud too, which nobody chose.
        r2.cloud(0.1, np.zeros((10, 3)), topic="/camera/points", frame="map")
        r2.camera(0.2, wall.shape, matrix)
        bridged.send_until(
            lambda number: r2.depth(0.2 + number / 1000, wall, topic), lambda: bridged.taken > 0
        )
        bridged.settle()
        at_wall = np.array([[AT[0] + 3, AT[1] + y, AT[2] + z] for y in (-1, 0, 1) for z in (-1, 1)])
        assert (bridged.client.query_sdf(at_wall).status == Status.SURFACE).all()
        assert bridged.bridge.dropped.keys() == {"no_camera_info"}


def test_other_domains_and_namespaces_are_not_heard(endpoint: str) -> None:
    robots: list[tuple[str, dict[str, object]]] = [
        ("rmw", {"domain": 0, "namespace": "/robot1"}),
        ("rmw", {"domain": 7}),
        ("bridge", {}),
        ("rmw", {"domain": 7, "namespace": "/robot1"}),  # from here on they are ours
        ("bridge", {"namespace": "robot1"}),
    ]
    with bridging(endpoint, "--domain", 7, "--namespace", "/robot1") as bridged:
        for way, options in robots:
            with robot(endpoint, way, **options) as r2:
                stand(r2, 0, 1)
                r2.cloud(0.5, servers.sphere())
        bridged.wait_for(lambda: bridged.accounted == 2)
        assert (bridged.taken, bridged.bridge.dropped) == (2, {})


def test_a_better_frame_that_turns_up_late_is_named(
    endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    with bridging(endpoint) as bridged, robot(endpoint) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        for second in (0, 1):
            r2.tf(second, ("odom", "base_link", shifted(*AT)))
        r2.cloud(0.5, servers.sphere())
        bridged.wait_for(lambda: bridged.taken == 1)
        r2.tf(0, ("map", "odom", shifted(x=99)), static=True)
        bridged.send_until(
            lambda number: r2.cloud(0.5 + number / 1000, servers.sphere()),
            lambda: "--map-frame" in caplog.text,
        )
        assert finds_its_sphere(bridged)
    assert "use --map-frame map" in caplog.text
