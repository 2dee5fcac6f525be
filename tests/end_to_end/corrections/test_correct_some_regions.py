"""A correction makes the regions again that its scans reach, and leaves the others as they are."""

import logging

import numpy as np
import pytest
from support import servers
from support.maps.drifted import once_it_begins
from support.maps.small_world import world
from support.poses import shifted
from triquad_client import Client
from triquad_format.records.status import Status
from triquad_server.settings import Settings
from triquad_tools.recordings.publishing import wait_until_settled

SETTINGS = Settings.model_validate(
    {
        "field": {"leaf_m": 0.2, "depth": 7},  # regions of 25.6 m
        "scan": {"range_max_m": 12.0},
        "store": {"log_max_bytes": 10**9, "period_s": 0},
        "training": {"samples_per_ray": 1.0},  # so that it soon settles
    }
)
PLACES = (0.0, 120.0, 240.0, 360.0)  # along x, with nothing between them
NOWHERE = 600.0  # where no scan was taken
SCANS = world(1).scans


def pose(place: float) -> np.ndarray:
    return shifted(x=place) @ SCANS[0].world_from_sensor


def publish(client: Client, number: int, place: float) -> None:
    scan = SCANS[0]
    client.publish_scan(scan.points, pose(place), 1e9 + number, "roof", no_return=scan.no_return)
    assert client.flush().refused == 0


def points(place: float) -> np.ndarray:
    """Points that a scan sees there."""
    sensor = SCANS[0].points
    near = sensor[np.linalg.norm(sensor, axis=1) < 11.0][::20]
    return near @ pose(place)[:3, :3].T + pose(place)[:3, 3]


def known(client: Client, place: float) -> bool:
    return bool((client.query_sdf(points(place)).status != Status.UNKNOWN).mean() > 0.9)


def test_other_regions_stay_to_the_bit(tmp_path):
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number, place in enumerate((*PLACES[:3], NOWHERE)):
            publish(client, number, place)
        assert wait_until_settled(client, servers.WAIT_S).settled
        before = client.query_sdf(np.concatenate(list(map(points, PLACES[:3]))), gradient=True)
        reply = client.correct_poses("roof", [1e9 + 3], [pose(PLACES[3])])
        assert (reply.scans_moved, reply.scans_learnt) == (1, 1)
        assert wait_until_settled(client, servers.WAIT_S).settled
        after = client.query_sdf(np.concatenate(list(map(points, PLACES[:3]))), gradient=True)
        np.testing.assert_array_equal(after.sdf, before.sdf)
        np.testing.assert_array_equal(after.gradient, before.gradient)
        np.testing.assert_array_equal(after.status, before.status)
        assert known(client, PLACES[3])
        assert not known(client, NOWHERE), "nothing is left where the scan had been put"


def test_a_scan_comes_too_late_and_reaches_other_regions(tmp_path, caplog):
    caplog.set_level(logging.INFO, "triquad_server")
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for number, place in enumerate((PLACES[0], PLACES[1], NOWHERE)):
            publish(client, number, place)
        with once_it_begins(lambda: publish(client, 3, NOWHERE + 120.0)):
            client.correct_poses("roof", [1e9 + 2, 1e9 + 3], [pose(PLACES[2]), pose(PLACES[3])])
        # It is moved as the last scan of which the map knew then.
        where = [known(client, place) for place in (*PLACES, NOWHERE, NOWHERE + 120.0)]
        assert where == [True, True, True, True, False, False]


@pytest.mark.parametrize("number", range(3))
def test_the_map_goes_on_from_a_correction_after_a_restart(tmp_path, number):
    places = [*PLACES[:3]]
    places[number] = NOWHERE
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        for which, place in enumerate(places):
            publish(client, which, place)
        client.checkpoint()
        client.correct_poses("roof", [1e9 + number], [pose(PLACES[number])])
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        where = [known(client, place) for place in (*PLACES[:3], NOWHERE)]
        assert where == [True, True, True, False]
