"""The evidence of a cube as the msgpack map of a part, and back.

``docs/map-file.md`` tells how levels and times are stored.
"""

from collections.abc import Iterator, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import DamagedMapFileError
from triquad_format.mapfile.parts.cell import cube_shift
from triquad_format.mapfile.parts.part_body import PartBody
from triquad_format.mapfile.parts.shuffle import shuffle_codes, shuffle_counts, unshuffle_counts
from triquad_format.records.evidence_voxels import surface_counts
from triquad_format.records.region import BLOCK_BYTES, MAX_LEVEL, MAX_SEEN_S, Evidence
from triquad_format.wire.array import pack_array

_Integer = TypeVar("_Integer", bound=np.integer)

_LEVEL_BITS = MAX_LEVEL.bit_length()
_MAX_SEEN_BYTES = (MAX_SEEN_S.bit_length() + 7) // 8


def evidence_bodies(evidence: Evidence) -> Iterator[tuple[int, dict[str, object]]]:
    """The cubes that hold blocks of a region's checked evidence, with the fields of their parts."""
    cells = evidence.codes >> cube_shift()
    first_voxel = np.concatenate([[0], np.cumsum(surface_counts(evidence.surface))])
    for cell in np.unique(cells).tolist():
        first, last = np.searchsorted(cells, [cell, cell + 1]).tolist()
        rows = slice(first, last)
        surface = evidence.surface[rows]
        body: dict[str, object] = {
            "codes": pack_array(shuffle_codes(evidence.codes[rows] - (cell << cube_shift()))),
            "surface": pack_array(surface),
            "free": pack_array(evidence.free[rows]),
        }
        if evidence.levels is not None:
            levels = evidence.levels[first_voxel[first] : first_voxel[last]]
            body["levels"] = pack_array(_level_planes(levels))
        if evidence.seen_s is not None:
            body.update(_seen_fields(evidence.seen_s[rows][surface.any(axis=1)]))
        yield cell, body


def read_evidence(body: PartBody, codes: NDArray[np.int64]) -> Evidence:
    """The evidence of a part, whose blocks have these codes [B].

    Raises:
        FormatError: a field is missing or malformed, or does not fit the others.
    """
    surface, free = (
        body.array(name, "|u1", len(codes), BLOCK_BYTES) for name in ("surface", "free")
    )
    levels = _read_levels(body, surface) if body.has("levels") else None
    seen_s = _read_seen(body, surface) if body.has("seen_s") else None
    return Evidence(codes, surface, free, levels, seen_s)


def joined(portions: Sequence[Evidence]) -> Evidence:
    """The evidence of a region from that of its cubes, in their order.

    Where some of them tell no levels or times and others do, the former's are 0.
    """
    if len(portions) == 1:
        return portions[0]
    masks = np.zeros((0, BLOCK_BYTES), np.uint8)
    levels = [portion.levels for portion in portions]
    seen_s = [portion.seen_s for portion in portions]
    counts = [int(surface_counts(portion.surface).sum()) for portion in portions]
    return Evidence(
        np.concatenate([np.zeros(0, np.int64), *(portion.codes for portion in portions)]),
        np.concatenate([masks, *(portion.surface for portion in portions)]),
        np.concatenate([masks, *(portion.free for portion in portions)]),
        _filled(levels, counts, np.uint8),
        _filled(seen_s, [len(portion.codes) for portion in portions], np.int64),
    )


def _filled(
    columns: Sequence[NDArray[_Integer] | None], counts: Sequence[int], kind: type[_Integer]
) -> NDArray[_Integer] | None:
    """The columns in one, with zeros in place of those that are missing."""
    if all(column is None for column in columns):
        return None
    return np.concatenate(
        [
            np.zeros(count, kind) if column is None else column
            for column, count in zip(columns, counts, strict=True)
        ]
    )


# Levels of neighbours are alike. Two that differ by one differ in one bit here, so that the planes
# shrink to a tenth less than bytes of one level each do.


def _level_planes(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Bits [3, N] of levels [S], from the highest on, each but the first xor the one above it."""
    bits = np.arange(_LEVEL_BITS, dtype=np.uint8)[::-1, None]
    planes = np.packbits(levels >> bits & 1, axis=1, bitorder="little")
    planes[1:] ^= planes[:-1].copy()
    return planes


def _read_levels(body: PartBody, surface: NDArray[np.uint8]) -> NDArray[np.uint8]:
    count = int(surface_counts(surface).sum())
    stored = body.array("levels", "|u1", _LEVEL_BITS, (count + 7) // 8)
    levels = np.zeros(count, np.uint8)
    for plane in np.bitwise_xor.accumulate(stored, axis=0):
        levels <<= 1
        levels |= np.unpackbits(plane, count=count, bitorder="little")
    return levels


# Times: of blocks in which a ray ended, as seconds since shortly before the first of the part.


def _seen_fields(seen_s: NDArray[np.int64]) -> dict[str, object]:
    known = seen_s[seen_s > 0]
    start = int(known.min()) - 1 if len(known) else 0
    since = np.maximum(seen_s - start, 0)
    return {"seen_from_s": start, "seen_s": pack_array(shuffle_counts(since))}


def _read_seen(body: PartBody, surface: NDArray[np.uint8]) -> NDArray[np.int64]:
    touched = surface.any(axis=1)
    planes = body.array("seen_s", "|u1", None, int(touched.sum()))
    if not 1 <= len(planes) <= _MAX_SEEN_BYTES:
        raise DamagedMapFileError(f"{body.topic}: seen_s has {len(planes)} bytes per time")
    start = body.count("seen_from_s")
    if start > MAX_SEEN_S:
        raise DamagedMapFileError(f"{body.topic}: seen_from_s = {start} is above {MAX_SEEN_S}")
    since = unshuffle_counts(planes)
    seen_s = np.zeros(len(surface), np.int64)
    seen_s[touched] = np.where(since > 0, start + since, 0)
    return seen_s
