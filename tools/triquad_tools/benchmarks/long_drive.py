"""``triquad-bench`` of a long drive: whether all of it is learnt as well as a short one.

1.6 km of street in three regions, taken in much faster than they can be learnt, and then settled.
At last one more scan comes from the middle; who keeps a copy of the map fetches what it changed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings

from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.map_copy import MapCopy
from triquad_tools.benchmarks.street import learn_again, sdf_error_cm, settled_mapper
from triquad_tools.console.progress import progress
from triquad_tools.evaluation.map_scores import StreetProbes, driven_street, street_probes
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.street import street

_LENGTH_M = 1600
_STEP_M = 1.0
_SHORT_M = 100  # of street, with which the long one is compared
_PLACE_M = 50
_COLUMNS = 700
_STEPS = 3  # of training between two scans
_TIMES = 1.25  # the error of the short street


@dataclass(frozen=True)
class _Place:
    """A part of the drive, and where a map is asked about it."""

    name: str
    probes: StreetProbes

    def error_cm(self, mapper: Mapper) -> float:
        """The mean error of the signed distance."""
        return sdf_error_cm(mapper.publish(), self.probes)


def measure_long_drive(seed: int) -> list[Figure]:
    """Errors at the start, amid and at the end of a long drive, beside those of a short one."""
    scene = street(seed, _LENGTH_M)
    poses = drive(scene, int(_LENGTH_M / _STEP_M), _STEP_M)
    first = SimulatedDrive(scene, _lidar(), poses[: int(_SHORT_M / _STEP_M)], seed=seed)
    short = driven_street(first)
    alone = settled_mapper(f"the first {_SHORT_M} m", short.scans)
    alone_cm = sdf_error_cm(alone.publish(), short.probes)
    places = _places(scene, poses, seed)
    mapper = Mapper("bench", Settings(), "cpu")
    with progress("taking in the drive", len(poses)) as report:
        for number, scan in enumerate(SimulatedDrive(scene, _lidar(), poses, seed=seed)):
            mapper.ingest(scan.points, scan.world_from_sensor)
            for _ in range(_STEPS):
                mapper.train()
            report(number + 1, f"{number + 1} of {len(poses)} scans")
    taken_in_cm = [place.error_cm(mapper) for place in places]
    _settle(mapper)
    settled_cm = [place.error_cm(mapper) for place in places]
    copy = MapCopy.of(mapper.publish())
    middle = len(poses) // 2
    (again,) = SimulatedDrive(scene, _lidar(), poses[middle : middle + 1], seed=seed + 1)
    mapper.ingest(again.points, again.world_from_sensor)
    learn_again(mapper)
    newer = MapCopy.of(mapper.publish())
    fetched = newer.fetched_by(copy) / len(newer.parts)
    return [
        Figure(f"SDF error of the first {_SHORT_M} m alone", alone_cm, "cm"),
        *_errors(places, taken_in_cm, settled_cm, alone_cm),
        Figure("training samples", mapper.samples_trained / 1e6, "M"),
        Figure("rays kept", mapper.rays_kept / 1e6, "M"),
        Figure("parts of a copy of the map", len(newer.parts), ""),
        Figure("those fetched after one more scan in the middle", 100 * fetched, "%", at_most=10),
    ]


def _errors(
    places: Sequence[_Place],
    taken_in_cm: Sequence[float],
    settled_cm: Sequence[float],
    alone_cm: float,
) -> list[Figure]:
    figures = []
    for place, before, after in zip(places, taken_in_cm, settled_cm, strict=True):
        most = min(_TIMES * alone_cm, before)
        figures += [
            Figure(f"SDF error of {place.name}, just taken in", before, "cm"),
            Figure(f"SDF error of {place.name}, settled", after, "cm", at_most=most),
        ]
    return figures


def _lidar() -> Lidar:
    return Lidar(columns=_COLUMNS)


def _places(scene: Scene, poses: Doubles, seed: int) -> list[_Place]:
    count = int(_PLACE_M / _STEP_M)
    middle = (len(poses) - count) // 2
    places = []
    for name, first in (("first", 0), ("middle", middle), ("last", len(poses) - count)):
        part = SimulatedDrive(scene, _lidar(), poses[first : first + count], seed=seed)
        probes = street_probes(part, np.random.default_rng(seed))
        places.append(_Place(f"the {name} {_PLACE_M} m", probes))
    return places


def _settle(mapper: Mapper) -> None:
    """Train until nothing is left to learn, what was forgotten meanwhile included."""
    owed = mapper.samples_left
    with progress("settling", owed) as report:
        while not mapper.settled:
            mapper.train()
            left = mapper.samples_left
            report(max(0, owed - left), f"{left / 1e6:.0f} M samples left")
            if mapper.settled:
                mapper.publish()  # which may find more to learn
