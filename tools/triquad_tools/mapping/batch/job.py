"""The tasks that workers do.

Each is a function of what it is given and of files that all workers read: where one fails, another
does it again.
"""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from triquad_format.mapfile.writer import write_map
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import MapProgress, MapRecord
from triquad_format.wire.messages import Scan
from triquad_server.errors import ScanRefusedError
from triquad_server.intake.map_origin import first_origin
from triquad_server.intake.rays import ScanRays, usable_rays
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.region_reach import regions_around
from triquad_server.process.threads import Teams
from triquad_server.settings import ANY_SOURCE, Settings

from triquad_tools.console.command import ToolError
from triquad_tools.mapping.batch.cut_scans import (
    CutScan,
    RegionBox,
    StoredScan,
    read_scans,
    write_scans,
)
from triquad_tools.mapping.mapping_run import MAP_NAME
from triquad_tools.recordings.opening import Selection

_WATCHED_SCANS = 50  # whose warnings are told before the work begins
_NO_ROOM = ("map_full", "no_memory")  # reasons for which scans of a region are refused
_SCANS_EACH = 64  # of a file: some 20 MB


@dataclass(frozen=True)
class Place:
    """How the regions of a map are made."""

    settings: Settings
    origin_m: tuple[float, float, float]  # from where the map counts

    def rays(self, scan: StoredScan) -> ScanRays:
        """Return what is used of a scan.

        Raises:
            ScanRefusedError: nothing is.
        """
        source = self.settings.sources.get(scan.source, ANY_SOURCE)
        return usable_rays(
            scan.points,
            scan.world_from_sensor,
            self.settings.scan_of(source),
            source=source,
            no_return=scan.no_return,
            map_origin=np.array(self.origin_m),
        )

    def mapper(self, region: RegionIndex, teams: Teams) -> Mapper:
        """Return an empty map that has one region only."""
        begun = MapProgress(scans_taken=1)  # elsewhere: so it has its origin
        whole = MapRecord(MAP_NAME, 0, self.settings.field, (), begun, self.origin_m)
        mapper = Mapper(MAP_NAME, self.settings, "cpu", whole, teams)
        return mapper.other(None, frozenset({region}))


class Refusal(NamedTuple):
    """Why a scan cannot be used."""

    reason: str  # the short key under which it is counted
    text: str


@dataclass(frozen=True)
class Cut:
    """Some scans of a recording, in files."""

    made: frozenset[RegionIndex]  # regions in which their rays end, or begin
    scans: dict[int, CutScan]  # that can be used, by their numbers
    refused: dict[int, Refusal]  # why the others cannot


def place_of(selection: Selection, settings: Settings) -> Place:
    """Return how a recording is mapped: the first scan that can be used chooses the origin.

    What its first scans warn of is logged.

    Raises:
        ToolError: none of its scans can be used.
    """
    warnings, told = ScanWarnings(ScanQueue(1), settings), ""
    place: Place | None = None
    for number, (entry, scan) in enumerate(zip(selection.entries, selection.scans(), strict=True)):
        if place is not None and number >= _WATCHED_SCANS:
            break
        given = StoredScan.of(entry, scan)
        pose = given.world_from_sensor
        chosen = place or Place(settings, tuple(first_origin(pose).tolist()))
        try:
            rays = chosen.rays(given)
        except ScanRefusedError as error:
            told = f"scan {number}: {error}"
            continue
        place = chosen
        warnings.add(Scan(given.points, pose, entry.stamp_ns, entry.source, 0, 0), rays)
        warnings.check()
    if place is None:
        raise ToolError(f"nothing was mapped: no scan can be used; the last: {told}")
    return place


def cut(selection: Selection, place: Place, numbers: Sequence[int], folder: Path) -> Cut:
    """Write the scans of these numbers into files, and find what they reach."""
    field, entries = place.settings.field, selection.entries
    made, scans = set[RegionIndex](), dict[int, CutScan]()
    refused, waiting = dict[int, Refusal](), dict[int, StoredScan]()
    file = folder / f"scans-{numbers[0]}.npz"
    for number, scan in zip(numbers, selection.read(numbers), strict=True):
        given = StoredScan.of(entries[number], scan)
        try:
            rays = place.rays(given)
        except ScanRefusedError as error:
            refused[number] = Refusal(error.reason, f"scan {number}: {error}")
            continue
        made.update(regions_around(rays, (), field))
        scans[number] = CutScan(file, RegionBox.of(rays, field), given.digest)
        waiting[number] = given
        if len(waiting) == _SCANS_EACH:
            write_scans(file, waiting)
            waiting, file = {}, folder / f"scans-{number + 1}.npz"
    if waiting:
        write_scans(file, waiting)
    return Cut(frozenset(made), scans, refused)


def mapped(place: Place, region: RegionIndex, scans: Sequence[tuple[int, Path]], to: Path) -> None:
    """Map a region by the scans that may reach it, and write it as a map file.

    Raises:
        ToolError: there is no memory for it.
    """
    with closing(Teams()) as teams:
        mapper = place.mapper(region, teams)
        for points, pose, no_return, stamp_ns, source in read_scans(scans):
            try:
                mapper.ingest(points, pose, stamp_ns // 10**9, source=source, no_return=no_return)
            except ScanRefusedError as error:
                if error.reason in _NO_ROOM:
                    raise ToolError(f"no worker can map region {region}: {error}") from error
            mapper.train()
        mapper.publish()
        while not mapper.settled:
            mapper.train()
        record = mapper.snapshot_since(None).record()
    write_map(record, to)
