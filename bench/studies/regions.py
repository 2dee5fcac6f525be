"""``python -m bench.studies.regions``: how large the regions of a map had better be.

Maps of places that nothing was tuned on are made with regions of several sizes: streets with the
first region's middle in theirs, as a map begins, and with a border of regions along it, a room, and
a table.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from triquad_client import OfflineMap
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import moved_pose
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings.loading import load_settings
from triquad_tools.console.report import Row, print_rows
from triquad_tools.evaluation.metrics import MeshScores, ScoreSettings
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive
from triquad_tools.simulation.street import street_drive

from bench.driven import Driven, driven
from bench.figures import Figure
from bench.scenes.room import room_by_camera, room_by_lidar
from bench.scenes.tabletop import tabletop_by_camera
from bench.street import learn_all

_DEPTHS = (12, 11, 10, 9)  # 4096 to 512 leaves at a side
_SEED = 61  # of all places
_SCANS = 100
_EPOCHS_EVERY = 20  # scans: an epoch is timed while the map is made


@dataclass(frozen=True)
class Place:
    """A place, and how its map is made and scored."""

    name: str
    preset: str
    make: Callable[[int], SimulatedDrive]  # for a seed
    scores: ScoreSettings
    on_border: bool = False  # whether it lies along a border of regions


_LIDAR = Lidar(columns=1024)
_STREET = partial(street_drive, scans=_SCANS, step_m=1.1, length_m=110.0, sensor=_LIDAR)
_WITHIN_10CM = ScoreSettings(voxel_m=0.05)
_WITHIN_2CM = ScoreSettings(threshold_m=0.02, voxel_m=0.01)
_WITHIN_1CM = ScoreSettings(threshold_m=0.01, voxel_m=0.0025)

PLACES = (
    Place("street", "street", _STREET, _WITHIN_10CM),
    Place("street on a border", "street", _STREET, _WITHIN_10CM, on_border=True),
    Place("room, camera", "indoor", partial(room_by_camera, scans=_SCANS), _WITHIN_2CM),
    Place("room, lidar", "indoor", partial(room_by_lidar, scans=_SCANS), _WITHIN_2CM),
    Place("table, camera", "tabletop", partial(tabletop_by_camera, scans=_SCANS), _WITHIN_1CM),
)


def measure(place: Place, made: Driven, depth: int) -> list[Figure]:
    """Return figures of the map of a place with regions of ``2**depth`` leaves at a side."""
    settings = load_settings(assignments=[f"field.depth={depth}"], preset=place.preset)
    offset = np.zeros(3)
    if place.on_border:
        offset[1] = settings.field.region_pitch_m / 2
    mapper = Mapper("regions", settings, "cpu")
    began_s, epochs_s = time.process_time(), list[float]()
    for number, scan in enumerate(made.scans, 1):
        mapper.ingest(scan.points, moved_pose(scan.world_from_sensor, offset))
        if number % _EPOCHS_EVERY == 0:
            before_s = time.process_time()
            mapper.publish()
            epochs_s.append(time.process_time() - before_s)
    taken_s = time.process_time() - began_s - sum(epochs_s)
    learn_all(mapper)
    learnt_s = time.process_time() - began_s - taken_s - sum(epochs_s)
    epoch = mapper.publish()
    scores = _scores(epoch, made, place.scores, offset)
    name = f"{place.name}, {settings.field.region_side_m:g} m"
    return [
        Figure(f"{name}: regions", epoch.regions, ""),
        Figure(f"{name}: F", 100 * scores.f_score, "%"),
        Figure(f"{name}: accuracy", 100 * scores.accuracy_m, "cm"),
        Figure(f"{name}: parameters", epoch.parameters / 1e6, "M"),
        Figure(f"{name}: taking in a scan", 1e3 * taken_s / len(made.scans), "ms"),
        Figure(f"{name}: learning all", learnt_s, "s"),
        Figure(f"{name}: an epoch on the way", 1e3 * statistics.median(epochs_s), "ms"),
    ]


def _scores(epoch: Epoch, made: Driven, settings: ScoreSettings, offset: Doubles) -> MeshScores:
    low, high = (made.drive.scene.bounds + offset).tolist()
    with OfflineMap(epoch.record()) as opened:
        mesh = opened.mesh((low, high))
    return made.mesh_scores(replace(mesh, vertices=mesh.vertices - offset), settings)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure places, and print their figures."""
    parser = argparse.ArgumentParser(prog="regions", description=__doc__)
    parser.add_argument("--seed", type=int, default=_SEED)
    options = parser.parse_args(argv)
    for place in PLACES:
        made = driven(place.make(options.seed), place.scores.voxel_m, place.name)
        figures = [one for depth in _DEPTHS for one in measure(place, made, depth)]
        print_rows(place.name, [Row(one.name, one.shown, one.verdict) for one in figures])
    return 0


if __name__ == "__main__":
    sys.exit(main())
