"""``python -m bench.studies.revisited FOLDER``: what a map keeps of a drive that is mapped twice.

Things move there, and nobody knows which. What several scans saw should stay; what a single one
saw, and later ones passed, may well have moved.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.status import Status
from triquad_map.view import MapView
from triquad_server.intake.rays import usable_rays
from triquad_server.settings import Settings
from triquad_tools.console.command import ToolError, run
from triquad_tools.console.progress import progress
from triquad_tools.console.report import Row, print_rows
from triquad_tools.recordings.cloud import points_in_range
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder
from triquad_tools.sensors.sweep import PosedScan

from bench.ended_voxels import NO_VOXEL, end_keys, voxel_centres
from bench.figures import Figure
from bench.street import StreamedMap, learn_all

_ROUNDS = 2
_SKIP_EVERY = 7
_RANGE_MIN_M = 2.0  # nearer is the vehicle's own body


@dataclass(frozen=True)
class RecordedScans:
    """Scans of a recorded drive: those to map, and those to withhold."""

    mapped: tuple[PosedScan, ...]
    withheld: tuple[PosedScan, ...]


def recorded_scans(path: Path, scans: int | None = None) -> RecordedScans:
    """Return the scans of a folder (the first ``scans`` of them), every 7th apart.

    Raises:
        ToolError: the folder cannot be read.
    """
    folder = read_cloud_folder(path)
    mapped: list[PosedScan] = []
    withheld: list[PosedScan] = []
    indices = range(len(folder))[:scans]
    for index, whole in zip(indices, folder.read(indices), strict=True):
        near = points_in_range(whole.points, _RANGE_MIN_M)
        scan = PosedScan(near, whole.world_from_sensor)
        (withheld if index % _SKIP_EVERY == _SKIP_EVERY - 1 else mapped).append(scan)
    return RecordedScans(tuple(mapped), tuple(withheld))


@dataclass(frozen=True)
class Revisited:
    """The share of voxels where rays ended that a settled map keeps, and its errors elsewhere."""

    kept: float  # the share of voxels in which rays ended that are taken to be surface
    kept_of_several: float  # of those in which rays of at least two scans of one round ended
    error_m: float  # median distance from the surface of the points of withheld scans


def measure_revisited(path: Path) -> list[Figure]:
    """Return figures of a recorded folder, with contradicted surface removed and without.

    Raises:
        ToolError: the folder cannot be read, or has too few scans.
    """
    scans, usual = recorded_scans(path), Settings()
    if not scans.withheld:
        raise ToolError(f"{path}: {len(scans.mapped)} scans are too few, as every 7th is withheld")
    still = usual.model_copy(update={"change": usual.change.model_copy(update={"static": True})})
    found = revisit(scans, usual, path.name)
    still_cm = 100 * revisit(scans, still, f"{path.name}, nothing removed").error_m
    return [
        Figure("voxels lost", 100 * (1 - found.kept), "%"),
        Figure("lost of those that several scans saw", 100 * (1 - found.kept_of_several), "%"),
        Figure("error at unseen points, median", 100 * found.error_m, "cm"),
        Figure("the same where nothing is removed", still_cm, "cm"),
    ]


def revisit(scans: RecordedScans, settings: Settings, name: str) -> Revisited:
    """Map a recorded drive repeatedly, and compare the map with where rays ended."""
    streamed, ended = StreamedMap(settings), list[Longs]()  # the voxels in which each scan ended
    rounds = _ROUNDS * scans.mapped
    with progress(f"mapping {name}", len(rounds) + 1) as report:
        for number, scan in enumerate(rounds):
            if number < len(scans.mapped):
                ended.append(np.setdiff1d(end_keys(scan, settings), NO_VOXEL))
            streamed.take_in(scan)
            report(number, f"scan {number}")
        learn_all(streamed.mapper)
        report(len(rounds) + 1, "settled")
    epoch = streamed.mapper.publish()
    keys, seen_by = np.unique(np.concatenate(ended), return_counts=True)
    kept, kept_of_several = (
        _surface_share(epoch, voxel_centres(keys[seen_by >= scans_of], epoch.voxel_m))
        for scans_of in (1, 2)
    )
    off_m = np.abs(epoch.query(_unseen_points(scans, settings)).sdf)
    return Revisited(kept, kept_of_several, error_m=float(np.nanmedian(off_m)))


def _unseen_points(scans: RecordedScans, settings: Settings) -> Doubles:
    """Return the points [N, 3] of withheld scans that a map would use, map frame."""
    rays = (usable_rays(s.points, s.world_from_sensor, settings.scan) for s in scans.withheld)
    return np.concatenate([of_scan.ends for of_scan in rays])


def _surface_share(view: MapView, centres: Doubles) -> float:
    """Return the share of voxels with ``centres`` [N, 3] that a map takes to be surface."""
    return float((view.status(centres, reach_m=0.0) == Status.SURFACE).mean())


def main(argv: Sequence[str] | None = None) -> int:
    """Measure a recorded folder, and print the figures."""
    parser = argparse.ArgumentParser(prog="revisited", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="of scans with poses")
    options = parser.parse_args(argv)
    return run("revisited", partial(_print_figures, options.folder))


def _print_figures(folder: Path) -> int:
    figures = measure_revisited(folder)
    print_rows(folder.name, [Row(one.name, one.shown) for one in figures])
    return 0


if __name__ == "__main__":
    sys.exit(main())
