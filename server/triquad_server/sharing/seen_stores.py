"""The regions that are in any store of a shared map, as far as a server has seen them."""

import itertools
from collections.abc import Collection

from triquad_format.records.field_settings import RegionIndex


class SeenStores:
    """Knows which regions are stored, so that they are not begun again; for any thread.

    A server that goes may have stored others just before. So what is seen is current only where
    none has gone since it was begun to look.
    """

    def __init__(self) -> None:
        """Begin with nothing seen."""
        self.unreadable: dict[RegionIndex, str] = {}  # why they cannot be taken
        self.problem = ""  # why a store cannot be read; empty: all can
        self._stored: Collection[RegionIndex] = ()
        self._goings = itertools.count(1)
        self._gone = 0  # changes where a token goes
        self._looked = self._seen = -1  # what that was when it was begun to look, the last time

    def __contains__(self, index: RegionIndex) -> bool:
        return index in self._stored

    @property
    def are_current(self) -> bool:
        """Whether all is known that was stored by those that have gone."""
        return self._seen == self._gone

    def one_has_gone(self) -> None:
        """Take notice that a token is there no more."""
        self._gone = next(self._goings)

    def look(self) -> None:
        """Begin to look into the stores: :meth:`have` ends it."""
        self._looked = self._gone

    def have(self, indices: Collection[RegionIndex]) -> None:
        """Tell what was found."""
        self._stored = indices  # first, since another thread may ask in between
        self._seen = self._looked

    def add(self, index: RegionIndex) -> None:
        """Tell that another one is stored."""
        self._stored = {*self._stored, index}
