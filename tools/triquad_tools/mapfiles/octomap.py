"""A map as a binary octree of OctoMap (``.bt``), as its library reads and writes them.

The format is that of ``OcTree::writeBinary``: https://octomap.github.io (Hornung et al., OctoMap,
Autonomous Robots 2013). It has no origin: its root is centred at 0 0 0.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from triquad_format.mapfile.files import replacing
from triquad_format.records import morton
from triquad_format.records.arrays import Bools, Bytes, Longs
from triquad_format.records.region import MapRecord, owned_evidence, seen_voxels

from triquad_tools.console.command import ToolError
from triquad_tools.mapfiles.source import Box, NothingLeftError

_LEVELS = 16
_HALF = 1 << (_LEVELS - 1)  # cells from the middle to each side
_FREE, _OCCUPIED, _INNER = 1, 2, 3  # two bits for each of a node's children, x the lowest; 0: none
_ALL_FREE, _ALL_OCCUPIED = 0x5555, 0xAAAA
_HEADER = """# Octomap OcTree binary file
# (feel free to add / change comments, but leave the first line as it is!)
#
"""
_EACH = 0x5555  # the lower bit of each child


def write_octomap(record: MapRecord, path: Path, box: Box | None) -> str:
    """Write the voxels of a map as an OctoMap, which counts from the map's origin.

    Args:
        record: the map.
        path: the file to write.
        box: voxels whose middles lie in it are written; ``None``: all.

    Returns:
        What was written, in words.

    Raises:
        NothingLeftError: nothing was seen in the box.
        ToolError: the map is too large for an OctoMap.
        OSError: the file cannot be written.
    """
    leaf_m, parts = record.settings.leaf_m, list(_seen(record, box))
    voxels = np.concatenate([part for part, _ in parts] or [np.zeros((0, 3), np.int64)])
    occupied = np.repeat([is_surface for _, is_surface in parts], [len(part) for part, _ in parts])
    if not len(voxels):
        where = "" if box is None else " in the box of --crop"
        raise NothingLeftError(f"{path} is not written: nothing was seen{where}")
    farthest = int(np.maximum(voxels.max(axis=0) + 1, -voxels.min(axis=0)).max())
    if farthest > _HALF:
        raise ToolError(
            f"{path} reaches {_HALF * leaf_m:,.6g} m from the map's origin, {_HALF:,} cells of "
            f"{leaf_m:g} m, and the map {farthest * leaf_m:,.6g} m: write a part, with --crop of "
            "triquad-pack"
        )
    packed = octree_bytes(voxels, occupied.astype(np.bool_), leaf_m)
    with replacing(path) as stream:
        stream.write(packed)
    count = int(occupied.sum())
    told = f"{len(packed):,} bytes, {count:,} voxels occupied, {len(voxels) - count:,} free"
    origin = "; it counts from the map's origin {:.12g} {:.12g} {:.12g} m".format(*record.origin_m)
    return told + origin if record.origin.any() else told


def octree_bytes(voxels: Longs, occupied: Bools, cell_m: float) -> bytes:
    """Return the file of a tree in which some voxels are occupied, and others free.

    Eight children of the same state are one node, as OctoMap prunes them.

    Args:
        voxels: [N, 3] different ones, in cells from the middle of the tree, -32,768 to 32,767.
        occupied: [N] whether each is occupied; else it is free.
        cell_m: side of a voxel, metres.
    """
    codes = morton.encode(voxels + _HALF)
    order = np.argsort(codes)
    codes, states = codes[order], np.where(occupied[order], _OCCUPIED, _FREE)
    places, words = [], []
    for level in range(_LEVELS - 1, -1, -1):
        parents, firsts = np.unique(codes >> 3, return_index=True)
        children = np.bitwise_or.reduceat(states << 2 * (codes & 7), firsts)
        kinds = [children == _ALL_FREE, children == _ALL_OCCUPIED]
        codes, states = parents, np.select(kinds, [_FREE, _OCCUPIED], _INNER)
        inner = states == _INNER
        # Depth first is the order of the first voxels in the nodes, and of the levels in these.
        firsts_below = parents[inner] << 3 * (_LEVELS - level)
        places.append(firsts_below << 4 | level)
        words.append(children[inner])
    written = np.concatenate(words)[np.argsort(np.concatenate(places))].astype("<u2")
    nodes = 1 + int(np.unpackbits(((written | written >> 1) & _EACH).view(np.uint8)).sum())
    facts = f"id OcTree\nsize {nodes}\nres {cell_m!r}\ndata\n"
    return (_HEADER + facts).encode() + written.tobytes()


def _seen(record: MapRecord, box: Box | None) -> Iterator[tuple[Longs, bool]]:
    """Yield voxels [N, 3] in which a surface, or else free space, was seen, and which of both.

    They count from the map's origin, in leaves.
    """
    settings = record.settings
    for region in record.regions:
        evidence = owned_evidence(settings, region)
        corner = np.rint(settings.region_corner(region.index) / settings.leaf_m).astype(np.int64)
        kinds: list[tuple[Bytes, bool]] = [
            (evidence.surface, True),
            (evidence.free & ~evidence.surface, False),
        ]
        for masks, is_surface in kinds:
            voxels = corner + seen_voxels(evidence, masks)
            if box is not None:
                middles = (voxels + 0.5) * settings.leaf_m + record.origin
                voxels = voxels[((middles >= box[0]) & (middles <= box[1])).all(axis=1)]
            yield voxels, is_surface
