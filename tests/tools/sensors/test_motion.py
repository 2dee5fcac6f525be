"""Where frames were, between the times at which robots said so."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp
from triquad_client.pose import Pose
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.placing import place
from triquad_tools.sensors.motion.track import STATIC, Track, Transform
from triquad_tools.sensors.sweep import NoTransformError, Sweep

SECOND = 10**9
T0 = 1_700_000_000 * SECOND


def random_pose(rng: np.random.Generator) -> Pose:
    quaternion = rng.normal(size=4)
    return Pose(rng.normal(size=3), quaternion / np.linalg.norm(quaternion))


STILL = Pose((0, 0, 0), (0, 0, 0, 1))


def edge(parent: str, child: str, stamp: int | None, pose: Pose = STILL) -> Transform:
    return Transform(parent, child, stamp, pose)


def tree(*edges: Transform) -> FrameTree:
    frames = FrameTree()
    for each in edges:
        frames.add(each)
    return frames


def at(*stamps: int) -> np.ndarray:
    return np.array(stamps, np.int64)


@given(seed=st.integers(0, 1000), count=st.integers(1, 12))
def test_a_track_goes_straight_and_turns_evenly(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = T0 + np.cumsum(rng.integers(1, SECOND, count))
    poses = [random_pose(rng) for _ in stamps]
    track = Track()
    for index in rng.permutation(count):  # in whatever order they come
        position, quaternion = map(
            np.asarray, (poses[index].position_m, poses[index].quaternion_xyzw)
        )
        track.add(int(stamps[index]), position, quaternion)
    times = rng.integers(stamps[0], stamps[-1] + 1, 20)
    found = track.poses(times)
    seconds = (stamps - T0) / 1e9
    for axis in range(3):
        column = [np.asarray(pose.position_m)[axis] for pose in poses]
        assert np.allclose(found[:, axis, 3], np.interp((times - T0) / 1e9, seconds, column))
    if count > 1:
        turns = Rotation.from_quat([np.asarray(pose.quaternion_xyzw) for pose in poses])
        assert np.allclose(
            found[:, :3, :3], Slerp(seconds, turns)((times - T0) / 1e9).as_matrix(), atol=1e-6
        )


def test_a_track_says_nothing_of_before_after_and_gaps() -> None:
    track = Track()
    with pytest.raises(NoTransformError, match="there are no poses"):
        track.poses(at(T0))
    here, upright = np.zeros(3), np.array([0, 0, 0, 1.0])
    for second in (0, 1, 5):
        track.add(T0 + second * SECOND, here, upright)
    for second, reason, late in (
        (-1, "pose_early", False),
        (3, "pose_gap", False),
        (6, "pose_late", True),
    ):
        with pytest.raises(NoTransformError) as caught:
            track.poses(at(T0 + second * SECOND))
        assert (caught.value.reason, caught.value.late) == (reason, late)
    assert track.poses(at(T0, T0 + SECOND, T0 + 5 * SECOND)).shape == (3, 4, 4)


@given(seed=st.integers(0, 1000))
def test_a_tree_composes_what_it_was_told(seed: int) -> None:
    rng = np.random.default_rng(seed)
    map_odom, odom_base, base_lidar, base_camera = (random_pose(rng) for _ in range(4))
    sensors = edge("base", "lidar", STATIC, base_lidar), edge("base", "camera", STATIC, base_camera)
    frames = tree(*sensors, edge("map", "odom", T0, map_odom), edge("odom", "base", T0, odom_base))
    expected = map_odom.matrix() @ odom_base.matrix() @ base_lidar.matrix()
    assert np.allclose(frames.poses("map", "lidar", at(T0))[0], expected)
    across = np.linalg.inv(base_camera.matrix()) @ base_lidar.matrix()
    assert np.allclose(frames.poses("camera", "lidar", at(T0))[0], across)
    assert np.allclose(frames.poses("lidar", "camera", at(T0))[0], np.linalg.inv(across))
    assert np.allclose(frames.poses("lidar", "lidar", at(T0)), np.eye(4))


def test_a_tree_names_the_frame_to_map_in() -> None:
    frames = tree(edge("odom", "base", T0), edge("base", "lidar", STATIC))
    assert frames.fixed_frame("lidar") == "odom"
    frames.add(edge("map", "odom", T0))
    frames.add(edge("earth", "map", STATIC))
    assert frames.fixed_frame("lidar") == "map"
    assert frames.fixed_frame("alone") == "alone"


def test_a_tree_says_what_is_missing() -> None:
    frames = tree(edge("odom", "base", T0), edge("ceiling", "camera", STATIC))
    for target, frame, words in (
        ("odom", "lidar", "no transform names the frame 'lidar' (known: base, camera"),
        ("map", "base", "no transform names the map frame 'map': base is in odom"),
        ("odom", "camera", "camera is in ceiling and odom in odom"),
    ):
        with pytest.raises(NoTransformError) as caught:
            frames.poses(target, frame, at(T0))
        assert words in str(caught.value)
        assert caught.value.late
    with pytest.raises(NoTransformError, match="odom from base: 3 s after the last pose"):
        frames.poses("odom", "base", at(T0 + 3 * SECOND))


def test_frames_that_hang_on_each_other_do_no_harm() -> None:
    frames = tree(edge("a", "b", STATIC), edge("b", "a", STATIC), edge("a", "a", STATIC))
    with pytest.raises(NoTransformError):
        frames.poses("c", "a", at(T0))


def at_x(x: float) -> Pose:
    return Pose((x, 0, 0), (0, 0, 0, 1))


def test_a_rare_correction_stays_or_moves_evenly_and_odometry_does_not() -> None:
    times = [T0 + i * SECOND // 5 for i in range(100)]
    frames = tree(*(edge("odom", "base", t, at_x((t - T0) / 1e9)) for t in times))
    for second, x in ((0, 0.0), (5, 0.2), (10, 3.2)):
        frames.add(edge("map", "odom", T0 + second * SECOND, at_x(x)))

    def correction(*seconds: float) -> list[float]:
        stamps = at(*(T0 + round(each * SECOND) for each in seconds))
        return (frames.poses("map", "base", stamps)[:, 0, 3] - seconds).round(6).tolist()

    # By drift, evenly; by a loop, only when it is told; and after the last it stays.
    assert correction(0, 2.5, 5, 7.5, 10, 19) == [0, 0.1, 0.2, 0.2, 3.2, 3.2]
    assert frames.corrections("map", "base")[0].startswith("map from odom comes up to 5.0 s apart")
    with pytest.raises(NoTransformError, match="odom from base: .* after the last pose"):
        correction(25)
    frames.add(edge("odom", "base", T0 + 24 * SECOND))
    with pytest.raises(NoTransformError, match="odom from base: between two poses"):
        correction(22)
    alone = tree(*(edge("map", "base", T0 + n * 5 * SECOND, at_x(n)) for n in range(3)))
    with pytest.raises(NoTransformError, match="between two poses"):
        alone.poses("map", "base", at(T0 + SECOND))


def test_of_two_parents_the_one_that_is_wanted_counts() -> None:
    for limit in (None, 100):
        frames = FrameTree(limit)
        for n in range(10):
            frames.add(edge("odom", "base", T0 + n * SECOND, at_x(n)))
            frames.add(edge("map", "base", T0 + n * SECOND, at_x(-n)))
        with pytest.raises(NoTransformError) as caught:
            frames.poses("map", "base", at(T0))
        assert (caught.value.reason, caught.value.late) == ("two_parents", False)
        assert "base is in odom (10 times) and map (10 times): choose by --map-frame odom" in (
            str(caught.value)
        )
        for wanted, sign in (("odom", 1), ("map", -1)):
            frames.wanted = wanted
            assert frames.fixed_frame("base") == wanted
            assert frames.poses(wanted, "base", at(T0 + SECOND))[0, 0, 3] == sign
        frames.wanted = ""
        frames.add(edge("map", "base", T0 + 30 * SECOND))
        assert frames.moves("map", "base")
    assert np.allclose(frames.poses("map", "base", at(T0 + 30 * SECOND)), np.eye(4))


def test_a_static_parent_that_leads_nowhere_is_never_used() -> None:
    frames = tree(edge("odom", "base", T0), edge("world", "base", STATIC))
    assert frames.poses("odom", "base", at(T0)).shape == (1, 4, 4)


@pytest.mark.parametrize("same_time", [False, True])
def test_two_publishers_of_the_same_poses_are_told(same_time: bool) -> None:
    frames = FrameTree()
    for n in range(50):
        stamp = T0 + n * SECOND // 10
        frames.add(edge("odom", "base", stamp, at_x(n / 10)))
        frames.add(edge("odom", "base", stamp + (0 if same_time else 5), at_x(n / 10 + 0.5)))
    single = tree(*(edge("odom", "base", T0 + n, at_x(n + n % 2 / 10)) for n in range(50)))
    single.check()
    assert len(single.poses("odom", "base", at(T0))) == 1
    assert [edge.problem() for edge in single.moving] == [""]
    (moves,) = frames.moving
    assert moves.child == "base"
    frames.check()
    with pytest.raises(
        NoTransformError, match=r"jumps to and fro, \d+ times, by 0.(15|5) m"
    ) as caught:
        frames.poses("odom", "base", at(T0))
    assert caught.value.reason == "two_publishers"
    assert moves.problem() in str(caught.value)


def moving(stamp_ns: int) -> Pose:
    """Ten metres and one radian a second."""
    seconds = (stamp_ns - T0) / 1e9
    return Pose((10 * seconds, 0, 0), (0, 0, np.sin(seconds / 2), np.cos(seconds / 2)))


def frames_of_a_drive() -> FrameTree:
    frames = FrameTree()
    frames.add(edge("base", "lidar", STATIC, Pose((0.5, 0, 1), (0, 0, 0, 1))))
    for step in range(-20, 40):
        stamp = T0 + step * SECOND // 100
        frames.add(edge("odom", "base", stamp, moving(stamp)))
    return frames


def test_motion_during_a_sweep_is_taken_out() -> None:
    rng = np.random.default_rng(3)
    world = rng.normal(size=(5000, 3)) * 20
    offsets = np.sort(rng.uniform(-0.05, 0.05, len(world)))
    lidar = Pose((0.5, 0, 1), (0, 0, 0, 1)).matrix()
    points = np.empty((len(world), 3), np.float32)
    for index, offset in enumerate(offsets):
        pose = moving(T0 + round(offset * 1e9)).matrix() @ lidar
        points[index] = (np.linalg.inv(pose) @ [*world[index], 1])[:3]
    scan = place(Sweep(points, "lidar", T0, offsets), frames_of_a_drive(), "odom")
    placed = scan.points @ scan.world_from_sensor[:3, :3].T + scan.world_from_sensor[:3, 3]
    assert np.abs(placed - world).max() < 0.005
    skewed = place(Sweep(points, "lidar", T0), frames_of_a_drive(), "odom")
    placed = skewed.points @ skewed.world_from_sensor[:3, :3].T + skewed.world_from_sensor[:3, 3]
    assert np.abs(placed - world).max() > 1.0


def test_a_sweep_waits_for_the_pose_at_its_end() -> None:
    points = np.zeros((2, 3), np.float32)
    frames = frames_of_a_drive()
    stamp = T0 + 35 * SECOND // 100
    place(Sweep(points, "lidar", stamp), frames, "odom")
    with pytest.raises(NoTransformError) as caught:
        place(Sweep(points, "lidar", stamp, np.array([0.0, 0.1])), frames, "odom")
    assert caught.value.late
