import numpy as np
import pytest
import triquad_client
from support import servers
from support.kitti_folder import write_folder
from triquad_client import FlushReport
from triquad_tools.commands.replay import Pace, ReplayReport, due_times, main


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    settings = tmp_path_factory.mktemp("settings") / "small.toml"
    settings.write_text(servers.SMALL_TOML)
    with servers.server_process(["--settings", settings]) as server:
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


def test_every_third_scan_is_withheld(server, replay, tmp_path, capsys):
    before = _taken(server)
    assert replay(_folder(tmp_path), "--skip-every", 3, "--source", "other") == 0
    assert "4 scans published, 4 taken, " in capsys.readouterr().out
    assert _taken(server) == before + 4


@pytest.mark.parametrize("pace", [("--rate", 200), ("--as-recorded",)])
def test_scans_are_taken_at_a_pace(replay, tmp_path, capsys, pace):
    assert replay(_folder(tmp_path, 3), *pace) == 0
    assert "3 scans published, 3 taken, 0 refused, 0 lost, " in capsys.readouterr().out


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


def test_a_lost_scan_makes_the_replay_incomplete():
    assert ReplayReport(3, 0, FlushReport(3, 0, 0, None), {}, 1.0).complete
    assert not ReplayReport(3, 0, FlushReport(2, 0, 1, None), {}, 1.0).complete
    assert not ReplayReport(3, 0, FlushReport(2, 1, 0, "bad"), {}, 1.0).complete


def test_scans_are_due_by_rate_by_their_times_or_at_once():
    stamps = [5_000_000_000, 5_500_000_000, 7_000_000_000]
    assert due_times(Pace(), stamps) == [0.0, 0.0, 0.0]
    assert due_times(Pace(rate_hz=4.0), stamps) == [0.0, 0.25, 0.5]
    assert due_times(Pace(as_recorded=True), stamps) == [0.0, 0.5, 2.0]
    assert Pace().by_server
    assert not Pace(rate_hz=1.0).by_server


def test_input_that_cannot_be_used_is_refused(replay, tmp_path, capsys):
    assert replay(tmp_path / "nowhere") == 2
    assert "triquad-replay: " in capsys.readouterr().err
    folder = _folder(tmp_path / "scans")
    assert replay(folder, "--skip-every", 1) == 2
    assert "--skip-every 1 leaves no scan" in capsys.readouterr().err
    assert replay(folder, "--source", "a/b") == 2
    assert "'a/b' is not allowed" in capsys.readouterr().err


def test_a_server_that_cannot_be_reached_is_a_failure(replay, tmp_path, capsys):
    folder = _folder(tmp_path)
    endpoint = servers.free_endpoint()
    assert main([str(folder), "--connect", endpoint]) == 1
    assert f"cannot connect to {endpoint}" in capsys.readouterr().err
    assert replay(folder, "--map", "other") == 1
    assert "no server has a map 'other'; available: default" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("x", "--rate", "0"),
        ("x", "--rate", "fast"),
        ("x", "--rate", "1", "--as-recorded"),
        ("x", "--skip-every", "0"),
        ("x", "--range-min", "-1"),
        ("x", "--range-min", "nan"),
    ],
)
def test_wrong_usage_ends_with_code_2(arguments):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
