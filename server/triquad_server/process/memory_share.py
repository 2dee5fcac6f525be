"""How the maps of a server share the memory that it may take."""

import math
from collections.abc import Callable

from triquad_format.errors import SettingsError

_LATER_BYTES = 50_000_000  # of the program, for what it loads and buffers once it serves

_LEAST_ROOM_BYTES = 150_000_000  # for a map: 100 m of a street


class ServerMemory:
    """The memory that a server may take, of which each of its maps has the same share."""

    def __init__(self, limit: int) -> None:
        """Let maps share ``limit`` bytes."""
        self.limit = limit
        self.program = 0  # its code, its libraries, and what is compiled; 0: it is not counted
        self.shares: tuple[MemoryShare, ...] = ()

    def count_program(self, nbytes: int) -> None:
        """Count the bytes of the program before it serves, which each map takes a part of."""
        self.program = nbytes + _LATER_BYTES

    def check(self, maps: int) -> None:
        """See that there is room for a number of maps.

        Raises:
            SettingsError: there is none.
        """
        least = self.program + maps * _LEAST_ROOM_BYTES
        # Within a program, a single map may be as small as one likes.
        if (self.program or maps > 1) and self.limit < least:
            raise SettingsError(
                f"memory.max_bytes = {self.limit}: the program alone takes "
                f"{self.program / 1e6:.0f} MB; for {maps} {'map' if maps == 1 else 'maps'} give "
                f"the server at least {math.ceil(least / 1e6)}_000_000"
            )

    def open(self) -> "MemoryShare":
        """Return the share of another map."""
        share = MemoryShare(self)
        self.shares = (*self.shares, share)
        return share

    def close(self, share: "MemoryShare") -> None:
        """Leave the share of a map to the others."""
        self.shares = tuple(one for one in self.shares if one is not share)


class MemoryShare:
    """What a map may take of the memory of its server, and what it takes, part by part."""

    def __init__(self, server: ServerMemory) -> None:
        """Use :meth:`ServerMemory.open`."""
        self.server = server
        self._parts: dict[str, Callable[[], int]] = {}  # replaced when it grows: others read it
        self._drops: list[Callable[[], None]] = []  # what empties parts that can be had again

    @property
    def limit(self) -> int:
        """The bytes of the share, with those of the program."""
        return self.server.limit // max(1, len(self.server.shares))

    @property
    def kept_bytes(self) -> int:
        """What older epochs may take at most, and what encoded tiles may."""
        return (self.limit - self._program) // 10

    @property
    def cache_bytes(self) -> int:
        """What regions may take that were read to answer: of 2 GB, five of 205 m of a street."""
        return (self.limit - self._program) // 8

    @property
    def _program(self) -> int:
        """The part of the program that the share bears."""
        return self.server.program // max(1, len(self.server.shares))

    def __str__(self) -> str:
        maps = len(self.server.shares)
        share = f", of which each of {maps} maps has {self.limit}" if maps > 1 else ""
        return f"memory.max_bytes = {self.server.limit}{share}"

    def add(
        self, name: str, count: Callable[[], int], drop: Callable[[], None] | None = None
    ) -> None:
        """Count another part from now on; ``map`` are the regions in memory.

        What can ``drop`` its bytes is emptied before regions go without room.
        """
        self._parts = {**self._parts, name: count}
        self._drops += [] if drop is None else [drop]

    def drop(self) -> None:
        """Empty the parts that can be had again."""
        for drop in self._drops:
            drop()

    def parts(self) -> dict[str, int]:
        """Return the bytes of the program, of this map by part, and of all others."""
        own = {name: count() for name, count in self._parts.items()}
        others = sum(one.taken for one in self.server.shares if one is not self)
        return {"program": self.server.program, **own, **({"other maps": others} if others else {})}

    @property
    def taken(self) -> int:
        """The bytes that the map takes, without the program."""
        return sum(count() for count in self._parts.values())

    def reserved(self) -> int:
        """Return the bytes of the share that are not for regions.

        Another map that takes more than its share, since it had a larger one, is left so much.
        """
        own = sum(count() for name, count in self._parts.items() if name != "map")
        others = [one.taken for one in self.server.shares if one is not self]
        most = self.limit - self._program
        return self._program + own + sum(max(0, taken - most) for taken in others)
