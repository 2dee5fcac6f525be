"""A map moved into the frame of another one."""

from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation
from triquad_format.records import morton
from triquad_format.records.arrays import Bytes, Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS, RegionIndex
from triquad_format.records.pose import moved_pose
from triquad_format.records.region import BLOCK_BYTES, MapRecord, Region, no_evidence
from triquad_format.records.status import Status
from triquad_map.evidence.merged_evidence import merged_evidence
from triquad_map.opening import open_view
from triquad_map.questions.align import Alignment, align
from triquad_map.questions.distance import distances
from triquad_map.view import MapView
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings

from triquad_tools.console.command import ToolError, print_line
from triquad_tools.console.progress import progress
from triquad_tools.mapping.kept_rays import kept_ends, kept_scans
from triquad_tools.mapping.learning import learn
from triquad_tools.sensors.sweep import moved

_REACH_M = 2.0
"""Surfaces that a guess has farther from each other do not pull; as of ``client.align``."""

_POINTS = 20_000
"""The number of points among which those are chosen that both maps know."""

_BLOCKS_AT_ONCE = 2000  # of which the voxels are looked up

_ALL_RAYS = {
    "range_min_m": 0.0,
    "range_max_m": 1e4,
    "thin_m": 0.01,
    "max_points": 20_000_000,
}
"""Of scans that have been thinned: little but what several regions tell alike is left out."""


