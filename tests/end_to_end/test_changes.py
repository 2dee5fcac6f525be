"""What changed since an epoch, asked by the real client over the loopback."""

import math

import numpy as np
import pytest
from support import servers
from triquad_client import ChangeKind, ChangeReport, InvalidInputError, RefusedError

POSE = np.eye(4)
EAST = ((1, -9, -9), (9, 9, 9))
WEST = ((-9, -9, -9), (-1, 9, 9))


def kinds(report):
    return {box.kind for box in report.boxes}


def voxels(report):
    return sum(box.voxels for box in report.boxes)


def cover(report, points):
    """Whether each point lies in a box."""
    low, high = (np.array([getattr(box, end) for box in report.boxes]) for end in
                 ("minimum", "maximum"))  # fmt: skip
    return ((points[:, None] >= low) & (points[:, None] <= high)).all(axis=2).any(axis=1)


def test_a_program_polls_with_the_report_before(client):
    start = client.changes()
    assert start.boxes == ()
    assert start.epoch == start.since == client.status().epoch
    servers.learn(client)
    report = client.changes(since=start)
    assert report.since == start.epoch < report.epoch
    assert kinds(report) == {ChangeKind.APPEARED}
    assert cover(report, servers.sphere()).all()
    sizes = [box.voxels for box in report.boxes]
    assert sizes == sorted(sizes, reverse=True)
    for box in report.boxes:
        assert start.epoch < box.epoch <= report.epoch
        size = np.subtract(box.maximum, box.minimum)
        assert (size <= 6.4 + 1e-9).all()
        assert 0 < box.voxels <= round(math.prod(size) / 0.2**3)
        assert np.abs(box.bounds).max() <= servers.RADIUS_M + 0.2
    assert client.changes(since=report).boxes == ()  # what is trained on is no change
    assert client.changes(since=start.epoch).boxes == report.boxes


def test_what_is_forgotten_has_vanished_and_appears_again(client):
    servers.learn(client)
    start = client.changes()
    forgotten = client.reset(EAST).epoch
    gone = client.changes(since=start)
    assert kinds(gone) == {ChangeKind.VANISHED}
    assert {box.epoch for box in gone.boxes} == {forgotten}
    assert all(box.minimum[0] >= 1 - 1e-9 for box in gone.boxes)
    servers.learn(client)
    again = client.changes(since=gone)
    assert kinds(again) == {ChangeKind.APPEARED}
    assert voxels(again) == voxels(gone)
    assert client.changes(since=start).boxes == ()  # the same sphere as before


def test_bounds_leave_out_what_changed_elsewhere(client):
    start = client.changes()
    servers.learn(client)
    everywhere = client.changes(start)
    east, west = client.changes(start, EAST), client.changes(start, bounds=WEST)
    assert 0 < voxels(east) < voxels(everywhere)
    assert all(box.minimum[0] >= 1 - 1e-9 for box in east.boxes)
    assert all(box.maximum[0] <= -1 + 1e-9 for box in west.boxes)
    assert client.changes(start, ((90, 90, 90), (91, 91, 91))).boxes == ()


def test_however_much_changed_the_boxes_are_few(client):
    """Voxels here and there in a cube of 60 m: hundreds of clusters."""
    start = client.changes()
    for seed in range(3):
        points = np.random.default_rng(seed).uniform(-8, 8, (1500, 3))
        points = points[np.linalg.norm(points, axis=1) > 2].astype(np.float32)
        client.publish_scan(points, POSE)
    client.flush(servers.WAIT_S)
    report = client.changes(start)
    assert 1 <= len(report.boxes) <= 256
    assert voxels(report) > 2000
    assert cover(report, points).all()


def test_what_cannot_be_told_is_refused_with_the_remedy(client, endpoint):
    now = client.changes()
    with pytest.raises(RefusedError, match=f"newest epoch is {now.epoch}") as caught:
        client.changes(since=now.epoch + 1000)
    assert caught.value.code == "epoch_gone"
    restarted = ChangeReport(epoch=now.epoch, since=1, server="feed", boxes=())
    with pytest.raises(RefusedError, match="restarted; ask for the map again") as caught:
        client.changes(since=restarted)
    assert caught.value.code == "epoch_gone"
    for bad in (0, -1, 1.5, "now", True, 2**63):
        with pytest.raises(InvalidInputError, match="since = "):
            client.changes(since=bad)
    with pytest.raises(InvalidInputError, match="bounds"):
        client.changes(bounds=((1, 1, 1), (0, 0, 0)))


def test_what_changed_before_a_restart_is_not_known(tmp_path):
    with servers.service_and_client(store=tmp_path) as client:
        start = client.changes()
        servers.learn(client)
        before = client.changes(since=start)
        client.checkpoint()
    with servers.service_and_client(store=tmp_path) as client:
        client.settle(servers.WAIT_S)  # else a newer epoch may come between two questions
        for since in (before, start.epoch):
            with pytest.raises(RefusedError) as caught:
                client.changes(since=since)
            assert caught.value.code == "epoch_gone"
        now = client.changes()
        assert f"is {now.epoch}" in caught.value.message
        client.reset(WEST)
        assert kinds(client.changes(since=now)) == {ChangeKind.VANISHED}
