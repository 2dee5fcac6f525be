"""Parts of a version 1 map, from docs/map-file.md and nothing of the project."""

from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

PLANES = ((0, 1), (0, 2), (1, 2))
UNKNOWN, FREE, SURFACE = 0, 1, 2

Index = tuple[int, int, int]
Key = tuple[str, Index, int, int]
"""Topic, region, plane, cell."""
Array = NDArray[Any]


class RefusedError(Exception):
    """The page says that a reader must refuse this file."""


def check(condition: object, what: str) -> None:
    if not condition:
        raise RefusedError(what)


# Sections 4 and 5


def plain(stored: dict[str, Any]) -> Array:
    """Section 4.1."""
    dtype = np.dtype(stored["dtype"])
    check(len(stored["data"]) == np.prod(stored["shape"], dtype=object) * dtype.itemsize, "array")
    return np.frombuffer(stored["data"], dtype).reshape(stored["shape"])


class Settings:
    """Settings of the map and what derives from them."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.leaf, self.depth = float(values["leaf_m"]), int(values["depth"])
        self.sizes, self.feature_size = int(values["feature_levels"]), int(values["feature_size"])
        self.encoding, self.logit = str(values["encoding"]), float(values["logit_scale_m"])
        self.levels = range(self.depth - self.sizes + 1, self.depth + 1)
        self.side = self.leaf * 2**self.depth
        self.overlap = self.leaf * 16
        self.pitch = self.leaf * (2**self.depth - 16)

    def leaf_coordinates(self, points: Array, index: Index) -> Array:
        return (points - np.array(index) * self.pitch) / self.leaf + 2.0 ** (self.depth - 1)

    def inside(self, points: Array, index: Index) -> NDArray[np.bool_]:
        return (np.abs(points - np.array(index) * self.pitch) < self.side / 2).all(1)

    def needs(self, key: Key, points: Array) -> bool:
        """Whether an answer at one of the points depends on a part."""
        topic, index, plane, cell = key
        u = self.leaf_coordinates(points[self.inside(points, index)], index)
        if topic == "/triquad/vertices":
            return near(u[:, PLANES[plane]], cell, 2 ** (self.sizes - 1) + 1 / 16)
        if topic == "/triquad/evidence":
            return near(u, cell, 1)
        return topic == "/triquad/region" and len(u) > 0


def near(u: Array, cell: int, distance: int) -> bool:
    """Whether a square or cube is within a distance of some leaf coordinates."""
    start = demorton(np.array([cell]), u.shape[1]) * 256
    return bool(((u >= start - distance) & (u <= start + 256 + distance)).all(1).any())


def demorton(codes: Array, axes: int) -> NDArray[np.int64]:
    result = np.zeros((len(codes), axes), np.int64)
    for bit in range(63):
        result[:, bit % axes] |= (codes >> bit & 1) << bit // axes
    return result


def unshuffled(stored: dict[str, Any], dtypes: dict[int, str]) -> Array:
    """Section 4.2."""
    data = plain(stored)
    check(data.dtype == np.uint8, "dtype of a shuffled array")
    return np.ascontiguousarray(np.moveaxis(data, 0, -1)).view(dtypes[len(data)])[..., 0]


def codes_of(stored: dict[str, Any], cell: int, bits: int) -> NDArray[np.int64]:
    """Section 4.3: the codes within the region."""
    data = plain(stored).astype(np.int64)
    differences = sum(row << 8 * k for k, row in enumerate(data))
    check((differences[1:] > 0).all(), "codes increase strictly")
    codes = np.cumsum(differences)
    check((codes < 1 << bits).all(), "a code lies outside its cell")
    return (cell << bits) + codes


def counts_of(stored: dict[str, Any]) -> NDArray[np.int64]:
    """Section 5.5."""
    return np.array(sum(row << 8 * k for k, row in enumerate(plain(stored).astype(np.int64))))


def rays_of(part: Any, cell: int, training: Any, settings: Settings) -> Array:
    """Section 5.5: ends and origins [R, 3] from the region's centre, metres, and slopes."""
    leaves = demorton(codes_of(part["codes"], cell, 24), 3)
    leaves = leaves.repeat(counts_of(part["counts"]), axis=0)
    ends = leaves + (plain(part["inside"]).T + 0.5) / 128
    ends = (ends - 2**settings.depth) * settings.leaf
    origins = plain(training["origins"])[counts_of(part["origins"])]
    return np.column_stack([ends, origins, plain(part["slopes"]) / 255])


