import numpy as np
import pytest
import triquad_client
from support import servers
from support.recordings.bags import drive, messages_for, write_bag
from support.recordings.kitti_folder import write_folder
from triquad_server.settings.loading import load_settings
from triquad_tools.commands.replay import due_times, main

ROS2 = messages_for("mcap")


@pytest.fixture(scope="module")
def server():
    with servers.server_process(["--settings", servers.SMALL_FILE]) as server:
        yield server


@pytest.fixture
def replay(server):
    return lambda *arguments: main([*map(str, arguments), "--connect", server.endpoint])


def _folder(path, scans=6, radius_m=servers.RADIUS_M):
    poses = np.tile(np.eye(4), (scans, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(scans)
    stamps = [10**18 + i * 10**8 for i in range(scans)]
    write_folder(path, [servers.sphere(1000, radius_m)] * scans, poses, stamps)
    return path


def _taken(server):
    with triquad_client.connect(server.endpoint) as client:
        return client.status().scans_taken


def test_all_scans_are_taken_and_learnt(server, replay, tmp_path, capsys):
    before = _taken(server)
    assert replay(_folder(tmp_path, 10), "--settle") == 0
    output = capsys.readouterr()
    assert "10 scans published, 10 taken, 0 refused, 0 lost, " in output.out
    assert "settled: epoch " in output.out
    assert "publishing ..." in output.err
    assert _taken(server) == before + 10
    with triquad_client.connect(server.endpoint) as client:
        assert client.status().settled
        assert np.nanmedian(np.abs(client.query_sdf(servers.sphere()).sdf)) < 0.2


@pytest.mark.parametrize("rate", ["200", "2x"])
def test_scans_are_taken_at_a_pace(replay, tmp_path, capsys, rate):
    assert replay(_folder(tmp_path, 3), "--rate", rate) == 0
    assert "3 scans published, 3 taken, 0 refused, 0 lost, " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("choice", "published"),
    [
        (("--start", 0.15, "--end", 0.35), 2),
        (("--every", 2, "--start", 0.3), 1),
    ],
)
def test_a_part_of_a_recording_is_chosen(replay, tmp_path, capsys, choice, published):
    assert replay(_folder(tmp_path), *choice, "--source", f"part{published}") == 0
    assert f"{published} scans published, {published} taken, " in capsys.readouterr().out


def test_what_a_recording_holds_is_told_without_a_server(tmp_path, capsys):
    stamps = [2 * 10**18 + i * 10**8 for i in range(4)]
    poses = np.tile(np.eye(4), (4, 1, 1))
    messages = drive(ROS2, [servers.sphere(50)] * 4, poses, stamps, np.eye(4))
    bag = write_bag(tmp_path / "bag", "mcap", messages)
    assert main([str(bag), "--list"]) == 0
    output = capsys.readouterr().out
    assert "4 scans, source lidar.points" in output
    assert "4 scans in 0.3 s, 10.0 a second" in output
    assert f"triquad-map {bag} bag.triquad" in output
    assert main([str(bag), "--list", "--transform", "a b 0 0 0 0 0 0 1", "--poses", "tf"]) == 0
    same = f"to map it: triquad-map {bag} bag.triquad --transform 'a b 0 0 0 0 0 0 1' --poses tf"
    assert same in capsys.readouterr().out
    blind = write_bag(tmp_path / "blind", "mcap", [m for m in messages if m.topic != "/tf"])
    assert main([str(blind), "--list"]) == 2
    output = capsys.readouterr()
    assert "it holds no poses: record /tf" in output.out
    assert "nothing of it can be mapped as it is" in output.err
    assert main([str(blind)]) == 2
    error = capsys.readouterr().err
    assert "it holds no poses" in error
    assert "nothing of it can be mapped as it is" in error


def test_the_preset_for_rooms_is_named_where_nearly_all_is_within_its_reach(tmp_path, capsys):
    reach_m = load_settings(preset="indoor").scan.range_max_m
    for radius_m, fits in ((reach_m - 0.1, True), (reach_m + 0.1, False)):
        folder = _folder(tmp_path / f"{fits}", radius_m=radius_m)
        assert main([str(folder), "--list", "--range-min", "1"]) == 0
        output = capsys.readouterr().out
        command = f"to map it: triquad-map {folder} {fits}.triquad --range-min 1"
        assert output.endswith(f"{command} --preset indoor\n" if fits else f"{command}\n")
        assert ("95 % of the points are within 12.4 m of the sensor" in output) == fits


def test_near_points_are_not_sent(replay, tmp_path, capsys):
    assert replay(_folder(tmp_path), "--range-min", 5) == 0
    assert "0 scans published, 0 taken, 0 refused, 0 lost, 6 without points not sent, " in (
        capsys.readouterr().out
    )


def test_refused_scans_are_reported_with_the_reason(replay, tmp_path, capsys):
    assert replay(_folder(tmp_path, 2, radius_m=1.0)) == 1
    output = capsys.readouterr().out
    assert "2 scans published, 0 taken, 2 refused (empty: 2), 0 lost, " in output
    assert "last refusal: source 'default': scan 1: none of 1000 points is finite" in output


def test_scans_are_due_by_rate_or_by_their_times():
    stamps = [5_000_000_000, 5_500_000_000, 7_000_000_000]
    assert due_times("4")(stamps) == [0.0, 0.25, 0.5]
    assert due_times("1x")(stamps) == [0.0, 0.5, 2.0]
    assert due_times("2x")(stamps) == [0.0, 0.25, 1.0]


def test_input_that_cannot_be_used_is_refused(replay, tmp_path, capsys):
    assert replay(tmp_path / "nowhere") == 2
    assert "triquad-replay: " in capsys.readouterr().err
    folder = _folder(tmp_path / "scans")
    assert replay(folder, "--start", 7) == 2
    assert "no scan is left of 6 in 0.5 s: see --start" in capsys.readouterr().err
    assert replay(folder, "--source", "a/b") == 2
    assert "'a/b' is not allowed" in capsys.readouterr().err


def test_a_server_that_cannot_be_reached_is_a_failure(replay, tmp_path, capsys):
    folder = _folder(tmp_path)
    endpoint = servers.free_endpoint()
    assert main([str(folder), "--connect", endpoint]) == 1
    assert f"cannot connect to {endpoint}" in capsys.readouterr().err
    assert replay(folder, "--map", "other") == 1
    assert "no server has a map 'other'; available: default" in capsys.readouterr().err


def test_poses_of_scans_that_were_published_are_corrected(tmp_path, capsys):
    folder, better = _folder(tmp_path / "drive"), tmp_path / "better.txt"
    poses = np.loadtxt(folder / "poses.txt")
    poses[:, 7] += 0.5  # to the left
    np.savetxt(better, poses)
    log = ["--set", "store.log_max_bytes=100000000", "--store", tmp_path / "store"]
    with servers.server_process(["--settings", servers.SMALL_FILE, *log]) as server:
        there = ["--connect", server.endpoint]
        assert main([str(folder), *there]) == 0
        assert main([str(folder), *there, "--trajectory", str(better), "--correct-poses"]) == 0
        assert "6 scans moved, 2 taken in again" in capsys.readouterr().out
        with triquad_client.connect(server.endpoint) as client:
            trail = client.sources().sources["default"].trail
    np.testing.assert_allclose(trail[:, 1], 0.5, atol=1e-6)
