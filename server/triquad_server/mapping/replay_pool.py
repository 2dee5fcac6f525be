"""Bounded memory of what rays have taught, spread over the map.

While there is room, all rays stay. Then each new one pushes out that of two candidates whose
bin of space holds more, so that places seen long ago keep theirs and places seen for long do not
take over.
"""

import math
from typing import TYPE_CHECKING

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.team import Team
from triquad_map.compiled.voxel_index import Index, VoxelIndex, with_room
from triquad_map.places import place_keys

from triquad_server.engine.live_field import Batch
from triquad_server.engine.memory import ArrayMemory, Memory
from triquad_server.mapping.ray_bins import (
    BIN_LEAVES,
    BINS,
    best_to_push_out,
    bins_of,
    count_in_bins,
    put_rays,
    rays_ending_in,
    remove_ending_in,
)
from triquad_server.mapping.ray_table import (
    COLUMNS,
    END,
    NO_ORIGIN,
    VALUE,
    Placement,
    RayTable,
    draw_ordered_samples,
)

if TYPE_CHECKING:
    from triquad_server.mapping.device_rays import DeviceRays

_NO_LIMIT = 1 << 62
_ROOM = 1.1  # at most, of the capacity: it grows with the map

RAY_BYTES = math.ceil(_ROOM * 4 * (COLUMNS + 1))
"""Of a ray, with where its origin is, and with the room beside it."""


