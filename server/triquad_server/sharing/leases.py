"""The regions that a server of a shared map has: each is a liveliness token that others see."""

import threading
import time

import zenoh
from triquad_format.records.field_settings import RegionIndex
from triquad_format.wire import keys
from triquad_format.wire.shares import (
    Shares,
    ShareToken,
    chosen_share,
    lease_key,
    read_token,
    share_key,
    share_name,
    shares_key,
)

from triquad_server.errors import NoRoomYetError, ScanRefusedError
from triquad_server.sharing.contests import Contests
from triquad_server.sharing.seen_stores import SeenStores

_CLOCKS_AGREE_S = 1.0  # by which clocks may differ: epochs and leases are numbered by them


def now_ms() -> int:
    """Return milliseconds since 1970, which number the epochs of a shared map."""
    return time.time_ns() // 1_000_000


class Leases:
    """Holds the tokens of this server, and knows those of the others; for any thread.

    What Zenoh tells is taken notice of without a lock, since one is held while Zenoh is called.
    """

    def __init__(self, session: zenoh.Session, map_name: str, number: int) -> None:
        """See what the others have; this server appears later, and has nothing until then."""
        self.number = number
        self.contests = Contests(number)
        self.changed = threading.Event()  # there may be something to take, or to give away
        self.is_taken = False  # another server is of this number
        self.leaving: set[RegionIndex] = set()  # that are to be given away
        self.stores = SeenStores()
        self._awaited: set[RegionIndex] = set()  # scans wait for them
        self._map_name = map_name
        self._lock = threading.Lock()
        self._shares = Shares()
        self._liveliness = session.liveliness()
        self._tokens: dict[RegionIndex, zenoh.LivelinessToken] = {}
        self._own: list[zenoh.LivelinessToken] = []
        self._is_closed = False
        self._ahead_s: dict[int, float] = {}  # by how much the clocks of others are ahead
        self._shares.add(share_key(map_name, number))
        self._subscriber = self._liveliness.declare_subscriber(
            shares_key(map_name),
            zenoh.handlers.Callback(self._heard, indirect=False),
            history=True,
        )

    def wait_for_others(self, longest_s: float) -> None:
        """Return once another server is seen; there may be none."""
        ends_s = time.monotonic() + longest_s
        while not self.others and (left_s := ends_s - time.monotonic()) > 0:
            self.changed.wait(left_s)
            self.changed.clear()

    def appear(self) -> None:
        """Be one of the servers of the map, for the others."""
        key = share_key(self._map_name, self.number)
        self._own.append(self._liveliness.declare_token(key))

    def be_ready(self) -> None:
        """Be one of the servers of the map, for clients that wait for one."""
        own = share_name(self._map_name, self.number)
        for name in (own, self._map_name):
            self._own.append(self._liveliness.declare_token(keys.alive_key(name, own)))

    @property
    def held(self) -> frozenset[RegionIndex]:
        """The regions that this server has."""
        with self._lock:
            return frozenset(self._tokens)

    @property
    def others(self) -> frozenset[int]:
        """The other servers that are there."""
        return self._shares.numbers - {self.number}

    def holders(self, index: RegionIndex) -> dict[int, int]:
        """Return who has a region, the lowest first, and since when, milliseconds since 1970."""
        return self._shares.holders(index)

    def clock_problems(self) -> list[str]:
        """Return whose clocks are ahead of this server's: epochs are numbered by them."""
        return [
            f"the clock of server {number} is {ahead_s:.0f} s ahead of this one's: set both right, "
            "or regions may go on from an older state"
            for number, ahead_s in list(self._ahead_s.items())
        ]

    def is_chosen(self, index: RegionIndex) -> bool:
        """Return whether this server is to have a region, of all that are there."""
        return chosen_share(index, self._shares.numbers) == self.number

    def is_free(self, index: RegionIndex) -> bool:
        """Return whether this server is to take a region that is in a store, now."""
        # In this order: its holder may go in between, having stored it.
        is_free = not self._shares.holders(index) and self.stores.are_current
        return is_free and self.is_chosen(index)

    def has_to_go(self, index: RegionIndex) -> bool:
        """Return whether another server is to have a region that this one has."""
        holders = self._shares.holders(index)
        if next(iter(holders), None) != self.number:
            return True
        return len(holders) == 1 and index not in self.contests and not self.is_chosen(index)

    def may_have(self, index: RegionIndex) -> bool:
        """Return whether a scan may change a region here; one that nobody has is begun.

        Raises:
            NoRoomYetError: the scan has to wait until this server has taken the region, or until it
                has noticed that it is not to give it away yet.
            ScanRefusedError: ``store``; it is this server's to take, and a store cannot be read.
        """
        with self._lock:
            holders = self._shares.holders(index)
            if self._is_closed:
                return False
            if index in self._tokens:
                if index in self.leaving and next(iter(holders)) == self.number:
                    self._wait_for(index)
                return index not in self.leaving
            if holders or (self._own and not self.is_chosen(index)):
                return False
            if why := self.stores.unreadable.get(index) or self.stores.problem:
                raise ScanRefusedError("store", why)
            if not self._own or not self.stores.are_current or index in self.stores:
                self._wait_for(index)
            self._take(index)
            return True

    def take(self, index: RegionIndex) -> None:
        """Have a region from now on."""
        with self._lock:
            self.stores.unreadable.pop(index, None)
            self._take(index)

    def take_awaited(self) -> set[RegionIndex]:
        """Return the regions that scans wait for, to take them or not to give them away."""
        with self._lock:
            awaited, self._awaited = self._awaited, set()
            return awaited

    def release(self, index: RegionIndex) -> bool:
        """Leave a region, which is in the store, to the others, unless it is to stay by now."""
        with self._lock:
            if index in self._awaited or not self.has_to_go(index):
                return False
            self.stores.add(index)
            since_ms = self._shares.holders(index)[self.number]
            self._tokens.pop(index).undeclare()
            self._shares.remove(lease_key(self._map_name, self.number, index, since_ms))
            self.leaving.discard(index)
            self.contests.forget(index)
            return True

    def close(self) -> None:
        """Be there no more: others take all regions. Closing twice does no harm."""
        with self._lock:
            if self._is_closed:
                return
            self._is_closed = True
            self._subscriber.undeclare()
            for token in (*self._tokens.values(), *self._own):
                token.undeclare()

    def _wait_for(self, index: RegionIndex) -> None:
        self._awaited.add(index)
        self.changed.set()
        raise NoRoomYetError

    def _take(self, index: RegionIndex) -> None:
        key = lease_key(self._map_name, self.number, index, now_ms())
        self._tokens[index] = self._liveliness.declare_token(key)
        self._shares.add(key)
        self.contests.see(index, self._shares.holders(index))

    def _heard(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        token = read_token(key)
        if token is None:
            return
        if token.number == self.number:
            self.is_taken |= not self._own
            return
        if sample.kind == zenoh.SampleKind.PUT:
            if token.region is not None:
                self._see_clock(token)
            self._shares.add(key)
            if token.region in self._tokens:
                self.contests.see(token.region, self._shares.holders(token.region))
        else:
            if token.region is None:
                self._ahead_s.pop(token.number, None)
            self.stores.one_has_gone()
            self._shares.remove(key)
        self.changed.set()

    def _see_clock(self, token: ShareToken) -> None:
        """See when another server says that it took a region, which cannot be later than now."""
        ahead_s = (token.since_ms - now_ms()) / 1e3
        if ahead_s > _CLOCKS_AGREE_S:
            self._ahead_s[token.number] = ahead_s
        elif ahead_s > -_CLOCKS_AGREE_S:  # it was just now: the clocks agree by now
            self._ahead_s.pop(token.number, None)
