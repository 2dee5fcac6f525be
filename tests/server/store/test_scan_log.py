"""Which scans a server keeps, and which it no longer has."""

import math
import shutil
from collections import deque

import numpy as np
import pytest
from support.maps.small_world import world
from support.poses import shifted
from triquad_format.mapfile.index import Restored
from triquad_format.scan_log.log_folder import history, segments
from triquad_format.scan_log.segment import (
    GRAIN_M,
    LoggedCorrection,
    LoggedScan,
    read_segment,
)
from triquad_format.wire.messages import Scan
from triquad_server.intake.rays import usable_rays
from triquad_server.settings import ScanSettings
from triquad_server.store.scan_log import ScanLog

LEAF_M = 0.2
POINTS = np.array([[10.0, 0, 0], [0, 20, 1], [300, 5, 0]], np.float32)
NO_RETURN = np.array([[0.0, 0, 2], [1, 1, 0]], np.float32)


def log(tmp_path, epoch: int = 0, restored: Restored | None = None, most: int = 10**9) -> ScanLog:
    return ScanLog(tmp_path, most, LEAF_M, epoch, restored)


def add(
    log: ScanLog,
    pose: np.ndarray,
    stamp_s: float,
    source: str = "roof",
    points: np.ndarray = POINTS,
) -> None:
    rays = usable_rays(points, pose, ScanSettings(), no_return=NO_RETURN, map_origin=np.zeros(3))
    log.add(Scan(points, pose, int(stamp_s * 1e9), source, 1, 0), rays)


def write(log: ScanLog, epoch: int, count: int = 1) -> None:
    """Take in some scans, and write the checkpoint of an epoch."""
    for number in range(count):
        add(log, shifted(x=100.0 * epoch + number), epoch + 0.01 * number)
    log.keep(log.cut(), epoch)


def kept(log: ScanLog) -> list[LoggedScan]:
    files = history(segments(log.folder))
    found = (one for file in files for one in read_segment(file.path))
    return [one for one in found if isinstance(one, LoggedScan)]


def turned(degrees: float) -> np.ndarray:
    pose, angle = shifted(), math.radians(degrees)
    pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return pose


@pytest.mark.parametrize(
    ("poses", "period_s", "expected"),
    [
        ([shifted(x=0.04 * n) for n in range(26)], 0.01, 2),
        ([shifted(x=0.6 * n) for n in range(5)], 0.1, 5),
        ([turned(2.1 * n) for n in range(11)], 0.1, 3),
        ([shifted()] * 41, 0.1, 3),
    ],
    ids=["slowly", "on", "turning", "at rest"],
)
def test_a_scan_is_kept_wherever_its_source_has_moved_on(tmp_path, poses, period_s, expected):
    scans = log(tmp_path)
    for number, pose in enumerate(poses):
        add(scans, pose, number * period_s)
        add(scans, shifted(y=5.0), number * period_s, "another")
    scans.keep(scans.cut(), 1)
    assert sum(scan.source == "roof" for scan in kept(scans)) == expected


def test_a_kept_scan_gives_the_rays_that_it_gave(tmp_path) -> None:
    scans, pose = log(tmp_path), turned(30.0)
    pose[:3, 3] = (5.0, -3.0, 1.0)
    taken = usable_rays(POINTS, pose, ScanSettings(), no_return=NO_RETURN, map_origin=np.zeros(3))
    add(scans, pose, 1.0)
    scans.keep(scans.cut(), 1)
    (scan,) = kept(scans)
    again = usable_rays(
        scan.points,
        scan.world_from_sensor,
        ScanSettings(),
        no_return=scan.no_return,
        map_origin=np.zeros(3),
    )
    for name in ("origin", "ends", "far_ends", "open_ends"):
        np.testing.assert_allclose(getattr(again, name), getattr(taken, name), atol=GRAIN_M)


def test_what_no_checkpoint_has_is_not_in_the_log(tmp_path) -> None:
    first = log(tmp_path)
    write(first, 3)
    write(first, 8)
    add(first, shifted(), 9.0)  # and the server is killed
    again = log(tmp_path, epoch=3)  # the checkpoint of epoch 8 was not written
    assert len(kept(again)) == 1
    write(again, 9)
    assert [one.epoch for one in history(segments(again.folder))] == [3, 9]
    assert len(list(again.folder.iterdir())) == 2


