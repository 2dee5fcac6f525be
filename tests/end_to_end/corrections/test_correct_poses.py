"""A map whose poses are corrected is the one that the corrected poses would have made."""

import logging
import signal
import threading

import numpy as np
import pytest
import triquad_client
from scipy.spatial import cKDTree
from support import servers
from support.maps.drifted import SAME, SCANS, SETTINGS, off, once_it_begins, shared, surface, truth
from support.maps.small_world import world
from triquad_client import InvalidScanError, RefusedError, TriquadError
from triquad_tools.recordings.opening import open_recording
from triquad_tools.recordings.recording import ReadingOptions

FIRST_S = 1e9


def publish(client, number: int, error: np.ndarray, source: str = "roof", at_s: float = 0.0):
    scan = world(SCANS).scans[number]
    pose = scan.world_from_sensor @ error
    stamp_s = FIRST_S + number + at_s
    client.publish_scan(scan.points, pose, stamp_s, source, no_return=scan.no_return)
    client.flush()


def corrections(*numbers: int) -> tuple[list[float], list[np.ndarray]]:
    """The true poses of some scans."""
    poses = [world(SCANS).scans[number].world_from_sensor for number in numbers]
    return [FIRST_S + number for number in numbers], poses


def test_the_map_is_as_the_corrected_poses_would_have_made_it(tmp_path):
    with servers.service_and_client(SETTINGS, tmp_path / "store") as client:
        for number in range(SCANS):
            publish(client, number, off() if number >= 3 else np.eye(4))
        assert shared(surface(client, tmp_path), truth()) < 0.95
        before = client.status().epoch
        reply = client.correct_poses("roof", *corrections(*range(SCANS)))
        assert (reply.scans_moved, reply.scans_learnt) == (3, SCANS)
        assert reply.epoch > before
        assert not client.status().settled  # it has to learn again
        assert shared(surface(client, tmp_path), truth()) > SAME
        source, pose = client.sources().sources["roof"], corrections(SCANS - 1)[1][0]
        np.testing.assert_allclose(source.trail[-1], pose[:3, 3], atol=1e-3)
        np.testing.assert_allclose(source.newest.world_from_sensor, pose, atol=1e-6)
        in_sensor = (source.newest.points_m - pose[:3, 3]) @ pose[:3, :3]
        away_m = cKDTree(world(SCANS).scans[-1].points).query(in_sensor)[0]
        assert away_m.max() < 1e-3, "what the sensor saw last moves with it"
    with servers.service_and_client(SETTINGS, tmp_path / "store") as client:
        assert shared(surface(client, tmp_path), truth()) > SAME
    recording = open_recording(tmp_path / "store", ReadingOptions())
    for scan, pose in zip(recording.read(range(SCANS)), corrections(*range(SCANS))[1], strict=True):
        np.testing.assert_allclose(scan.world_from_sensor, pose, atol=1e-6)


def test_scans_between_keyframes_move_with_them(tmp_path):
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number in range(SCANS):
            publish(client, number, off(number / (SCANS - 1)))
        client.correct_poses("roof", *corrections(0, SCANS - 1))
        assert shared(surface(client, tmp_path), truth()) > SAME


def test_scans_after_the_last_keyframe_move_where_that_is_asked_for(tmp_path):
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number in range(SCANS):
            publish(client, number, off())
        assert client.correct_poses("roof", *corrections(0, 1)).scans_moved == 2
        assert shared(surface(client, tmp_path), truth()) < 0.95
        assert client.correct_poses("roof", *corrections(0, 1, 2), onward=True).scans_moved == 4
        assert shared(surface(client, tmp_path), truth()) > SAME


def test_what_came_before_the_first_scan_that_moves_is_taken_from_a_checkpoint(tmp_path):
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number in range(SCANS):
            publish(client, number, off() if number >= 4 else np.eye(4))
            client.checkpoint()
        reply = client.correct_poses("roof", *corrections(*range(SCANS)))
        assert (reply.scans_moved, reply.scans_learnt) == (2, 2)
        assert shared(surface(client, tmp_path), truth()) > SAME
        again = client.correct_poses("roof", *corrections(*range(SCANS)))
        assert (again.scans_moved, again.scans_learnt) == (0, 0)


def test_a_correction_of_later_scans_keeps_the_one_before(tmp_path):
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number in range(3):
            publish(client, number, off())
        client.correct_poses("roof", *corrections(0, 1, 2))
        for number in range(3, SCANS):
            publish(client, number, off() if number == SCANS - 1 else np.eye(4))
        assert client.correct_poses("roof", *corrections(SCANS - 1)).scans_moved == 1
        assert shared(surface(client, tmp_path), truth()) > SAME


