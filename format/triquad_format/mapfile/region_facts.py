"""What the file of a checkpoint tells of each region, so that no part has to be read for it."""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from triquad_format.errors import DamagedMapFileError
from triquad_format.mapfile.parts.body import PartBody
from triquad_format.mapfile.parts.part import MANIFEST
from triquad_format.records.field_settings import RegionIndex
from triquad_format.wire.packing import pack_array


@dataclass(frozen=True)
class RegionFacts:
    """What is known of a region whose parts lie in a store."""

    vertices: int  # of its quadtrees
    parameters: int  # learnable numbers
    rays: int  # that are kept to train on
    samples_left: int  # training samples until nothing is left to learn
    newest_s: int  # when a ray last ended in it, seconds since 1970; 0: never, or not known
    memory_bytes: int  # that it takes while it is mapped, an estimate


_COLUMNS = [field.name for field in fields(RegionFacts)]

FactsByRegion = Mapping[RegionIndex, RegionFacts]


def pack_region_facts(facts: FactsByRegion) -> dict[str, object]:
    """Return the facts as columns, in the order of the regions."""
    columns = {
        name: np.array([getattr(one, name) for one in facts.values()], "<i8") for name in _COLUMNS
    }
    index = np.array(list(facts), "<i4").reshape(-1, 3)
    return {name: pack_array(array) for name, array in {"region": index, **columns}.items()}


def region_facts_in(body: PartBody, key: str) -> dict[RegionIndex, RegionFacts]:
    """Return the facts in the field ``key`` of a manifest.

    Raises:
        FormatError: they are malformed, or negative.
    """
    packed = PartBody(MANIFEST, body.mapping(key))
    index = packed.array("region", "<i4", (None, 3))
    columns = [packed.array(name, "<i8", (len(index),)) for name in _COLUMNS]
    if any((column < 0).any() for column in columns):
        raise DamagedMapFileError(f"{MANIFEST}: a number of a region in {key!r} is negative")
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return {
        (x, y, z): RegionFacts(*row) for (x, y, z), row in zip(index.tolist(), rows, strict=True)
    }
