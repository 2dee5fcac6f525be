"""The method as it was published: all scans first, then training (3QFP, ICRA 2024, section III).

What differs from triquad's own choices: a sample's label is its distance to the end along the ray,
whatever the surface's slope; half of the samples lie evenly within 0.3 m of the ends, the others
evenly from 0.3 of the ray to 0.8 m behind its end; the MLP begins with random weights. Samples are
drawn for each step, not once for all. The field and its loss are the paper's; the optimiser is
triquad's, whose rate falls. Where a mesh is made is decided by triquad's evidence, in place of the
paper's list of voxels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.pose import moved_pose
from triquad_format.records.region import MapProgress, MapRecord, seen_voxels
from triquad_server.engine.compiled_trainer import CompiledTrainer
from triquad_server.engine.field_record import region_record
from triquad_server.engine.gradient_sums import GradientSums
from triquad_server.engine.initial_mlp import random_mlp
from triquad_server.engine.live_field import Batch, LiveField
from triquad_server.engine.memory import memory_on
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.paper.intake import in_range, taken
from triquad_tools.recordings.cloud import thin
from triquad_tools.sensors.sweep import PosedScan, moved

DEPTH = 12
"""L_max: one region has all of a map."""

_BATCH, _RATE = 8192, 0.01
_BAND_M = 0.3  # around the ends of rays
_FREE_FROM = 0.3  # of the range
_BEHIND_M = 0.8
_THIN_M = 0.05
_ONLY: RegionIndex = (0, 0, 0)


@dataclass(frozen=True)
class _Rays:
    """Rays of all scans, metres, from the map's origin."""

    origins: Floats  # [R, 3]
    ends: Floats  # [R, 3]

    def batch(self, rng: np.random.Generator) -> Batch:
        """Return samples on some rays, and their signed distances along the ray."""
        chosen = rng.integers(len(self.ends), size=_BATCH)
        ways = self.ends[chosen] - self.origins[chosen]
        ranges = np.linalg.norm(ways, axis=1)
        near = rng.uniform(-_BAND_M, _BAND_M, _BATCH)
        free = rng.uniform((_FREE_FROM - 1.0) * ranges, _BEHIND_M)
        behind_m = np.where(rng.random(_BATCH) < 0.5, near, free)
        points = self.ends[chosen] + (behind_m / ranges)[:, None] * ways
        return Batch(points.astype(np.float32), -behind_m.astype(np.float32))


def published_map(
    scans: Sequence[PosedScan], settings: Settings, samples: int, teams: Teams
) -> MapRecord:
    """Return the map of scans by the published method.

    Args:
        scans: all of them; the map's one region reaches 409 m from its origin.
        settings: those of the field and the seed are used; the depth is ``DEPTH``.
        samples: on how many it is trained.
        teams: that compute it.

    Raises:
        ToolError: a point lies outside.
    """
    settings = settings.with_field(replace(settings.field, depth=DEPTH))
    evidence = Mapper("paper", settings, "cpu", teams=teams)
    for _ in taken(evidence, scans, len(scans)):
        pass
    rays = _rays(scans, evidence.origin)
    if [region.index for region in evidence.regions] != [_ONLY]:
        raise ToolError(
            "as published, a map has one region: its points lie within 400 m of its origin"
        )
    field = _untrained(evidence, settings.training.seed)
    trainer = CompiledTrainer(field, GradientSums(), teams.mapping)
    rng, steps = np.random.default_rng(settings.training.seed), -(-samples // _BATCH)
    with progress("training as published", steps) as report:
        for step in range(steps):
            trainer.train(rays.batch(rng), _RATE)
            report(step, f"{step * _BATCH / 1e6:.1f} M samples")
    (region,) = evidence.regions
    made = region_record(_ONLY, field, region.evidence.live)
    x, y, z = evidence.origin.tolist()
    trained = MapProgress(evidence.scans_taken, steps * _BATCH)
    return MapRecord("paper", 1, evidence.field, (made,), trained, (x, y, z))


def _rays(scans: Sequence[PosedScan], origin: Doubles) -> _Rays:
    """Return the rays of scans, from the map's origin [3]."""
    origins, ends = [], []
    for scan in scans:
        points = in_range(thin(np.asarray(scan.points, np.float64), _THIN_M))
        pose = moved_pose(scan.world_from_sensor, -origin)
        ends.append(moved(points, pose).astype(np.float32))
        origins.append(np.broadcast_to(pose[:3, 3].astype(np.float32), ends[-1].shape))
    return _Rays(np.concatenate(origins), np.concatenate(ends))


def _untrained(mapped: Mapper, seed: int) -> LiveField:
    """Return a field with random features where a map has surface, and a random MLP."""
    settings, generator = mapped.field, np.random.default_rng(seed)
    frequencies = generator.standard_normal(settings.frequencies, np.float32)
    frequencies *= np.float32(np.sqrt(settings.frequency_variance))
    mlp = random_mlp(settings, generator)
    field = LiveField(settings, frequencies, mlp, 0, generator, memory_on("cpu"))
    for region in mapped.regions:
        evidence = region.evidence.live.record()
        field.grow(seen_voxels(evidence, evidence.surface))
    return field