def test_scans_that_come_meanwhile_and_those_of_others_are_in_the_map(tmp_path):
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number in range(SCANS - 2):
            publish(client, number, off() if number % 2 else np.eye(4), f"lidar-{number % 2}")
        replies = []
        numbers = range(1, SCANS - 2, 2)
        correcting = threading.Thread(
            target=lambda: replies.append(client.correct_poses("lidar-1", *corrections(*numbers)))
        )
        correcting.start()
        for number in (SCANS - 2, SCANS - 1):
            publish(client, number, np.eye(4), "lidar-1")
        correcting.join()
        assert replies[0].scans_moved == 2
        assert shared(surface(client, tmp_path), truth()) > SAME


def test_a_scan_that_comes_later_than_its_correction_moves_with_the_others(tmp_path, caplog):
    caplog.set_level(logging.INFO, "triquad_server")
    with servers.service_and_client(SETTINGS, tmp_path / "store") as client:
        for number in range(SCANS - 1):
            publish(client, number, off())
        with once_it_begins(lambda: publish(client, SCANS - 1, off())):
            client.correct_poses("roof", *corrections(*range(SCANS)))
        assert shared(surface(client, tmp_path), truth()) > SAME
        trail = client.sources().sources["roof"].trail
        there = world(SCANS).scans[-1].world_from_sensor[:3, 3]
        assert np.linalg.norm(trail - there, axis=1).min() < 1e-3
        client.checkpoint()
    recording = open_recording(tmp_path / "store", ReadingOptions())
    for scan, pose in zip(recording.read(range(SCANS)), corrections(*range(SCANS))[1], strict=True):
        np.testing.assert_allclose(scan.world_from_sensor, pose, atol=1e-6)


def test_the_way_back_is_told(tmp_path):
    with servers.service_and_client(SETTINGS, tmp_path / "store") as client:
        for number in range(SCANS):
            publish(client, number, np.eye(4))
        wrong = [pose @ off() for pose in corrections(4, 5)[1]]
        reply = client.correct_poses("roof", corrections(4, 5)[0], wrong)
        assert f"--restore {reply.kept_epoch}" in reply.undo
        client.download_map(tmp_path / "wrong.triquad")
    kept = next(tmp_path.glob(f"store/*/epoch-{reply.kept_epoch:09d}.*"))
    with triquad_client.open_map(kept) as before:
        assert shared(before.surface_voxels(), truth()) > SAME


@pytest.mark.parametrize(
    ("numbers", "source", "error", "named"),
    [
        ((0, 1), "front", RefusedError, "those of roof are"),
        ((1, 0), "roof", InvalidScanError, "they rise"),
        ((), "roof", InvalidScanError, "0 poses"),
    ],
)
def test_what_cannot_be_corrected_is_refused_by_name(tmp_path, numbers, source, error, named):
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        publish(client, 0, np.eye(4))
        with pytest.raises(error, match=named):
            client.correct_poses(source, *corrections(*numbers))
        with pytest.raises(RefusedError, match=r"0.000 to 1.000 s, lies amid .* 1000000000.000"):
            client.correct_poses("roof", [0.0, 1.0], corrections(0, 1)[1])
        assert client.correct_poses("roof", *corrections(0)).scans_moved == 0


@pytest.mark.parametrize("log_max_bytes", [0, 1])
def test_where_scans_are_not_kept_the_map_stays_and_the_remedy_is_named(tmp_path, log_max_bytes):
    settings = SETTINGS.model_copy(
        update={"store": SETTINGS.store.model_copy(update={"log_max_bytes": log_max_bytes})}
    )
    with servers.service_and_client(settings, tmp_path) as client:
        for number in range(3):
            publish(client, number, off())
            client.checkpoint()  # of the log, the newest file alone stays
        before = surface(client, tmp_path)
        for path in tmp_path.glob("*/epoch-*"):
            if path.name < f"epoch-{client.status().epoch:09d}":
                path.unlink()
        with pytest.raises(RefusedError, match="store.log_max_bytes"):
            client.correct_poses("roof", *corrections(0, 1, 2))
        assert len(surface(client, tmp_path)) == len(before)


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
def test_a_server_that_ends_amid_a_correction_has_the_map_of_before(tmp_path, end):
    arguments = ["--store", tmp_path / "store", "--set", "store.log_max_bytes=1000000000"]
    arguments += ["--set", "field.leaf_m=0.2", "--set", "store.period_s=0"]
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        for number in range(SCANS):
            publish(client, number, off())
        before = surface(client, tmp_path)
        correcting = threading.Thread(
            target=lambda: pytest.raises(
                TriquadError, client.correct_poses, "roof", *corrections(*range(SCANS))
            )
        )
        correcting.start()
        server.wait_for("regions are made again")
        server.process.send_signal(end)
        server.process.wait()
        correcting.join()
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        assert shared(surface(client, tmp_path), before) > SAME
        client.correct_poses("roof", *corrections(*range(SCANS)))
        assert shared(surface(client, tmp_path), truth()) > SAME
