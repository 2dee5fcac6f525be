"""The scans of a recording in files that each worker can read apart, with where they reach."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from triquad_format.mapfile.files import replacing
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.region_reach import regions_between

from triquad_tools.recordings.recording import ScanEntry
from triquad_tools.sensors.sweep import PosedScan


class RegionBox(NamedTuple):
    """The regions that a scan may reach, as ranges of their indices along each axis."""

    x: range
    y: range
    z: range

    @classmethod
    def of(cls, rays: ScanRays, field: FieldSettings) -> "RegionBox":
        """Return the regions that the box around some rays meets."""
        corners = np.concatenate([rays.ends, rays.origin[None], rays.free_corners])
        return cls(*regions_between(corners, field))

    def has(self, index: RegionIndex) -> bool:
        """Return whether a region is among them."""
        return index[0] in self.x and index[1] in self.y and index[2] in self.z


@dataclass(frozen=True)
class CutScan:
    """A scan in a file."""

    file: Path
    box: RegionBox
    digest: bytes  # of all that it says


class StoredScan(NamedTuple):
    """A scan as a file has it."""

    points: Floats  # [N, 3] metres, sensor frame
    world_from_sensor: Doubles  # [4, 4]
    no_return: Floats | None  # [M, 3] directions of rays that met nothing
    stamp_ns: int
    source: str

    @classmethod
    def of(cls, entry: ScanEntry, scan: PosedScan) -> "StoredScan":
        """Return a scan of a recording."""
        points = np.ascontiguousarray(scan.points, np.float32)
        pose = np.ascontiguousarray(scan.world_from_sensor, np.float64)
        given = scan.no_return
        no_return = None if given is None else np.ascontiguousarray(given, np.float32)
        return cls(points, pose, no_return, entry.stamp_ns, entry.source)

    @property
    def digest(self) -> bytes:
        """Return a digest of all that it says."""
        found = hashlib.sha256(f"{self.stamp_ns} {self.source}".encode())
        for array in (self.points, self.world_from_sensor, self.no_return):
            found.update(b"" if array is None else array.tobytes())
        return found.digest()


def write_scans(path: Path, scans: dict[int, StoredScan]) -> None:
    """Write scans by their numbers."""
    arrays: dict[str, Any] = {
        f"{number} {name}": np.asarray(value)
        for number, scan in scans.items()
        for name, value in scan._asdict().items()
        if value is not None
    }
    with replacing(path) as stream:
        np.savez(stream, **arrays)


def read_scans(cut: Sequence[tuple[int, Path]]) -> Iterator[StoredScan]:
    """Yield scans of these numbers; those of one file follow each other."""
    for file, numbered in groupby(cut, key=itemgetter(1)):
        with np.load(file) as arrays:
            for number, _ in numbered:
                no_return = f"{number} no_return"
                yield StoredScan(
                    arrays[f"{number} points"],
                    arrays[f"{number} world_from_sensor"],
                    arrays.get(no_return),
                    stamp_ns=int(arrays[f"{number} stamp_ns"]),
                    source=str(arrays[f"{number} source"]),
                )
