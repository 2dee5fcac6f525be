"""Draws samples on the rays that a region keeps to train on."""

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.team import Team

from triquad_server.engine.live_field import Batch
from triquad_server.mapping.replay.kept_rays import KeptRays
from triquad_server.mapping.replay.ray_table import (
    END,
    VALUE,
    Placement,
    RayTable,
    draw_ordered_samples,
)

_NONE = np.zeros(0, np.int64)


class ReplayPool(KeptRays):
    """Keeps rays of one region, and draws samples on them."""

    def __init__(
        self, placement: Placement, settings: FieldSettings, seed: int, team: Team
    ) -> None:
        """Begin without rays and limit; ``team`` draws samples on them."""
        super().__init__(settings, np.random.default_rng(seed))
        self._team = team
        self.placement = placement
        self._fresh = _NONE  # places of the newest

    def add(self, new: RayTable, fresh: bool = True) -> Longs:
        """Take in rays; return their places [N]; if ``fresh``, they become the newest."""
        places = super().add(new)
        if fresh:
            self._fresh = places
        return places

    def draw(self, count: int, fresh: int) -> Batch:
        """Draw ``count`` samples on rays at random, ``fresh`` of them on the newest."""
        return self.draw_on(self._at_random(count, fresh))

    def draw_on(self, places: Longs) -> Batch:
        """Draw a sample on each of the rays of :attr:`table` at ``places`` [N]."""
        return draw_ordered_samples(
            self.table, places, self.placement, rng=self._rng, team=self._team
        )

    def unsure(self, count: int, fresh: int) -> Longs:
        """Return the places of rays whose slope no normal gave, among ``count`` that are drawn on.

        They end in the cube: elsewhere a field knows no surface.
        """
        places, table = np.unique(self._at_random(count, fresh)), self.table
        is_unsure = (table.rows[places, VALUE] < 0) & (table.origin_of[places] >= 0)
        ends = table.rows[places, END : END + 3]
        is_unsure &= (np.abs(ends) < self.placement.half_side_m).all(axis=1)
        unsure: Longs = places[is_unsure]
        return unsure

    def set_slopes(self, places: Longs, slopes: Doubles) -> None:
        """Set the ``slopes`` [N] of the rays at ``places`` [N], which no normal gave."""
        self.table.rows[places, VALUE] = -slopes

    def limit(self, capacity: int) -> None:
        """Change the capacity; surplus rays are removed at random."""
        is_too_much = len(self) > capacity
        super().limit(capacity)
        if is_too_much:
            self._fresh = _NONE

    def forget(self, low: Doubles, high: Doubles) -> None:
        """Drop the rays that end between two corners [3], metres from the region's centre."""
        super().forget(low, high)
        self._fresh = _NONE

    def forget_ends(self, voxels: Longs) -> None:
        """Drop the rays that end in ``voxels`` [N, 3]."""
        super().forget_ends(voxels)
        self._fresh = self._fresh[self._fresh < len(self)]

    def _at_random(self, count: int, fresh: int) -> Longs:
        """Draw places [count] at random, ``fresh`` of them of the newest."""
        places: Longs = self._rng.integers(len(self), size=count)
        if fresh and len(self._fresh):
            places[:fresh] = self._fresh[self._rng.integers(len(self._fresh), size=fresh)]
        return places
