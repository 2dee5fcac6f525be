"""Regions that two servers have at the same time, as after the network was divided."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from triquad_format.records.field_settings import RegionIndex


@dataclass(frozen=True)
class EndedContest:
    """Regions that another server had at the same time as this one, and gave away."""

    number: int  # of the other server
    regions: frozenset[RegionIndex]
    since_ms: int  # since 1970


class Contests:
    """Notes who else has a region of this server, so that its scans are not forgotten."""

    def __init__(self, number: int) -> None:
        """Begin without any; ``number`` is that of this server."""
        self._number = number
        self._since_ms: dict[tuple[RegionIndex, int], int] = {}  # by region and other server

    def __contains__(self, index: RegionIndex) -> bool:
        return any(one == index for one, _ in list(self._since_ms))

    @property
    def others(self) -> frozenset[int]:
        """The servers that have, or had, a region of this one."""
        return frozenset(number for _, number in list(self._since_ms))

    def see(self, index: RegionIndex, holders: Mapping[int, int]) -> None:
        """Note who has a region of this server, and since when, milliseconds since 1970."""
        own_ms = holders.get(self._number, 0)
        for number, since_ms in holders.items():
            if number != self._number:
                self._since_ms[index, number] = max(own_ms, since_ms)

    def forget(self, index: RegionIndex) -> None:
        """Forget a region that this server gives away."""
        for one in [one for one in list(self._since_ms) if one[0] == index]:
            self._since_ms.pop(one, None)

    def take_ended(self, holders: Callable[[RegionIndex], Mapping[int, int]]) -> list[EndedContest]:
        """Return what others have given away since the last time, a server after the other."""
        ended: dict[int, dict[RegionIndex, int]] = {}
        for (index, number), since_ms in list(self._since_ms.items()):
            if number not in holders(index):
                del self._since_ms[index, number]
                ended.setdefault(number, {})[index] = since_ms
        return [
            EndedContest(number, frozenset(regions), min(regions.values()))
            for number, regions in ended.items()
        ]
