"""A map moved into the frame of another one."""

from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Bytes, Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS, RegionIndex
from triquad_format.records.pose import moved_pose
from triquad_format.records.region import MapRecord, Region, no_evidence
from triquad_format.records.replay_rays import ReplayRays
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

_REACH_M = 2.0
"""Surfaces that a guess has farther from each other do not pull; as of ``client.align``."""

_POINTS = 20_000
"""The number of points among which those are chosen that both maps know."""

_BLOCKS_AT_ONCE = 2000  # of which the voxels are looked up

_TOGETHER_M = 1e-3
"""Rays whose origins differ by less come from one scan: each region tells of its own."""

_ALL_RAYS = {"range_min_m": 0.0, "range_max_m": 1e4, "thin_m": 1e-3}
"""Of scans that have been thinned: only what several regions tell alike is left out."""


@dataclass(frozen=True)
class KeptScan:
    """The rays of a scan that a map has kept, metres, from the map's origin."""

    origin: Doubles  # [3]
    ends: Doubles  # [N, 3]


def aligned(record: MapRecord, other: MapRecord, guess: Doubles) -> Doubles:
    """Return where another map's frame is in a map's frame, so that their surfaces fit.

    Args:
        record: a map.
        other: the map to be moved, with its training state.
        guess: [4, 4] the frame of ``other`` in that of ``record``, off by at most some 2 m
            and 10 degrees.

    Raises:
        ToolError: they do not fit there.
    """
    # Maps count from origins of their own.
    pose = _shift(-record.origin) @ guess @ _shift(other.origin)
    ends = np.concatenate([_ends(region, other) for region in other.regions])
    ends = ends[:: -(-len(ends) // _POINTS)]
    with closing(open_view(record)) as view:
        both = distances(view, _moved(pose, ends), _REACH_M).found
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
    x, y, z = exact[:3, 3]
    yaw_deg = np.degrees(np.arctan2(exact[1, 0], exact[0, 0]))
    print_line(f"the other map lies at {x:.3f} {y:.3f} {z:.3f} {yaw_deg:.2f} ({_told(found)})")
    return exact


def moved(
    record: MapRecord, pose: Doubles, origin: Doubles, settings: Settings, teams: Teams
) -> MapRecord:
    """Return a map in another frame, learnt again.

    Its surface is that of the rays that it has kept, as from scans. Other voxels are free where
    their centres were: rays that met nothing are not kept.

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
    scans = _kept_scans(record)
    with progress("moving", len(scans)) as report:
        for done, kept in enumerate(scans):
            points = (kept.ends - kept.origin).astype(np.float32)
            mapper.ingest(points, pose @ _shift(kept.origin), newest_s(record), local=True)
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

    def added_to(self, region: Region) -> Region:
        """Return a region of the other frame in which this is free, too."""
        codes = self._codes_near(region.index)
        free = np.concatenate(
            [
                self._mask(codes[first : first + _BLOCKS_AT_ONCE], region.index)
                for first in range(0, len(codes), _BLOCKS_AT_ONCE)
            ]
        )
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
        side_m = BLOCK_VOXELS * settings.leaf_m
        blocks = [
            settings.region_corner(one.index)
            + side_m * (morton.decode(one.evidence.codes, 3) + 0.5)
            for one in self.record.regions
        ]
        centres = _moved(self.pose, np.concatenate(blocks)) - settings.region_corner(index)
        cells = np.unique(np.floor(centres / side_m).astype(np.int64), axis=0)
        # Half the diagonal of a cube is less than its side.
        around = np.indices((3, 3, 3)).reshape(3, -1).T - 1
        near = (cells[:, None] + around).reshape(-1, 3)
        inside = ((near >= 0) & (near < (1 << settings.depth) // BLOCK_VOXELS)).all(axis=1)
        return np.unique(morton.encode(near[inside]))

    def _mask(self, codes: Longs, index: RegionIndex) -> Bytes:
        """Return the bits [B, BLOCK_BYTES] of voxels of blocks whose centres are free."""
        settings = self.record.settings
        inner = np.indices((BLOCK_VOXELS,) * 3).reshape(3, -1).T + 0.5
        voxels: Doubles = BLOCK_VOXELS * morton.decode(codes, 3)[:, None] + inner
        centres: Doubles = settings.region_corner(index) + settings.leaf_m * voxels.reshape(-1, 3)
        back = np.linalg.inv(self.pose).astype(np.float64)
        status = self.view.status(_moved(back, centres), 0.0)
        free = (status == Status.FREE).reshape(len(codes), -1)
        return np.packbits(free, axis=1, bitorder="little")


def learn(mapper: Mapper) -> None:
    """Train a map until nothing is left to learn."""
    total = mapper.samples_left
    with progress("training", total) as report:
        while not mapper.settled:
            mapper.train()
            report(total - mapper.samples_left, f"{mapper.samples_trained / 1e6:.1f} M samples")


def newest_s(record: MapRecord) -> int:
    """Return when a map was seen last, seconds since 1970."""
    return max(int(region.evidence.seen_s.max(initial=0)) for region in record.regions)


def _kept_scans(record: MapRecord) -> list[KeptScan]:
    """Return the rays of a map by the scans that they come from."""
    starts = np.concatenate([_starts(region, record) for region in record.regions])
    ends = np.concatenate([_ends(region, record) for region in record.regions])
    cells = np.round(starts / _TOGETHER_M).astype(np.int64)
    _, first, scan_of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(scan_of.ravel(), kind="stable")
    parts = np.split(ends[order], np.cumsum(np.bincount(scan_of.ravel()))[:-1])
    return [KeptScan(starts[row], some) for row, some in zip(first, parts, strict=True)]


def _starts(region: Region, record: MapRecord) -> Doubles:
    rays = _rays(region)
    centre = record.settings.region_centre(region.index)
    return centre + rays.origins[rays.origin_of].astype(np.float64)


def _ends(region: Region, record: MapRecord) -> Doubles:
    return record.settings.region_centre(region.index) + _rays(region).ends_m(record.settings)


def _rays(region: Region) -> ReplayRays:
    assert region.training is not None, "it was checked"
    return region.training.rays


def _shift(by: Doubles) -> Doubles:
    """Return a pose [4, 4] that moves by [3], and does not turn."""
    return moved_pose(np.eye(4), by)


def _moved(pose: Doubles, points: Doubles) -> Doubles:
    moved_points: Doubles = points @ pose[:3, :3].T + pose[:3, 3]
    return moved_points


def _told(found: Alignment) -> str:
    return f"{found.inlier_share:.0%} of the points that both know fit, rms {found.rms_m:.3f} m"
