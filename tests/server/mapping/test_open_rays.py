"""Rays that met nothing, and the box of the robot, over the regions of a map."""

import numpy as np
from support.poses import shifted
from triquad_format.records.status import Status
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings


def test_rays_without_a_return_make_no_region_but_are_recorded_where_there_is_one() -> None:
    chosen = Settings.model_validate({"field": {"depth": 7}})
    pitch = chosen.field.region_pitch_m
    mapper = Mapper("test", chosen, "cpu")
    along = np.array([[1, 0, 0], [-1, 0, 0]], np.float32)
    nothing = np.empty((0, 3), np.float32)
    mapper.ingest(nothing, np.eye(4), no_return=along)
    assert mapper.publish().regions == 1
    mapper.ingest(np.array([[0, 3, 0]], np.float32), shifted(pitch))  # now there is a region
    mapper.ingest(nothing, np.eye(4), no_return=along)
    epoch = mapper.publish()
    assert epoch.regions == 2
    far = np.array([[pitch + 5, 0, 0], [-pitch - 5, 0, 0], [-5, 0, 0]])
    assert epoch.status(far).tolist() == [Status.FREE, Status.UNKNOWN, Status.FREE]


def test_dense_open_rays_leave_no_gaps_near_the_sensor() -> None:
    """They are thinned, and a robot at rest uses others each time."""
    mapper = Mapper("test", Settings(), "cpu")
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(60_000, 3)).astype(np.float32)
    directions[:, 2] = np.abs(directions[:, 2]) + 0.5
    asked = directions[:20_000] / np.linalg.norm(directions[:20_000], axis=1, keepdims=True)
    near = asked * rng.uniform(1, 8, (len(asked), 1))
    middle = asked * rng.uniform(12, 24, (len(asked), 1))
    nothing = np.empty((0, 3), np.float32)
    shares = []
    for _ in range(4):
        mapper.ingest(nothing, np.eye(4), no_return=directions)
        epoch = mapper.publish()
        assert (epoch.status(near) == Status.FREE).mean() > 0.98
        shares.append((epoch.status(middle) == Status.FREE).mean())
    assert np.diff(shares).min() > 0
    assert shares[-1] > 0.95, shares


def test_the_robot_is_free_in_all_regions_of_the_map_that_it_reaches_into() -> None:
    chosen = Settings.model_validate(
        {
            "field": {"depth": 6},  # regions 9.6 m apart
            "sources": {"truck": {"robot_box_m": [[-15, -1, -1], [1, 1, 1]]}},
        }
    )
    nothing, up = np.empty((0, 3), np.float32), np.array([[0, 0, 1]], np.float32)
    mapper = Mapper("test", chosen, "cpu")
    mapper.ingest(nothing, shifted(-9.6), no_return=up)
    mapper.ingest(nothing, np.eye(4), source="truck", no_return=up)
    epoch = mapper.publish()
    along = np.array([[0.5, 0.5, 0], [-8.0, 0.5, 0], [-13.0, 0.5, 0], [1.5, 0.5, 0]])
    expected = [Status.FREE, Status.FREE, Status.FREE, Status.UNKNOWN]
    assert epoch.status(along).tolist() == expected