def test_scans_since_an_older_checkpoint_are_not_of_the_map_that_goes_on_from_it(tmp_path):
    first = log(tmp_path)
    for epoch in (3, 8, 12):
        write(first, epoch)
    restored = Restored(3, 13)
    for _ in range(2):  # it is started again before a scan comes
        again = log(tmp_path, epoch=13, restored=restored)
        assert len(kept(again)) == 1
    write(again, 14)
    write(again, 20, count=0)  # a checkpoint of what was trained since
    once_more = log(tmp_path, epoch=20, restored=restored)
    write(once_more, 21)
    assert [one.epoch for one in history(segments(tmp_path / "scans"))] == [3, 13, 14, 20, 21]
    assert len(kept(once_more)) == 3


@pytest.mark.parametrize("restored", [None, Restored(7, 8)])
def test_a_map_that_took_in_scans_while_none_were_kept_has_not_those_of_before(tmp_path, restored):
    write(log(tmp_path), 3)
    # A server without the log went on until epoch 8, or to 7, to which the map went back.
    again = log(tmp_path, epoch=8, restored=restored)
    write(again, 9)
    assert len(kept(again)) == 1
    assert history(segments(again.folder))[0].after == 8


def test_the_oldest_files_go_that_there_is_no_room_for(tmp_path) -> None:
    scans = log(tmp_path)
    write(scans, 1)
    one = sum(segment.path.stat().st_size for segment in segments(scans.folder))
    scans = log(tmp_path, epoch=1, most=3 * one + one // 2)
    for epoch in range(2, 7):
        write(scans, epoch)
    assert [segment.epoch for segment in segments(scans.folder)] == [4, 5, 6]


def test_outdated_checkpoints_are_known_as_long_as_the_log_goes_back_before_them(tmp_path) -> None:
    scans = log(tmp_path)
    write(scans, 1)
    stamps_ns = np.array([10**9])
    correction = LoggedCorrection("roof", stamps_ns, np.eye(4)[None], 10**9, first_epoch=1)
    scans.add_correction(correction)
    write(scans, 2)
    write(scans, 3)
    assert scans.outdated == log(tmp_path, epoch=3).outdated == [range(1, 2)]
    again = log(tmp_path, epoch=3, most=1)
    write(again, 4)
    assert again.outdated == log(tmp_path, epoch=4).outdated == []


def test_no_file_goes_while_poses_are_corrected(tmp_path) -> None:
    scans = log(tmp_path, most=1)
    scans.follow(deque())
    for epoch in (1, 2, 3):
        write(scans, epoch)
    assert [segment.epoch for segment in segments(scans.folder)] == [1, 2, 3]
    scans.follow(None)
    write(scans, 4)
    assert [segment.epoch for segment in segments(scans.folder)] == [4]


def test_a_disk_that_fails_stops_nothing_and_is_told_until_it_works(tmp_path) -> None:
    scans = log(tmp_path)
    write(scans, 1)
    shutil.rmtree(scans.folder)
    scans.folder.touch()
    write(scans, 2)
    assert scans.error is not None
    assert "cannot be written" in scans.error
    scans.folder.unlink()
    scans.folder.mkdir()
    write(scans, 3)
    assert scans.error is None
    assert len(kept(scans)) == 1


@pytest.mark.parametrize("count", [1, 400], ids=["at the end", "amid it"])
def test_scans_before_some_that_were_lost_are_not_taken_for_all(tmp_path, count) -> None:
    """A reset may have been among what was lost."""
    scans = log(tmp_path)
    write(scans, 1)
    (scans.folder / ".unfinished-2.mcap").symlink_to("/dev/full")
    points = np.random.default_rng(0).uniform(5, 50, (3000, 3)).astype(np.float32)
    for number in range(count):
        add(scans, shifted(x=float(number)), 2.0 + 0.1 * number, points=points)
        if scans.error is not None:
            break
    if scans.error is None:
        scans.keep(scans.cut(), 2)
    assert scans.error is not None
    assert "No space left" in scans.error
    write(scans, 3)
    write(scans, 4)
    assert scans.error is None
    assert [one.epoch for one in history(segments(scans.folder))] == [3, 4]
    assert history(segments(scans.folder))[0].after == 3, "so it is told that earlier ones are lost"
    assert not list(scans.folder.glob(".*"))


def test_a_drive_takes_few_bytes(tmp_path) -> None:
    """Less than 6 a point: three numbers of single precision are 12."""
    scans, drive = log(tmp_path), world(4)
    points = 0
    for number, scan in enumerate(drive.scans):
        rays = usable_rays(
            scan.points, scan.world_from_sensor, ScanSettings(), map_origin=np.zeros(3)
        )
        scans.add(
            Scan(scan.points, scan.world_from_sensor, number * 10**9, "roof", 1, number), rays
        )
        points += len(rays.ends)
    scans.keep(scans.cut(), 1)
    size = sum(segment.path.stat().st_size for segment in segments(scans.folder))
    assert size / points < 6
