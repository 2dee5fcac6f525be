"""The kept rays of a region: those to train on, and those to judge its field with."""

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.region import TrainingState
from triquad_format.records.replay_rays import HELD_OUT
from triquad_map.field_fit import in_cube

from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.mapping.replay.held_out import are_held_out
from triquad_server.mapping.replay.kept_rays import KeptRays
from triquad_server.mapping.replay.ray_table import RayTable, samples_alone
from triquad_server.mapping.replay.replay_pool import ReplayPool
from triquad_server.mapping.replay.replay_record import restored_rays


class RegionRays:
    """Keeps rays, some of them held out from training, which is decided by where they end."""

    def __init__(self, setup: RegionSetup, seed: int) -> None:
        """Begin without rays and limit."""
        self._settings = setup.field
        self.pool = ReplayPool(setup.placement, setup.field, seed, setup.team)
        self.held_out = KeptRays(setup.field, np.random.default_rng(seed))

    @classmethod
    def restored(cls, state: TrainingState, setup: RegionSetup, seed: int) -> "RegionRays":
        """Restore the rays of a record."""
        rays = cls(setup, seed)
        rays.keep(restored_rays(state.rays, setup.field, setup.team))
        rays.pool.add(samples_alone(state.sample_points, state.sample_labels))
        return rays

    @property
    def table(self) -> RayTable:
        """Return a copy of all rays: those of the pool, then those that are held out."""
        trained, held = self.pool.table, self.held_out.table
        moved = np.where(held.origin_of >= 0, held.origin_of + len(trained.origins), held.origin_of)
        return RayTable(
            np.concatenate([trained.rows, held.rows]),
            np.concatenate([trained.origin_of, moved.astype(np.int32)]),
            np.concatenate([trained.origins, held.origins]),
        )

    @property
    def judging_ends(self) -> Floats:
        """Return where rays that are held out end [N, 3] in the region's cube, metres from its
        centre."""
        ends = self.held_out.table.ends
        return ends[in_cube(ends, self._settings)]

    def keep(self, rays: RayTable) -> Bools:
        """Keep rays [N]; return which of them are held out."""
        held = are_held_out(rays.rows, self._settings)
        self.held_out.add(rays.of(held))
        self.pool.add(rays.of(~held))
        return held

    def limit(self, rays: int) -> None:
        """Keep at most ``rays`` rays to train on, and a proportional number to judge with."""
        self.pool.limit(rays)
        self.held_out.limit(max(1, rays // HELD_OUT))

    def forget(self, low: Doubles, high: Doubles) -> None:
        """Drop the rays that end between two corners [3], metres from the region's centre."""
        self.pool.forget(low, high)
        self.held_out.forget(low, high)

    def forget_ends(self, voxels: Longs) -> None:
        """Drop the rays that end in ``voxels`` [N, 3]."""
        self.pool.forget_ends(voxels)
        self.held_out.forget_ends(voxels)
