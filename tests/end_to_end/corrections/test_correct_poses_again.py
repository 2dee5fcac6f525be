"""Corrections of a map that has a past: scans of before keep their places, whatever came since."""

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest
from support import servers
from support.maps.drifted import SAME, SCANS, SETTINGS, off, shared, surface, truth
from support.maps.small_world import world
from support.poses import shifted
from triquad_client import Client, RefusedError

FIRST_S = 1e9
RIGHT = np.eye(4)


def publish(
    client: Client, number: int, error: np.ndarray, stamp_s: float | None = None, source="roof"
) -> None:
    scan = world(SCANS).scans[number]
    stamp_s = FIRST_S + number if stamp_s is None else stamp_s
    pose = scan.world_from_sensor @ error
    client.publish_scan(scan.points, pose, stamp_s, source, no_return=scan.no_return)


def corrections(*numbers: int) -> tuple[list[float], list[np.ndarray]]:
    """The true poses of some scans."""
    poses = [world(SCANS).scans[number].world_from_sensor for number in numbers]
    return [FIRST_S + number for number in numbers], poses


def test_scans_of_a_robot_whose_clock_began_again_stay(tmp_path: Path) -> None:
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number in range(3):
            publish(client, number, RIGHT)
        client.restart_source("roof")
        for number in range(3, SCANS):
            publish(client, number, off(), FIRST_S + number - 3)
        right = corrections(3, 4, 5)[1]
        assert client.correct_poses("roof", corrections(0, 1, 2)[0], right).scans_moved == 3
        assert shared(surface(client, tmp_path), truth()) > SAME
        publish(client, 0, off(), source="front")
        assert client.correct_poses("front", *corrections(0)).scans_moved == 1
        assert shared(surface(client, tmp_path), truth()) > SAME


def test_scans_of_before_are_found_by_their_stamps_where_the_clock_began_again(tmp_path) -> None:
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number in range(3):
            publish(client, number, off())
        client.restart_source("roof")
        for number in range(3, SCANS):
            publish(client, number, RIGHT, FIRST_S + number - 100)
        assert client.correct_poses("roof", *corrections(0), onward=True).scans_moved == 3
        client.checkpoint()
        publish(client, 0, off(), source="front")
        assert client.correct_poses("front", *corrections(0)).scans_moved == 1
        assert shared(surface(client, tmp_path), truth()) > SAME


def test_a_wrong_scan_between_two_that_were_kept_is_in_the_map_no_more(tmp_path: Path) -> None:
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number in range(SCANS):
            publish(client, number, RIGHT)
            publish(client, number, shifted(y=0.4), FIRST_S + number + 0.1)  # too near to be kept
        client.flush()
        assert shared(surface(client, tmp_path), truth()) < SAME
        stamps_s, poses = (np.repeat(each, 2, axis=0) for each in corrections(*range(SCANS)))
        stamps_s[1::2] += 0.1
        assert client.correct_poses("roof", stamps_s, poses).scans_moved == SCANS
        assert shared(surface(client, tmp_path), truth()) > SAME


def test_scans_on_their_way_move_with_the_others(tmp_path: Path) -> None:
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number in range(SCANS):
            publish(client, number, off())
        assert client.correct_poses("roof", *corrections(0), onward=True).scans_moved == SCANS
        assert shared(surface(client, tmp_path), truth()) > SAME


def test_a_server_that_is_killed_after_a_correction_has_it(tmp_path: Path) -> None:
    with servers.service_and_client(SETTINGS, tmp_path / "store") as client:
        for number in range(SCANS):
            publish(client, number, off())
        client.correct_poses("roof", *corrections(0), onward=True)
        shutil.copytree(tmp_path / "store", tmp_path / "killed")
    with servers.service_and_client(SETTINGS, tmp_path / "killed") as client:
        assert shared(surface(client, tmp_path), truth()) > SAME


def test_a_server_that_was_started_before_without_a_scan_lacks_none(tmp_path: Path) -> None:
    store = SETTINGS.store.model_copy(update={"keep": 2})
    settings = SETTINGS.model_copy(update={"store": store})
    with servers.service_and_client(settings, tmp_path) as client:
        client.checkpoint()
    with servers.service_and_client(settings, tmp_path) as client:
        for number in range(SCANS):
            publish(client, number, off())
            client.flush()
            client.checkpoint()
        client.correct_poses("roof", *corrections(0), onward=True)
        assert shared(surface(client, tmp_path), truth()) > SAME