class ReplayPool:
    """Rays of one region; the newest can be drawn from apart from the others."""

    def __init__(
        self,
        placement: Placement,
        settings: FieldSettings,
        seed: int,
        team: Team,
        memory: Memory,
    ) -> None:
        """No limit yet; ``team`` draws samples, unless ``memory`` is that of another device."""
        self._settings = settings
        self._capacity = _NO_LIMIT
        self._bin_m = BIN_LEAVES * settings.leaf_m
        self._middle = float(1 << (settings.depth - 1))  # of the region, voxels
        self._team = team
        self.placement = placement
        self._size = 0
        self.discarded = 0  # rays so far, that gave way to others or were too many
        self._rng = np.random.default_rng(seed)
        self._rows = np.zeros((0, COLUMNS), np.float32)
        self._origin_of = np.zeros(0, np.int32)
        self._origins = np.zeros((0, 3), np.float32)
        self._origin_count = 0
        self._on_device = _rays_on_device(memory, placement, seed)
        self._occupancy = np.zeros(BINS, np.int32)  # rays that end in each bin
        self._fresh = np.zeros(0, np.int64)
        self._attended = np.zeros(0, np.int64)
        self._blocks: Index | None = None  # in which the rays end that are drawn on at random
        self._focused: Longs | None = None  # their places; None: to be found

    def __len__(self) -> int:
        return self._size

    @property
    def table(self) -> RayTable:
        """All that is kept; it changes with the pool."""
        used = slice(self._size)
        return RayTable(self._rows[used], self._origin_of[used], self._origins)

    def add(self, new: RayTable, fresh: bool = True) -> None:
        """Take in rays; if ``fresh``, they become the newest."""
        used = self._size
        room = min(len(new), self._capacity - used)
        places = np.arange(used, used + room)
        if room < len(new):
            places = np.concatenate([places, self._best_to_push_out(len(new) - room)])
        rows, origin_of = new.rows, new.origin_of
        self.discarded += len(new) - room
        if len(places) < len(new):
            # Any of them: the last rays of a scan are as good as the first.
            chosen = self._rng.permutation(len(new))[: len(places)]
            rows, origin_of = rows[chosen], origin_of[chosen]
        first = self._add_origins(new.origins)
        origin_of = np.where(origin_of >= 0, origin_of + first, NO_ORIGIN).astype(np.int32)
        new = RayTable(rows, origin_of, self._origins)
        self._extend(used + room)
        self._select_anew(places, new.rows)
        put_rays(
            new,
            self._bin_m,
            places,
            used,
            self._rows,
            self._origin_of,
            self._occupancy,
        )
        if self._on_device is not None:
            self._on_device.put(places, new)
        if fresh:
            self._fresh = places

    def focus(self, blocks: Longs | None) -> None:
        """From now on, draw on rays that end in ``blocks`` [B, 3] of voxels alone; None: on all."""
        self._blocks = None if blocks is None else VoxelIndex.of_cells(blocks).arrays
        self._focused = None

    @property
    def rays_drawn_on(self) -> int:
        """How many rays are drawn on at random."""
        in_focus = self._in_focus()
        return self._size if in_focus is None else len(in_focus)

    def attend(self, places: Longs) -> int:
        """From now on, some samples are drawn in ``places`` [P] on request; returns their rays."""
        if len(places) == 0:
            self._attended = self._attended[:0]
        else:
            ends = self._rows[: self._size, END : END + 3]
            self._attended = np.flatnonzero(np.isin(place_keys(ends, self._settings), places))
        return len(self._attended)

    def draw(self, count: int, fresh: int, attended: int = 0) -> Batch:
        """``count`` samples on rays at random.

        ``fresh`` of them are on the newest, and ``attended`` in the places that are attended to.
        """
        places = self._at_random(count, fresh)
        if attended and len(self._attended):
            rows = self._rng.integers(len(self._attended), size=min(attended, count - fresh))
            places[fresh : fresh + attended] = self._attended[rows]
        if self._on_device is not None:
            return self._on_device.draw(places)
        return self.draw_on(places)

    def draw_on(self, places: Longs) -> Batch:
        """A sample on each of the rays of :attr:`table` at ``places`` [N]."""
        table = self.table
        return draw_ordered_samples(table, places, self.placement, rng=self._rng, team=self._team)

    def unsure(self, count: int, fresh: int) -> Longs:
        """The places of rays whose slope no normal told, among ``count`` that are drawn on.

        They end in the cube: elsewhere a field knows no surface.
        """
        places = np.unique(self._at_random(count, fresh))
        is_unsure = (self._rows[places, VALUE] < 0) & (self._origin_of[places] >= 0)
        ends = self._rows[places, END : END + 3]
        is_unsure &= (np.abs(ends) < self.placement.half_side_m).all(axis=1)
        unsure: Longs = places[is_unsure]
        return unsure

    def set_slopes(self, places: Longs, slopes: Doubles) -> None:
        """The rays at ``places`` [N] have these ``slopes`` [N], which no normal told."""
        self._rows[places, VALUE] = -slopes
        if self._on_device is not None:
            self._on_device.set_values(places, self._rows[places, VALUE])

    def limit(self, capacity: int) -> None:
        """Change the capacity; what is too much goes at random."""
        self._capacity = capacity
        if self._size > capacity:
            self.discarded += self._size - capacity
            self._keep(self._rng.permutation(self._size)[:capacity])

    def forget(self, low: Doubles, high: Doubles) -> None:
        """Drop the rays that end between two corners [3], metres from the region's centre."""
        ends = self._rows[: self._size, END : END + 3]
        self._keep(np.flatnonzero(~((ends >= low) & (ends <= high)).all(axis=1)))

    def forget_ends(self, voxels: Longs) -> None:
        """Drop the rays that end in ``voxels`` [N, 3]."""
        leaf_m, middle = self._settings.leaf_m, self._middle
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
        self._fresh = self._fresh[self._fresh < self._size]
        self._attended = self._attended[self._attended < self._size]
        self._focused = None
        self._copy_to_device()

    def _at_random(self, count: int, fresh: int) -> Longs:
        """Places [count] at random, ``fresh`` of them of the newest."""
        in_focus = self._in_focus()
        places: Longs = self._rng.integers(self.rays_drawn_on, size=count)
        if in_focus is not None:
            places = in_focus[places]
        if fresh and len(self._fresh):
            places[:fresh] = self._fresh[self._rng.integers(len(self._fresh), size=fresh)]
        return places

    def _in_focus(self) -> Longs | None:
        """The places of the rays that are drawn on at random; None: all of them."""
        if self._blocks is None:
            return None
        if self._focused is None:
            rows = self._rows[: self._size]
            self._focused = rays_ending_in(self._blocks, self._settings.leaf_m, self._middle, rows)
        return self._focused if len(self._focused) else None

    def _select_anew(self, places: Longs, rows: Floats) -> None:
        """Other rays are at ``places`` [N] now, with these ``rows`` [N, COLUMNS]."""
        if len(self._attended) == 0 and self._focused is None:
            return
        is_other = np.zeros(self._size, np.bool_)
        is_other[places] = True
        self._attended = self._attended[~is_other[self._attended]]
        if self._blocks is not None and self._focused is not None:
            inside = rays_ending_in(self._blocks, self._settings.leaf_m, self._middle, rows)
            kept = self._focused[~is_other[self._focused]]
            self._focused = np.concatenate([kept, places[inside]])

    def _keep(self, places: Longs) -> None:
        # All or none, where memory is short; so below.
        rows, origin_of = self._rows[places], self._origin_of[places]
        self._rows, self._origin_of = rows, origin_of
        self._size = len(places)
        self._occupancy = count_in_bins(rows, self._bin_m)
        self._fresh = self._fresh[:0]
        self._attended = self._attended[:0]
        self._focused = None
        self._copy_to_device()

    def _extend(self, size: int) -> None:
        if size > len(self._rows):
            room = max(size, min(2 * len(self._rows), int(_ROOM * self._capacity)))
            # The rows last: where memory is short, all of this is tried again.
            for name in ("_origin_of", "_rows"):
                self._make_room(name, room)
            self._copy_to_device()
        self._size = size

    def _make_room(self, name: str, rows: int) -> None:
        """Let an array have so many rows, in place.

        To copy it every few scans of new surface would take as long as all else here.
        """
        array = vars(self).pop(name)  # numpy sees to it that nobody else holds on to it
        try:
            array.resize((rows, *array.shape[1:]))
        except ValueError:  # somebody does
            array = with_room(array, rows)
        finally:
            setattr(self, name, array)

    def _add_origins(self, new: Floats) -> int:
        """Add origins [K, 3], in place of those of no ray any more; returns the first one's row."""
        if self._origin_count + len(new) > len(self._origins):
            rays = self._origin_of[: self._size]
            known = rays >= 0
            is_used = np.zeros(len(self._origins), np.bool_)
            is_used[rays[known]] = True
            used = np.flatnonzero(is_used)
            roomy = with_room(self._origins[used], 2 * (len(used) + len(new)))
            rays[known] = (np.cumsum(is_used) - 1)[rays[known]]
            self._origins, self._origin_count = roomy, len(used)
            self._copy_to_device()
        first, self._origin_count = self._origin_count, self._origin_count + len(new)
        self._origins[first : self._origin_count] = new
        return first

    def _copy_to_device(self) -> None:
        if self._on_device is not None:
            self._on_device.replace(RayTable(self._rows, self._origin_of, self._origins))

    def _best_to_push_out(self, count: int) -> Longs:
        half = self._size // 2
        count = min(count, half)
        if count == 0:
            return self._fresh[:0]
        first, offset = self._rng.integers(half, size=2)
        stride = _coprime(half)
        return best_to_push_out(
            self._size, count, first, stride, offset, self._rows, self._bin_m, self._occupancy
        )


def _rays_on_device(memory: Memory, placement: Placement, seed: int) -> "DeviceRays | None":
    """Room for a copy of rays where the field is that learns from them; None: it needs no copy."""
    if isinstance(memory, ArrayMemory):
        return None
    from triquad_server.mapping.device_rays import DeviceRays

    return DeviceRays(memory.device, placement, seed)


def _coprime(size: int) -> int:
    """A stride of about a golden section of ``size`` that visits every place once."""
    stride = max(1, round(0.618 * size))
    while math.gcd(stride, size) != 1:
        stride += 1
    return stride
