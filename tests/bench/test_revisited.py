"""A drive that is mapped twice over, on few scans of a coarse lidar: a folder as recorded ones."""

import numpy as np
import pytest
from support.maps.episodes import box_on_a_street
from support.recordings.kitti_folder import write_folder
from triquad_server.settings import ChangeSettings, Settings

from bench.studies.revisited import RecordedScans, Revisited, recorded_scans, revisit

BUSY, SCANS = 4, 14  # things move in the first

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> RecordedScans:
    path = tmp_path_factory.mktemp("recorded")
    made = list(box_on_a_street(BUSY, SCANS - BUSY))
    poses = np.array([scan.world_from_sensor for scan in made])
    write_folder(path, [scan.points for scan in made], poses, 100_000_000 * np.arange(SCANS))
    return recorded_scans(path)


@pytest.fixture(scope="module")
def usual(scans: RecordedScans) -> Revisited:
    return revisit(scans, Settings(), "a street")


def test_every_seventh_scan_is_kept_apart(scans: RecordedScans) -> None:
    assert (len(scans.mapped), len(scans.withheld)) == (12, 2)


def test_what_several_scans_saw_is_kept_and_what_moved_on_is_not(usual: Revisited) -> None:
    assert usual.kept < usual.kept_of_several <= 1.0
    assert usual.kept > 0.9


def test_where_nothing_is_taken_back_all_is_kept(scans: RecordedScans, usual: Revisited) -> None:
    still = revisit(scans, Settings(change=ChangeSettings(static=True)), "a street")
    assert still.kept == still.kept_of_several == 1.0
    assert still.error_m == pytest.approx(usual.error_m, rel=0.2)
    assert 0.0 < usual.error_m < 0.05
