"""The kept rays of a region: those to train on, and those to judge its field with."""

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.region import TrainingState
from triquad_format.records.replay_rays import HELD_OUT
from triquad_map.field_fit import in_cube
from triquad_map.surface import FLATTEST, ON_SURFACE

from triquad_server.engine.live_field import Batch, LiveField
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.mapping.replay.kept_rays import KeptRays
from triquad_server.mapping.replay.ray_table import (
    END,
    LEAST_SLOPE,
    VALUE,
    RayTable,
    draw_ordered_samples,
    samples_alone,
)
from triquad_server.mapping.replay.replay_record import are_held_out, restored_rays

_NONE = np.zeros(0, np.int64)


class RegionRays:
    """Keeps rays, some of them held out from training, which is decided by where they end."""

    def __init__(self, setup: RegionSetup, seed: int, state: TrainingState | None = None) -> None:
        """Begin without limit, with the rays of a record, or without any."""
        self._setup = setup
        self._placement = setup.placement
        self._random = np.random.default_rng(seed)
        self.pool = KeptRays(setup.field, self._random)  # to train on, and samples without a ray
        self.held_out = KeptRays(setup.field, np.random.default_rng(seed))
        self._fresh = _NONE  # places in the pool of the newest rays
        if state is not None:
            self.keep(restored_rays(state.rays, setup.field, setup.team))
            self.pool.add(samples_alone(state.sample_points, state.sample_labels))

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
        return ends[in_cube(ends, self._setup.field)]

    def keep(self, rays: RayTable) -> Bools:
        """Keep rays [N], which are the newest; return which of them are held out."""
        held = are_held_out(rays.rows, self._setup.field)
        self.held_out.add(rays.of(held))
        self._fresh = self.pool.add(rays.of(~held))
        return held

    def draw(self, count: int, fresh: int) -> Batch:
        """Draw ``count`` samples on rays at random, ``fresh`` of them on the newest."""
        places = self._at_random(count, fresh)
        return draw_ordered_samples(
            self.pool.table, places, self._placement, self._random, self._setup.team
        )

    def set_slopes(self, field: LiveField, count: int, fresh: int) -> None:
        """Set slopes that no normal gave by the gradient of the field that learns from the rays.

        On edges and on small things the points around give no normal. With distances along the ray
        as its labels, a ray teaches there a field that is too steep; but the direction of its
        gradient is right. Of ``count`` rays that are drawn, ``fresh`` of them among the newest,
        those are taken that end in the cube: elsewhere a field knows no surface.
        """
        table, places = self.pool.table, np.unique(self._at_random(count, fresh))
        is_unsure = (table.rows[places, VALUE] < 0) & (table.origin_of[places] >= 0)
        is_unsure &= in_cube(table.rows[places, END : END + 3], self._setup.field)
        places = places[is_unsure]
        if len(places) == 0:
            return
        ends = np.ascontiguousarray(table.rows[places, END : END + 3])
        values = field.live_view().evaluate(ends, gradient=True)
        steepness = np.linalg.norm(values.gradient, axis=1)
        is_learnt = np.abs(values.sdf) < ON_SURFACE * self._setup.field.leaf_m
        is_learnt &= steepness > FLATTEST
        ways = ends - table.origins[table.origin_of[places]]
        lengths = np.linalg.norm(ways, axis=1) * steepness
        slopes = np.abs((ways * values.gradient).sum(axis=1)) / np.maximum(lengths, 1e-9)
        table.rows[places[is_learnt], VALUE] = -slopes[is_learnt].clip(LEAST_SLOPE, 1)

    def limit(self, rays: int) -> None:
        """Keep at most ``rays`` rays to train on, and a proportional number to judge with."""
        if len(self.pool) > rays:
            self._fresh = _NONE
        self.pool.limit(rays)
        self.held_out.limit(max(1, rays // HELD_OUT))

    def forget(self, low: Doubles, high: Doubles) -> None:
        """Drop the rays that end between two corners [3], metres from the region's centre."""
        self.pool.forget(low, high)
        self.held_out.forget(low, high)
        self._fresh = _NONE

    def forget_ends(self, voxels: Longs) -> None:
        """Drop the rays that end in ``voxels`` [N, 3]."""
        self.pool.forget_ends(voxels)
        self.held_out.forget_ends(voxels)
        self._fresh = self._fresh[self._fresh < len(self.pool)]

    def _at_random(self, count: int, fresh: int) -> Longs:
        """Draw places [count] in the pool at random, ``fresh`` of them of the newest rays."""
        places: Longs = self._random.integers(len(self.pool), size=count)
        if fresh and len(self._fresh):
            places[:fresh] = self._fresh[self._random.integers(len(self._fresh), size=fresh)]
        return places
