"""A region of a map file, of which some cells are there."""

from collections.abc import Mapping

from triquad_format.mapfile.parts.part import REGION, PartKey, cube_shift, square_shift
from triquad_format.mapfile.parts.region_parts import RegionParts
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.record_check import check_region
from triquad_format.records.region import Region, RegionIndex, region_centre

from triquad_map.reference.region_field import RegionField
from triquad_map.reference.seen_blocks import SeenBlocks


class PartialRegion:
    """Field and status of a region; they are right where all is there that they depend on."""

    def __init__(self, settings: FieldSettings, index: RegionIndex, head: bytes) -> None:
        """A region of which nothing is there but its ``head``: the part ``/triquad/region``.

        Raises:
            FormatError: it is malformed.
        """
        self.index = index
        self.centre = region_centre(settings, index)
        self._settings = settings
        self._head = head
        shifts = {level: square_shift(settings, level) for level in settings.levels}
        self.engine = RegionField(settings, self._read({}), shifts)
        self.evidence = SeenBlocks(settings, cube_shift())

    def add(self, cells: Mapping[PartKey, bytes]) -> None:
        """Add squares of vertices and cubes of evidence, each once, by their keys.

        What is there already is neither read nor checked again.

        Raises:
            FormatError: a part is malformed; nothing was added.
        """
        region = self._read(cells)
        self.engine.add(region.tables)
        self.evidence.add(region.evidence)

    def _read(self, cells: Mapping[PartKey, bytes]) -> Region:
        """A region of these cells alone."""
        parts = RegionParts(self.index, self._settings)
        parts.add(PartKey(REGION, self.index), self._head)
        for key, payload in cells.items():
            parts.add(key, payload)
        region = parts.region()
        check_region(self._settings, region)
        return region