def test_scans_that_are_kept_no_more_stay_where_a_correction_has_put_them(tmp_path: Path) -> None:
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number in range(3):
            publish(client, number, off())
            client.flush()
            client.checkpoint()
        client.correct_poses("roof", *corrections(0), onward=True)
        for number in range(3, SCANS):
            publish(client, number, off() if number > 3 else RIGHT)
        client.flush()
        client.checkpoint()
        min(tmp_path.glob("*/scans/*.mcap")).unlink()  # as where the log has no room for more
        wrong = [pose @ off() for pose in corrections(1, 2)[1]]
        with pytest.raises(RefusedError, match="store.log_max_bytes"):
            client.correct_poses("roof", corrections(1, 2)[0], wrong)
        with pytest.raises(RefusedError, match=r"before 1000000001.000 s are not kept any more"):
            client.correct_poses("roof", *corrections(0, 4), onward=True)
        assert client.correct_poses("roof", *corrections(4), onward=True).scans_moved == 2
        assert shared(surface(client, tmp_path), truth()) > SAME


def since_s(client: Client) -> float | None:
    """From when on poses can be corrected, as the status says."""
    kept = client.status().kept_scans
    assert kept is not None
    return None if kept.since_ns is None else kept.since_ns / 1e9


def in_checkpoints(client: Client, *numbers: int) -> None:
    """Have some scans mapped, a checkpoint each."""
    for number in numbers:
        publish(client, number, off())
        client.flush()
        client.checkpoint()


def delete_the_oldest(store: Path) -> None:
    """Delete a file of the log, as where it has no room for more."""
    min(store.glob("*/scans/*.mcap")).unlink()


def test_the_status_tells_how_much_is_kept_and_since_when(tmp_path: Path) -> None:
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        assert since_s(client) is None
        in_checkpoints(client, 0, 1)
        assert since_s(client) == FIRST_S
        kept = client.status().kept_scans
        files = list(tmp_path.glob("*/scans/*.mcap"))
        assert kept.bytes == sum(file.stat().st_size for file in files) > 1000
        assert kept.max_bytes == SETTINGS.store.log_max_bytes
        assert repr(client.status()).endswith("; poses since 1000000000.000 s can be corrected)")
    settings = SETTINGS.model_copy(update={"store": servers.SMALL.store})
    with servers.service_and_client(settings, tmp_path) as client:
        assert client.status().kept_scans is None


def test_poses_can_be_corrected_from_when_the_status_says_and_none_before(tmp_path: Path) -> None:
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        in_checkpoints(client, 0, 1, 2, 3, 4)
    delete_the_oldest(tmp_path)
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        assert since_s(client) == FIRST_S + 1
        with pytest.raises(RefusedError, match="not kept any more"):
            client.correct_poses("roof", *corrections(0, 1), onward=True)
        assert client.correct_poses("roof", *corrections(1), onward=True).scans_moved == 4
        assert since_s(client) == FIRST_S + 1
        delete_the_oldest(tmp_path)
        in_checkpoints(client, 5)
        assert since_s(client) == FIRST_S + 5, "what was corrected together cannot be again"
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        assert since_s(client) == FIRST_S + 5
        wrong = [pose @ off() for pose in corrections(4)[1]]
        with pytest.raises(RefusedError, match="not kept any more"):
            client.correct_poses("roof", corrections(4)[0], wrong)
        assert client.correct_poses("roof", *corrections(5)).scans_moved == 1


def test_a_checkpoint_that_is_deleted_once_a_correction_goes_on_from_it_is_not_missed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "triquad_server")
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        in_checkpoints(client, *range(SCANS))

        def delete(record: logging.LogRecord) -> bool:
            if "regions are made again" in record.getMessage():
                for path in tmp_path.glob("*/epoch-*"):
                    path.unlink()
            return True

        server = logging.getLogger("triquad_server.store.pose_corrector")
        server.addFilter(delete)
        try:
            reply = client.correct_poses("roof", *corrections(SCANS - 1))
        finally:
            server.removeFilter(delete)
        assert (reply.scans_moved, reply.scans_learnt) == (1, 1)
        assert not list(tmp_path.glob(f"*/epoch-{reply.kept_epoch:09d}.*")), "none was deleted"