def is_held_out(end: Array, settings: Settings) -> bool:
    """Section 5.5, of a ray that ends there, metres from the region's centre."""
    u = end / settings.leaf + 2**settings.depth
    x, y, z = (int(np.floor(128 * place)) % 2**21 for place in u)
    key = x * 2**42 + y * 2**21 + z
    return key * 0x9E3779B97F4A7C15 % 2**64 < 2**59


def integers_of(stored: dict[str, Any]) -> NDArray[np.float32]:
    data = plain(stored).astype(np.int64)
    return sum(row << 8 * k for k, row in enumerate(data)).T.astype(np.float32)


def place(coordinates: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number for each row, in which neighbours outside the region have their own."""
    return coordinates @ (1 << 20 * np.arange(coordinates.shape[1]))


OfBlocks = Callable[[dict[str, Any], NDArray[np.bool_]], Array]
"""Values [B, width], of a part and the surface voxels [B, 512] of its blocks."""


class Table:
    """Rows of values at places; zeros elsewhere."""

    def __init__(self, chunks: list[tuple[Array, Array]], width: int, dtype: str) -> None:
        none = (np.zeros(0, np.int64), np.zeros((0, width), dtype))
        places, values = (np.concatenate(column) for column in zip(none, *chunks, strict=True))
        order = np.argsort(places)
        self.places = np.append(places[order], np.iinfo(np.int64).max)
        self.values = np.concatenate([values[order], np.zeros((1, width), dtype)])

    def __call__(self, coordinates: NDArray[np.int64]) -> Array:
        wanted = place(coordinates)
        rows = np.searchsorted(self.places, wanted)
        return self.values[np.where(self.places[rows] == wanted, rows, -1)]


class Region:
    """Section 5.2 to 5.4 for one region."""

    def __init__(self, settings: Settings, parts: dict[Key, bytes], index: Index) -> None:
        own = {key: msgpack.unpackb(parts[key]) for key in parts if is_of(key, index)}
        check(all(agrees(key, part) for key, part in own.items()), "a part with another key")
        (head,) = (part for key, part in own.items() if key[0] == "/triquad/region")
        self.settings, self.index = settings, index
        self.centre = np.array(index) * settings.pitch
        self.frequencies = plain(head["frequencies"])
        self.weights = [plain(array) for array in head["weights"]]
        self.biases = [plain(array) for array in head["biases"]]
        scales = plain(head["scales"])
        self.tables = {
            (plane, level): self._table(own, plane, i, scales[plane * settings.sizes + i :][:1])
            for plane in range(3)
            for i, level in enumerate(settings.levels)
        }
        self.surface = self._of_blocks(own, lambda part, _: plain(part["surface"]), 64, "|u1")
        self.free = self._of_blocks(own, lambda part, _: plain(part["free"]), 64, "|u1")
        self.seen = self._of_blocks(own, times_of, 1, "<i8")
        self.levels = self._of_blocks(own, levels_of, 512, "|u1")
        self.outcomes = self._of_blocks(own, outcomes_of, 3 * 512, "<f8")
        self.margins = self._of_blocks(own, margins_of, 6 * 512, "|u1")

    def _table(self, own: dict[Key, Any], plane: int, i: int, scale: Array) -> Table:
        bits = 2 * (8 - (self.settings.sizes - 1 - i))
        chunks = []
        for key, part in own.items():
            if key[0] == "/triquad/vertices" and key[2] == plane:
                level = part["levels"][i]
                codes = codes_of(level["codes"], key[3], bits)
                features = features_of(level, scale)
                chunks.append((place(demorton(codes, 2)), features))
        return Table(chunks, self.settings.feature_size, "<f4")

    def _of_blocks(self, own: dict[Key, Any], of: OfBlocks, width: int, dtype: str) -> Table:
        """What a part tells ``of`` each block; of voxels in the order of bits."""
        chunks = []
        for key, part in own.items():
            if key[0] == "/triquad/evidence":
                blocks = place(demorton(codes_of(part["codes"], key[3], 15), 3))
                surface = np.unpackbits(plain(part["surface"]), axis=1, bitorder="little")
                chunks.append((blocks, of(part, surface.astype(bool))))
        return Table(chunks, width, dtype)


def is_of(key: Key, index: Index) -> bool:
    return key[1] == index and key[0] in (
        "/triquad/region",
        "/triquad/vertices",
        "/triquad/evidence",
    )


def agrees(key: Key, part: dict[str, Any]) -> bool:
    """Whether a part names its own key."""
    place_in_region = (part.get("plane", 0), part.get("cell", 0))
    return tuple(part["region"]) == key[1] and place_in_region == key[2:]


def levels_of(part: dict[str, Any], surface: NDArray[np.bool_]) -> Array:
    """Section 5.4: levels [B, 512], where there are surface voxels; else 0."""
    levels = np.zeros(surface.shape, np.uint8)
    levels[surface] = voxel_codes(part, "levels", [3], surface.sum())[0]
    return levels


def outcomes_of(part: dict[str, Any], surface: NDArray[np.bool_]) -> Array:
    """Section 5.4: hits, passes and misses [B, 1536], where there are surface voxels; else 0."""
    counts = np.zeros((*surface.shape, 3))
    h, p, m = voxel_codes(part, "outcomes", [2, 4, 4], surface.sum())
    hits = np.where(h == 0, 8, 2.0 ** (h - 1))
    passes, misses = (np.where(c == 0, 0, hits * 2.0 ** (c - 4)) for c in (p, m))
    counts[surface] = np.stack([hits, passes, misses], axis=1)
    return counts.reshape(len(surface), -1)


def margins_of(part: dict[str, Any], surface: NDArray[np.bool_]) -> Array:
    """Section 5.4: margins [B, 3072] of surface voxels; else 0."""
    margins = np.zeros((*surface.shape, 6), np.uint8)
    margins[surface] = voxel_codes(part, "margins", 6 * [2], surface.sum()).T
    return margins.reshape(len(surface), -1)


def voxel_codes(part: dict[str, Any], name: str, bits: list[int], count: int) -> Array:
    """Section 5.4: codes [columns, count], whose columns have these numbers of bits."""
    codes = np.zeros((len(bits), count), np.int64)
    stored = np.unpackbits(plain(part[name]), axis=1, bitorder="little")
    check(stored.shape == (sum(bits), (count + 7) // 8 * 8), f"{name} of other voxels")
    for row, planes in enumerate(np.split(stored[:, :count], np.cumsum(bits)[:-1])):
        bit = np.zeros(count, np.int64)
        for plane in planes:
            bit = plane ^ bit
            codes[row] = 2 * codes[row] + bit
    return codes


def times_of(part: dict[str, Any], surface: NDArray[np.bool_]) -> Array:
    """Section 5.4: times [B, 1] of the blocks that hold surface; else 0."""
    touched = surface.any(1)
    times = np.zeros((len(touched), 1), np.int64)
    planes = plain(part["seen_s"]).astype(np.int64)
    check(1 <= len(planes) <= 5 and planes.shape[1] == touched.sum(), "times of other blocks")
    since = sum(row << 8 * k for k, row in enumerate(planes))
    times[touched, 0] = np.where(since > 0, since + part["seen_from_s"], 0)
    return times


def features_of(level: dict[str, Any], scale: Array) -> Array:
    if len(scale):
        return integers_of(level["integers"]) * scale
    return unshuffled(level["features"], {2: "<f2", 4: "<f4"}).astype(np.float32)
