"""Maps that several servers share: which of them has which region, as liveliness tokens tell.

Each server of a shared map has a number, and is itself the server of a map ``<map>.<number>``. It
has a token for itself, and one for each region that it has. Who has a region, and who is to take
one that nobody has, everybody finds alike.
"""

import hashlib
import re
import threading
from collections.abc import Iterable
from dataclasses import dataclass

from triquad_format.records.field_settings import RegionIndex
from triquad_format.wire.keys import check_name

MAX_SHARES = 64
"""The most servers of one map."""

_TOKEN = re.compile(
    r"triquad/[^/]+/@share/([0-9]{1,2})(?:/(-?[0-9]{1,7})_(-?[0-9]{1,7})_(-?[0-9]{1,7})/([0-9]{1,15}))?"
)


def share_name(map_name: str, number: int) -> str:
    """Return the name of the map that a server of a shared map serves for itself."""
    return check_name("map", f"{check_name('map', map_name)}.{number}")


def share_number(name: str) -> int | None:
    """Return the number at the end of such a name; ``None``: there is none."""
    match = re.fullmatch(r".+\.([1-9][0-9]?)", name)
    return None if match is None else int(match[1])


def number_of_share(map_name: str, server: str) -> int | None:
    """Return the number of a server that shares the map; ``None``: it does not."""
    number = share_number(server)
    return number if server == f"{map_name}.{number}" else None


def shares_key(map_name: str) -> str:
    """Return the key expression of all tokens of a shared map."""
    return f"triquad/{map_name}/@share/**"


def share_key(map_name: str, number: int) -> str:
    """Return the token of a server."""
    return f"triquad/{map_name}/@share/{number}"


def lease_key(map_name: str, number: int, index: RegionIndex, since_ms: int) -> str:
    """Return the token of a region that a server has since a time, milliseconds since 1970."""
    x, y, z = index
    return f"{share_key(map_name, number)}/{x}_{y}_{z}/{since_ms}"


@dataclass(frozen=True)
class ShareToken:
    """What a token says."""

    number: int  # of the server
    region: RegionIndex | None = None  # that it has; None: the server is there
    since_ms: int = 0  # since when it has it, milliseconds since 1970


def read_token(key: str) -> ShareToken | None:
    """Return what a token says; ``None`` where it is none."""
    match = _TOKEN.fullmatch(key)
    if match is None or not 1 <= int(match[1]) <= MAX_SHARES:
        return None
    if match[2] is None:
        return ShareToken(int(match[1]))
    region = int(match[2]), int(match[3]), int(match[4])
    return ShareToken(int(match[1]), region, int(match[5]))


def chosen_share(index: RegionIndex, numbers: Iterable[int]) -> int | None:
    """Return which of some servers is to take a region that none has; ``None``: there is none.

    That is the one whose weight for this region is the largest (rendezvous hashing, Thaler and
    Ravishankar 1998): where a server comes or goes, no region changes between two others.
    """

    def weight(number: int) -> bytes:
        return hashlib.sha256(f"{index} {number}".encode()).digest()

    return max(numbers, key=weight, default=None)


class Shares:
    """The servers of a shared map and their regions, as far as tokens have told; for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._numbers: set[int] = set()
        self._leases: dict[RegionIndex, dict[int, int]] = {}  # since when, by server
        self._left: set[RegionIndex] = set()  # that somebody had before

    def add(self, key: str) -> None:
        """Take notice of a token."""
        token = read_token(key)
        if token is None:
            return
        with self._lock:
            if token.region is None:
                self._numbers.add(token.number)
            else:
                self._leases.setdefault(token.region, {})[token.number] = token.since_ms

    def remove(self, key: str) -> None:
        """Take notice that a token is there no more."""
        token = read_token(key)
        if token is None:
            return
        with self._lock:
            if token.region is None:
                self._numbers.discard(token.number)
            elif (holders := self._leases.get(token.region)) is not None:
                if holders.get(token.number) == token.since_ms:
                    del holders[token.number]
                    self._left.add(token.region)
                if not holders:
                    del self._leases[token.region]

    @property
    def numbers(self) -> frozenset[int]:
        """The servers that are there."""
        with self._lock:
            return frozenset(self._numbers)

    @property
    def leases(self) -> dict[RegionIndex, frozenset[int]]:
        """Who has each region: one, unless several contend."""
        with self._lock:
            return {index: frozenset(holders) for index, holders in self._leases.items()}

    def holders(self, index: RegionIndex) -> dict[int, int]:
        """Return who has a region, the lowest first, and since when: one, unless two contend."""
        with self._lock:
            return dict(sorted(self._leases.get(index, {}).items()))

    def taken_ms(self, index: RegionIndex) -> int:
        """Return when a region was taken from another server, milliseconds since 1970; 0: never."""
        since_ms = next(iter(self.holders(index).values()), 0)
        return since_ms if index in self._left else 0

    def answering(self, index: RegionIndex) -> int | None:
        """Return the server to ask about a region; ``None``: none is there."""
        return next(iter(self.holders(index)), None) or chosen_share(index, self.numbers)
