"""A bounded memory of rays, spread over the map.

While there is room, all rays stay. Then each new one replaces that of two candidates whose bin of
space holds more, so that places seen long ago keep theirs and places seen for long do not take
over.
"""

import math

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.voxel_index import VoxelIndex, with_room

from triquad_server.mapping.replay.ray_bins import (
    BIN_LEAVES,
    BINS,
    best_to_push_out,
    bins_of,
    count_in_bins,
    put_rays,
    remove_at_random,
    remove_ending_in,
)
from triquad_server.mapping.replay.ray_table import COLUMNS, END, NO_ORIGIN, RayTable

_NO_LIMIT = 1 << 62
_ROOM = 1.1  # at most, of the capacity: it grows with the map

RAY_BYTES = math.ceil(_ROOM * 4 * (COLUMNS + 1))
"""The bytes of a ray, with the row of its origin, and with the spare room of the arrays."""


class KeptRays:
    """Keeps rays of one region, at most as many as its capacity."""

    def __init__(self, settings: FieldSettings, rng: np.random.Generator) -> None:
        """Begin without rays and limit; ``rng`` chooses which rays stay."""
        self._settings = settings
        self._rng = rng
        self._capacity = _NO_LIMIT
        self._size = 0
        self.discarded = 0  # rays so far that were replaced by others or were too many
        self._rows = np.zeros((0, COLUMNS), np.float32)
        self._origin_of = np.zeros(0, np.int32)
        self._origins = np.zeros((0, 3), np.float32)
        self._origin_count = 0
        self._occupancy = np.zeros(BINS, np.int32)  # rays that end in each bin

    def __len__(self) -> int:
        return self._size

    @property
    def table(self) -> RayTable:
        """Return all that is kept; it changes as rays come and go."""
        used = slice(self._size)
        return RayTable(self._rows[used], self._origin_of[used], self._origins)

    def add(self, new: RayTable) -> Longs:
        """Take in rays; return their places [N] in the table, of as many as are taken in."""
        used = self._size
        room = min(len(new), self._capacity - used)
        places = np.arange(used, used + room)
        if room < len(new):
            places = np.concatenate([places, self._best_to_replace(len(new) - room)])
        rows, origin_of = new.rows, new.origin_of
        self.discarded += len(new) - room
        if len(places) < len(new):
            # Any of them: the last rays of a scan are as good as the first.
            chosen = self._rng.permutation(len(new))[: len(places)]
            rows, origin_of = rows[chosen], origin_of[chosen]
        first = self._add_origins(new.origins)
        origin_of = np.where(origin_of >= 0, origin_of + first, NO_ORIGIN).astype(np.int32)
        self._extend(used + room)
        put_rays(
            RayTable(rows, origin_of, self._origins),
            self._bin_m,
            places,
            used,
            self._rows,
            self._origin_of,
            self._occupancy,
        )
        return places

    def limit(self, capacity: int) -> None:
        """Change the capacity; surplus rays are removed at random."""
        self._capacity = capacity
        surplus = self._size - capacity
        if surplus <= 0:
            return
        self.discarded += surplus
        chances = self._rng.random(surplus)
        of_rays = (self._rows, self._origin_of, self._occupancy)
        remove_at_random(chances, self._bin_m, self._size, *of_rays)
        self._size = capacity
        if len(self._rows) > self._room:
            self._give_room(self._room)

    def forget(self, low: Doubles, high: Doubles) -> None:
        """Drop the rays that end between two corners [3], metres from the region's centre."""
        ends = self._rows[: self._size, END : END + 3]
        self._keep(np.flatnonzero(~((ends >= low) & (ends <= high)).all(axis=1)))

    def forget_ends(self, voxels: Longs) -> None:
        """Drop the rays that end in ``voxels`` [N, 3]; the last of the others take their places."""
        leaf_m, middle = self._settings.leaf_m, float(1 << (self._settings.depth - 1))
        self._size = remove_ending_in(
            VoxelIndex.of_cells(voxels).arrays,
            bins_of(voxels, leaf_m, middle),
            leaf_m,
            middle,
            self._size,
            self._rows,
            self._origin_of,
            self._occupancy,
        )

    @property
    def _bin_m(self) -> float:
        return BIN_LEAVES * self._settings.leaf_m

    def _keep(self, places: Longs) -> None:
        self._rows, self._origin_of = self._rows[places], self._origin_of[places]
        self._size = len(places)
        self._occupancy = count_in_bins(self._rows, self._bin_m)

    @property
    def _room(self) -> int:
        """The most rays that there is room for."""
        return int(_ROOM * self._capacity)

    def _extend(self, size: int) -> None:
        if size > len(self._rows):
            self._give_room(max(size, min(2 * len(self._rows), self._room)))
        self._size = size

    def _give_room(self, rays: int) -> None:
        """Have room for ``rays`` rays; the arrays are resized in place.

        Copying them every few scans of new surface would take as long as all else here.
        """
        for name in ("_rows", "_origin_of"):
            array = vars(self).pop(name)  # numpy resizes it in place if nothing else refers to it
            try:
                array.resize((rays, *array.shape[1:]))
            except ValueError:
                array = with_room(array[:rays], rays)
            finally:
                setattr(self, name, array)

    def _add_origins(self, new: Floats) -> int:
        """Add origins [K, 3], in place of unused ones; return the first one's row."""
        if self._origin_count + len(new) > len(self._origins):
            rays = self._origin_of[: self._size]
            known = rays >= 0
            is_used = np.zeros(len(self._origins), np.bool_)
            is_used[rays[known]] = True
            used = np.flatnonzero(is_used)
            self._origins = with_room(self._origins[used], 2 * (len(used) + len(new)))
            self._origin_count = len(used)
            rays[known] = (np.cumsum(is_used) - 1)[rays[known]]
        first, self._origin_count = self._origin_count, self._origin_count + len(new)
        self._origins[first : self._origin_count] = new
        return first

    def _best_to_replace(self, count: int) -> Longs:
        half = self._size // 2
        count = min(count, half)
        if count == 0:
            return np.zeros(0, np.int64)
        first, offset = self._rng.integers(half, size=2)
        stride = _coprime(half)
        return best_to_push_out(
            self._size, count, first, stride, offset, self._rows, self._bin_m, self._occupancy
        )


def _coprime(size: int) -> int:
    """Return a stride of about a golden section of ``size`` that reaches every place once."""
    stride = max(1, round(0.618 * size))
    while math.gcd(stride, size) != 1:
        stride += 1
    return stride
