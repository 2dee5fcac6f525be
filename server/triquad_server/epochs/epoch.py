"""A published state of the map: what it answers, and the memory that it takes."""

from collections import ChainMap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import MapProgress, MapRecord, Region
from triquad_map.compiled.team import Split, in_one
from triquad_map.composition.composed_view import ComposedView
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.field.frozen_field import FrozenField
from triquad_map.surfels.ray_planes import ShownField
from triquad_map.surfels.surfel_map import SurfelMap

from triquad_server.engine.field_record import region_record

Buffers = Mapping[int, int]
"""The bytes of pieces of memory, by start address: arrays that share one count once."""

_NO_ORIGIN = np.zeros(3)


@dataclass(frozen=True)
class FrozenRegion:
    """A region as it was when it was published."""

    index: RegionIndex
    centre: Doubles  # [3] map frame
    engine: FrozenField
    evidence: FrozenEvidence
    surfels: SurfelMap
    changed: int  # epoch of its last change
    buffers: Buffers  # memory of this one; other epochs may share it

    @property
    def field(self) -> ShownField:
        """The field as it is shown while it is trained."""
        return ShownField(self.engine, self.surfels.planes)

    @property
    def vertices(self) -> int:
        """The number of quadtree vertices, on all planes and levels."""
        return len(self.engine.arrays.features) - 1  # the first row is of absent vertices

    @property
    def parameters(self) -> int:
        """The number of learnable numbers."""
        features, mlp, _ = self.engine.arrays
        return int(features[1:].size + sum(part.size for part in mlp))

    def record(self) -> Region:
        """Return the region as a map file holds it, without training state."""
        return region_record(self.index, self.engine, self.evidence)


class Epoch(ComposedView):
    """An immutable map: every answer comes from the same state. Safe to read from any thread."""

    def __init__(
        self,
        name: str,
        number: int,
        settings: FieldSettings,
        regions: tuple[FrozenRegion, ...],
        split: Split,
        progress: MapProgress | None = None,
        origin: Doubles = _NO_ORIGIN,
    ) -> None:
        """Make an epoch of the map called ``name``; ``split`` runs the work of its answers.

        ``progress`` is how far the map had come; ``None``: it was just begun. ``origin`` [3] is
        from where it counts, in the user's coordinates: 0 0 0 until the first scan chooses it,
        from then on another object, the same in all epochs.
        """
        super().__init__(number, settings, regions, split=split)
        self.number = number
        self.field_settings = settings
        self.frozen_regions = regions
        self.progress = progress or MapProgress()
        self.origin = origin
        self._name = name

    def in_one_thread(self) -> ComposedView:
        """Return the same map, whose answers the caller's thread finds alone.

        It is for callers that give way to queries, which have threads of their own.
        """
        return ComposedView(self.number, self.field_settings, self.frozen_regions, split=in_one)

    @property
    def regions(self) -> int:
        """The number of regions of the map."""
        return len(self.frozen_regions)

    @property
    def vertices(self) -> int:
        """The number of quadtree vertices of all regions."""
        return sum(region.vertices for region in self.frozen_regions)

    @property
    def parameters(self) -> int:
        """The number of learnable numbers of all regions."""
        return sum(region.parameters for region in self.frozen_regions)

    @property
    def buffers(self) -> Buffers:
        """The memory of the epoch; epochs share that of what did not change between them."""
        return ChainMap(*(dict(region.buffers) for region in self.frozen_regions))

    def record(self, regions: tuple[Region, ...] | None = None) -> MapRecord:
        """Return the epoch as a map file holds it, with these ``regions`` of it.

        ``None``: all regions, without training state.
        """
        if regions is None:
            regions = tuple(region.record() for region in self.frozen_regions)
        x, y, z = self.origin.tolist()
        return MapRecord(
            self._name, self.number, self.field_settings, regions, self.progress, (x, y, z)
        )


def buffers_of(part: object) -> dict[int, int]:
    """Return the memory of all arrays and tensors that a part of the program leads to.

    It is an object, or containers of some, which must not change meanwhile; only those of classes
    of this program are searched.
    """
    found: dict[int, int] = {}
    visited: set[int] = set()
    open_parts: list[Any] = [part]
    while open_parts:
        part = open_parts.pop()
        if id(part) in visited:
            continue
        visited.add(id(part))
        if isinstance(part, np.ndarray):
            root = _root(part)
            found[root.ctypes.data] = root.nbytes
        elif hasattr(part, "untyped_storage"):  # a tensor, without need for torch
            storage = part.untyped_storage()
            found[storage.data_ptr()] = storage.nbytes()
        else:
            open_parts.extend(_within(part))
    return found


def _root(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def _within(part: object) -> Iterable[object]:
    """List the parts of a container or of an object of this program."""
    if isinstance(part, (tuple, list)):
        return part
    if isinstance(part, dict):
        return list(part.values())
    if type(part).__module__.startswith("triquad_"):
        return list(getattr(part, "__dict__", {}).values())
    return ()
