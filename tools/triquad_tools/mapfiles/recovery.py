"""Recovery of what is intact in a damaged map file, as a valid map; and what is lost, and where.

Where the manifest is intact, it says what each part is and what is missing; else the parts say it
themselves.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_format.errors import FormatError, MapFileError
from triquad_format.mapfile.files import named
from triquad_format.mapfile.parts import part
from triquad_format.mapfile.parts.region_parts import RegionParts
from triquad_format.mapfile.record_check import check_record
from triquad_format.records import morton
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.leaf_box import LeafBox
from triquad_format.records.region import AXES, MapRecord, Region, masked, seen_voxels

from triquad_tools.mapfiles.crop import status_voxels
from triquad_tools.mapfiles.intact_parts import IntactParts, intact_parts

STATUS_REACH_LEAVES = 2
"""Leaves beyond lost vertices in which a status may change: voxels that have an effect there are
dropped whole, and had an effect half a leaf beyond."""


@dataclass(frozen=True)
class Loss:
    """A part that is lost, and the box in which the map has lost something by it.

    Without a part ``/triquad/region`` all of the region is lost; without vertices the distances
    in a square column; without evidence the status in a cube. One part ``/triquad/training``
    stands for all of a region's training state.
    """

    key: part.PartKey
    minimum: Doubles  # [3] metres, map frame
    maximum: Doubles  # [3]


@dataclass(frozen=True)
class RecoveredMap:
    """The saved part of a map, and a list of what was not saved."""

    record: MapRecord
    losses: tuple[Loss, ...]  # those that are known
    parts_intact: int  # parts of regions that could be read
    parts_listed: int | None  # how many there were; None: not known, for the manifest is lost
    stamp_ns: int  # when the epoch was written, nanoseconds since 1970; 0 if not known

    @property
    def complete(self) -> bool:
        """True where nothing was lost."""
        return not self.losses and self.parts_intact == self.parts_listed


def recover(path: Path) -> RecoveredMap:
    """Return all that is intact in a map file, damaged in any way, or of a checkpoint in its store.

    The result is valid. It answers as the whole map did wherever no loss reaches. Where vertices
    are lost, evidence goes with them: so nothing there passes for known. Training state stays
    where all of a region's is intact.

    Raises:
        MapFileError: nothing could be saved, or the file needs a newer reader.
        OSError: it cannot be read.
    """
    with named(str(path)):
        recovered = _recovered(intact_parts(path))
        if not recovered.record.regions and not recovered.complete:
            raise MapFileError("nothing can be saved: no region is intact")
        return recovered


def _recovered(found: IntactParts) -> RecoveredMap:
    settings = found.facts.settings
    regions: list[Region] = []
    lost: set[part.PartKey] = set()
    all_missing = found.listed - found.payloads.keys()
    for index in dict.fromkeys(key.region for key in (*found.payloads, *sorted(all_missing))):
        payloads = {key: data for key, data in found.payloads.items() if key.region == index}
        missing = {key for key in all_missing if key.region == index}
        region = _region(index, settings, payloads, missing=missing)
        if region is None:
            lost.add(part.PartKey(part.REGION, index))
            continue
        if found.manifest is None:
            missing |= _missing_squares(settings, region, payloads)
        lost |= {key for key in missing if key.topic in part.FIELD_TOPICS}
        had_training = any(key.topic in part.TRAINING_TOPICS for key in (*payloads, *missing))
        if had_training and region.training is None:
            lost.add(part.PartKey(part.TRAINING, index))
        regions.append(region)
    regions = _masked_where_lost(settings, regions, lost)
    record = dataclasses.replace(found.facts, regions=tuple(regions))
    losses = [
        Loss(key, *(record.origin + _status_box(key, settings)))
        for key in sorted(lost, key=lambda key: (key.region, key))
    ]
    return RecoveredMap(
        record,
        tuple(losses),
        parts_intact=len(found.payloads),
        parts_listed=None if found.manifest is None else len(found.listed),
        stamp_ns=0 if found.manifest is None else found.manifest.stamp_ns,
    )


def _region(
    index: RegionIndex,
    settings: FieldSettings,
    payloads: Mapping[part.PartKey, bytes],
    *,
    missing: set[part.PartKey],
) -> Region | None:
    choices = [part.REGION_TOPICS, part.FIELD_TOPICS]
    if any(key.topic in (part.VERTICES, *part.TRAINING_TOPICS) for key in missing):
        choices = [part.FIELD_TOPICS]
    for topics in choices:
        parts = RegionParts(index, settings)
        try:
            for key, payload in payloads.items():
                if key.topic in topics:
                    parts.add(key, payload)
            region = parts.region()
            check_record(MapRecord("recovered", 0, settings, regions=(region,)))
        except FormatError:
            continue
        return region
    return None


def _missing_squares(
    settings: FieldSettings, region: Region, payloads: Mapping[part.PartKey, bytes]
) -> set[part.PartKey]:
    """Return squares that had vertices: every node with a seen surface has its four corners."""
    if settings.encoding == "fourier":
        return set()
    voxels = seen_voxels(region.evidence, region.evidence.surface)
    needed = set()
    for table in region.tables:
        shift = settings.depth - table.level
        nodes = np.unique(voxels[:, list(AXES[table.plane])] >> shift, axis=0)
        for corner in np.ndindex(2, 2):
            leaves = (nodes + corner) << shift
            squares = np.unique(morton.encode(leaves // part.CELL_LEAVES)).tolist()
            needed |= {
                part.PartKey(part.VERTICES, region.index, plane=table.plane, cell=cell)
                for cell in squares
            }
    return needed - payloads.keys()


def _masked_where_lost(
    settings: FieldSettings, regions: list[Region], lost: set[part.PartKey]
) -> list[Region]:
    """Return the regions without evidence where vertices are lost, their own or a neighbour's."""
    vertices = [key for key in lost if key.topic == part.VERTICES]
    boxes = np.array([_status_box(key, settings) for key in vertices]).reshape(-1, 2, 3)
    masked_regions = []
    for region in regions:
        evidence, centre = region.evidence, settings.region_centre(region.index)
        reach_m = settings.region_side_m / 2
        below, above = boxes[:, 0] <= centre + reach_m, boxes[:, 1] >= centre - reach_m
        for number in np.flatnonzero((below & above).all(axis=1)).tolist():
            corners = _effect_box(vertices[number], settings)
            box = LeafBox(*settings.leaf_coordinates(corners - centre))
            evidence = masked(evidence, ~status_voxels(evidence, box))
        masked_regions.append(dataclasses.replace(region, evidence=evidence))
    return masked_regions


def _status_box(key: part.PartKey, settings: FieldSettings) -> Doubles:
    """Return corners [2, 3], from the origin, of the box of all whose status a loss may change."""
    reach_m = STATUS_REACH_LEAVES * settings.leaf_m
    return _effect_box(key, settings) + [[-reach_m], [reach_m]]


def _effect_box(key: part.PartKey, settings: FieldSettings) -> Doubles:
    """Return corners [2, 3], from the origin, of the box in which a part has an effect itself."""
    box = part.extent(settings, key)
    if key.topic == part.VERTICES:
        # A vertex has an effect as far as the side of its level's nodes; those at the upper border
        # of a square belong to the next.
        box.low[list(AXES[key.plane])] -= part.vertex_reach(settings)
    corner = settings.region_corner(key.region)
    return corner + np.stack([box.low, box.high]) * settings.leaf_m