def aligned(record: MapRecord, other: MapRecord, guess: Doubles) -> Doubles:
    """Return where another map's frame is in a map's frame, so that their surfaces fit.

    Args:
        record: a map.
        other: the map to be moved, with its training state.
        guess: [4, 4] the frame of ``other`` in that of ``record``, off by at most some 2 m and 10
            degrees at the place that both have seen.

    Raises:
        ToolError: they do not fit there.
    """
    # Maps count from origins of their own.
    pose = _shift(-record.origin) @ guess @ _shift(other.origin)
    ends = kept_ends(other)
    ends = ends[:: -(-len(ends) // _POINTS)]
    with closing(open_view(record)) as view:
        both = distances(view, moved(ends, pose), _REACH_M).found
        if not both.any():
            raise ToolError(
                "the maps have no surface in common where --align has the other one: give a better "
                "guess of where it lies"
            )
        # Turned about the middle of what both know.
        middle = ends[both].mean(axis=0)
        found = align(view, ends[both] - middle, pose @ _shift(middle), _REACH_M)
    if not found.converged:
        raise ToolError(
            f"the maps do not fit near the guess of --align ({_told(found)}): give a better one, "
            "or map more of what both robots have seen"
        )
    exact = _shift(record.origin) @ found.world_from_sensor @ _shift(-middle - other.origin)
    off_m = float(np.linalg.norm(found.world_from_sensor[:3, 3] - moved(middle[None], pose)[0]))
    turned = Rotation.from_matrix(exact[:3, :3]).as_euler("xyz", degrees=True)
    print_line(
        "the other map lies at {:.3f} {:.3f} {:.3f}, roll pitch yaw ".format(*exact[:3, 3])
        + "{:.3f} {:.3f} {:.3f} degrees: ".format(*turned)
        + f"{off_m:.2f} m from the guess at the place that both know ({_told(found)})"
    )
    return exact


def moved_map(
    record: MapRecord, pose: Doubles, origin: Doubles, settings: Settings, teams: Teams
) -> MapRecord:
    """Return a map in another frame, learnt again.

    Its surface is that of the rays that it has kept, as from scans. Other voxels are free where
    their centres were, in regions that these rays reach: rays that met nothing are not kept.

    Args:
        record: a map with its training state.
        pose: [4, 4] its frame in the other one.
        origin: [3] from where the result counts, in the other frame.
        settings: of beliefs and training.
        teams: that compute it.
    """
    scan = settings.scan.model_copy(update=_ALL_RAYS)
    settings = settings.model_copy(update={"scan": scan, "sources": {}})
    pose = _shift(-origin) @ pose @ _shift(record.origin)
    mapper = Mapper(record.name, settings, "cpu", teams=teams)
    scans = kept_scans(record)
    with progress("moving", len(scans)) as report:
        for done, kept in enumerate(scans):
            points = (kept.ends - kept.origin).astype(np.float32)
            mapper.ingest(points, pose @ _shift(kept.origin), kept.stamp_s, local=True)
            report(done, f"{done} of {len(scans)} scans")
    learn(mapper)
    made = mapper.snapshot_since(None).record()
    with closing(open_view(record)) as view:
        space = _FreeSpace(view, record, pose)
        regions = tuple(space.added_to(region) for region in made.regions)
    x, y, z = origin.tolist()
    return replace(record, regions=regions, origin_m=(x, y, z))


@dataclass(frozen=True)
class _FreeSpace:
    """The free space of a map, in another frame."""

    view: MapView
    record: MapRecord
    pose: Doubles  # [4, 4] of the map's frame in the other one, from the origins of both

    @cached_property
    def _centres(self) -> Doubles:
        """Where the centres of the map's blocks are, [B, 3] in the other frame."""
        settings = self.record.settings
        side_m = BLOCK_VOXELS * settings.leaf_m
        blocks = [
            settings.region_corner(one.index)
            + side_m * (morton.decode(one.evidence.codes, 3) + 0.5)
            for one in self.record.regions
        ]
        return moved(np.concatenate(blocks), self.pose)

    def added_to(self, region: Region) -> Region:
        """Return a region of the other frame in which this is free, too."""
        codes = self._codes_near(region.index)
        masks = [np.zeros((0, BLOCK_BYTES), np.uint8)]
        for first in range(0, len(codes), _BLOCKS_AT_ONCE):
            masks.append(self._mask(codes[first : first + _BLOCKS_AT_ONCE], region.index))
        free = np.concatenate(masks)
        used = np.flatnonzero(free.any(axis=1))
        added = replace(
            no_evidence(),
            codes=codes[used],
            surface=np.zeros_like(free[used]),
            free=free[used],
            seen_s=np.zeros(len(used), np.int64),
        )
        none = np.zeros((0, 3), np.int64)
        return replace(region, evidence=merged_evidence(region.evidence, added, none))

    def _codes_near(self, index: RegionIndex) -> Longs:
        """Return the codes, in order, of the blocks of a region that blocks of the map may meet."""
        settings = self.record.settings
        sides = (1 << settings.depth) // BLOCK_VOXELS
        offsets = self._centres - settings.region_corner(index)
        cells = np.floor(offsets / (BLOCK_VOXELS * settings.leaf_m)).astype(np.int64)
        cells = np.unique(cells[((cells >= -1) & (cells <= sides)).all(axis=1)], axis=0)
        # Half the diagonal of a cube is less than its side.
        around = np.indices((3, 3, 3)).reshape(3, -1).T - 1
        near = (cells[:, None] + around).reshape(-1, 3)
        return np.unique(morton.encode(near[((near >= 0) & (near < sides)).all(axis=1)]))

    def _mask(self, codes: Longs, index: RegionIndex) -> Bytes:
        """Return the bits [B, BLOCK_BYTES] of voxels of blocks whose centres are free."""
        settings = self.record.settings
        inner = np.indices((BLOCK_VOXELS,) * 3).reshape(3, -1).T + 0.5
        voxels: Doubles = BLOCK_VOXELS * morton.decode(codes, 3)[:, None] + inner
        centres: Doubles = settings.region_corner(index) + settings.leaf_m * voxels.reshape(-1, 3)
        status = self.view.status(moved(centres, np.linalg.inv(self.pose)), 0.0)
        free = (status == Status.FREE).reshape(len(codes), -1)
        return np.packbits(free, axis=1, bitorder="little")


def _shift(by: Doubles) -> Doubles:
    """Return a pose [4, 4] that moves by [3], and does not turn."""
    return moved_pose(np.eye(4), by)


def _told(found: Alignment) -> str:
    return f"{found.inlier_share:.0%} of the points that both know fit, rms {found.rms_m:.3f} m"
