"""The three planar quadtrees of a region: which vertices exist, and which a point lies between.

Vertices are owned by hash tables, one per plane and level, keyed by 2-D Morton code (3QFP,
section III-A). Looking up 4 vertices on 3 planes and H levels would cost 12 H probes a point, so
each plane also has an index derived from those tables: its *blocks*, the nodes of the coarsest
level that carries features, each with the rows of all vertices within it (4 + 9 + 25 for H = 3).
One probe per plane then finds them all.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from triquad_format.field_settings import FieldSettings
from triquad_format.region import AXES

from triquad_server import morton
from triquad_server.hash_table import HashTable

_MIN_ROWS = 1024
PLANE_BITS = 40
"""Keys of blocks are Morton codes below this bit, and the number of the plane above it."""


@dataclass(frozen=True)
class Corners:
    """The vertices around N points, on all planes, for each of H levels (coarsest first)."""

    rows: Tensor  # [N, H, 12] int32 rows of the feature table; 0 stands for an absent vertex
    weights: Tensor  # [N, H, 12] bilinear weights; differentiable in the points


class TriQuadtree:
    """Existing vertices of the three planes, and the rows of the feature table they own.

    Row 0 is reserved for absent vertices.
    """

    def __init__(self, settings: FieldSettings, device: torch.device) -> None:
        self._settings = settings
        self._device = device
        self._rows = 1
        self._vertices = [[HashTable(device) for _ in settings.levels] for _ in AXES]
        self._codes = torch.zeros(_MIN_ROWS, dtype=torch.int64, device=device)  # by row
        self._owners = torch.zeros(_MIN_ROWS, dtype=torch.uint8, device=device)  # table, by row
        self._blocks = HashTable(device)  # of all planes, see _block_key
        sides = [(1 << h) + 1 for h in range(settings.feature_levels)]  # vertices along a block
        self._starts = [sum(side**2 for side in sides[:h]) for h in range(len(sides))]
        self._block_rows = torch.zeros(
            (1, sum(side**2 for side in sides)),
            dtype=torch.int32,
            device=device,
        )

    def vertices(self, plane: int, h: int) -> tuple[Tensor, Tensor]:
        """Sorted Morton codes and rows of the vertices on a plane and the ``h``-th level."""
        rows = (self._owners[: self._rows] == self._owner(plane, h)).nonzero()[:, 0]
        codes, order = torch.sort(self._codes[rows])
        return codes, rows[order]

    @property
    def starts(self) -> list[int]:
        """Where the vertices of each level begin within a block."""
        return self._starts

    @property
    def blocks(self) -> HashTable:
        """Numbers of the blocks, by plane and Morton code: see :data:`PLANE_BITS`."""
        return self._blocks

    @property
    def block_rows(self) -> Tensor:
        """Rows [blocks, vertices of a block] of the feature table, int32."""
        return self._block_rows

    def copy(self) -> "TriQuadtree":
        """A copy for reading: it does not grow, and does not change when this tree does.

        It shares the rows so far, which never change, and does without the hash tables of the
        vertices, which only growing needs.
        """
        twin = TriQuadtree(self._settings, self._device)
        twin._rows = self._rows
        twin._vertices = []
        twin._codes, twin._owners = self._codes, self._owners
        twin._blocks = self._blocks.copy()
        twin._block_rows = self._block_rows.clone()
        return twin

    def grow(self, points: Tensor) -> int:
        """Make the nodes into which surface ``points`` [N, 3] project; returns the new rows.

        Points are in metres from the region's centre; those outside its cube are left out.
        """
        before = self._rows
        leaves = self._leaf_coordinates(points).floor().to(torch.int64)
        side = 1 << self._settings.depth
        leaves = leaves[((leaves >= 0) & (leaves < side)).all(dim=1)]
        for plane, (first, second) in enumerate(AXES):
            nodes = torch.unique(morton.encode(leaves[:, first], leaves[:, second]))
            for h in reversed(range(self._settings.feature_levels)):
                self.add_vertices(plane, h, _node_vertices(nodes))
                nodes = torch.unique(nodes >> 2)
        return self._rows - before

    def add_vertices(self, plane: int, h: int, codes: Tensor) -> None:
        """Give rows to those of the vertices ``codes`` (unique) that have none yet."""
        table = self._vertices[plane][h]
        codes = codes[table.lookup(codes) == 0]
        if len(codes) == 0:
            return
        rows = torch.arange(self._rows, self._rows + len(codes), device=self._device)
        table.insert(codes, rows)
        self._rows += len(codes)
        self._note_owner(rows, codes, self._owner(plane, h))
        self._index(plane, h, codes, rows)

    def corners(self, points: Tensor) -> Corners:
        """Vertices around ``points`` [N, 3] (metres from the centre) and their weights."""
        levels = self._settings.feature_levels
        leaf = self._leaf_coordinates(points)
        rows = []
        weights = []
        for plane, axes in enumerate(AXES):
            uv = leaf[:, list(axes)] / (1 << (levels - 1))  # in blocks
            block = uv.detach().floor()
            number = self._find_blocks(plane, block.to(torch.int64))
            plane_rows = self._block_rows[number]
            local = uv - block
            for h in range(levels):
                scaled = local * (1 << h)
                cell = scaled.detach().floor()
                t = scaled - cell
                side = (1 << h) + 1
                corner = self._starts[h] + (cell[:, 0] * side + cell[:, 1]).to(torch.int64)
                offsets = corner[:, None] + corner.new_tensor([0, side, 1, side + 1])
                rows.append(plane_rows.gather(1, offsets))
                weights.append(_bilinear(t))
        count = len(points)
        return Corners(
            torch.stack(rows, 1)
            .view(count, len(AXES), levels, 4)
            .transpose(1, 2)
            .reshape(count, levels, 12),
            torch.stack(weights, 1)
            .view(count, len(AXES), levels, 4)
            .transpose(1, 2)
            .reshape(count, levels, 12),
        )

    def _owner(self, plane: int, h: int) -> int:
        return 1 + plane * self._settings.feature_levels + h

    def _note_owner(self, rows: Tensor, codes: Tensor, owner: int) -> None:
        if self._rows > len(self._codes):
            more = max(self._rows, 2 * len(self._codes)) - len(self._codes)
            self._codes = torch.cat([self._codes, self._codes.new_zeros(more)])
            self._owners = torch.cat([self._owners, self._owners.new_zeros(more)])
        self._codes[rows] = codes
        self._owners[rows] = owner

    def _leaf_coordinates(self, points: Tensor) -> Tensor:
        return points / self._settings.leaf_m + (1 << (self._settings.depth - 1))

    def _find_blocks(self, plane: int, block: Tensor) -> Tensor:
        side = 1 << self._settings.levels[0]
        inside = ((block >= 0) & (block < side)).all(dim=1)
        block = block.clamp(0, side - 1)
        numbers = self._blocks.lookup(_block_key(plane, block[:, 0], block[:, 1]))
        return numbers * inside

    def _index(self, plane: int, h: int, codes: Tensor, rows: Tensor) -> None:
        """Enter new vertices of one level into every block that touches them."""
        first, second = morton.decode(codes)
        side = (1 << h) + 1
        limit = 1 << self._settings.levels[0]
        for before_first in (0, 1):
            for before_second in (0, 1):
                # A vertex on a block's lower border also is on the upper border of its neighbour.
                block_first = (first - before_first) >> h
                block_second = (second - before_second) >> h
                local_first = first - (block_first << h)
                local_second = second - (block_second << h)
                inside = (block_first >= 0) & (block_first < limit)
                inside &= (block_second >= 0) & (block_second < limit)
                block = _block_key(plane, block_first[inside], block_second[inside])
                offset = self._starts[h] + local_first[inside] * side + local_second[inside]
                numbers = self._make_blocks(block)
                self._block_rows[numbers, offset] = rows[inside].to(torch.int32)

    def _make_blocks(self, keys: Tensor) -> Tensor:
        """Numbers of the blocks ``keys``, made where they do not exist."""
        missing = torch.unique(keys[self._blocks.lookup(keys) == 0])
        if len(missing):
            first = len(self._blocks) + 1
            last = first + len(missing)
            self._blocks.insert(missing, torch.arange(first, last, device=self._device))
            if last > len(self._block_rows):
                grown = self._block_rows.new_zeros((2 * last, self._block_rows.shape[1]))
                grown[: len(self._block_rows)] = self._block_rows
                self._block_rows = grown
        return self._blocks.lookup(keys)


def _block_key(plane: int, first: Tensor, second: Tensor) -> Tensor:
    key: Tensor = morton.encode(first, second) + (plane << PLANE_BITS)
    return key


def _node_vertices(nodes: Tensor) -> Tensor:
    """Unique Morton codes of the 4 vertices of each node."""
    first, second = morton.decode(nodes)
    corners = [morton.encode(first + i, second + j) for i in (0, 1) for j in (0, 1)]
    vertices: Tensor = torch.unique(torch.cat(corners))
    return vertices


def _bilinear(t: Tensor) -> Tensor:
    """Weights [N, 4] of the vertices (0, 0), (1, 0), (0, 1), (1, 1) at fractions ``t`` [N, 2]."""
    a, b = t[:, 0], t[:, 1]
    return torch.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], 1)
