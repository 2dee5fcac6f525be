"""A bounded queue of what many owners send, who are served in turn."""

from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

ItemT = TypeVar("ItemT")


class Owner(NamedTuple):
    """Whose turn it is: that of a group, and of one name in it."""

    group: str
    name: str = ""


def first_to_go(items: Sequence[tuple[Owner, int]]) -> int:
    """Which of items with their sizes, oldest first, goes where they are too many.

    It is the newest of whoever has most.
    """
    groups: Counter[str] = Counter()
    names: Counter[Owner] = Counter()
    for owner, size in items:
        groups[owner.group] += size
        names[owner] += size

    def share(number: int) -> tuple[int, int, int]:
        owner, _ = items[number]
        return groups[owner.group], names[owner], number

    return max(range(len(items)), key=share)


@dataclass
class _Lane(Generic[ItemT]):
    """What waits of one owner, oldest first, with the bytes of each."""

    items: deque[tuple[ItemT, int]] = field(default_factory=deque)
    nbytes: int = 0

    def pop(self, *, newest: bool = False) -> ItemT:
        """Take the oldest, or the newest."""
        item, nbytes = self.items.pop() if newest else self.items.popleft()
        self.nbytes -= nbytes
        return item


_Lanes = OrderedDict[str, _Lane[ItemT]]


class FairQueue(Generic[ItemT]):
    """Groups take turns, and so do the names within each, however much any of them sends.

    Where it is full, whoever has most of it loses something. Not safe for several threads at once.
    """

    def __init__(self, limit: int, limit_bytes: int) -> None:
        """At most ``limit`` items wait, of ``limit_bytes`` together; a single one always may."""
        self.limit = limit
        self.limit_bytes = limit_bytes
        self.nbytes = 0
        self._count = 0
        self._groups: OrderedDict[str, _Lanes[ItemT]] = OrderedDict()  # whose turn is next is first

    def __len__(self) -> int:
        return self._count

    def count(self, owner: Owner) -> int:
        """Items of one owner that wait."""
        lanes = self._groups.get(owner.group)
        return len(lanes[owner.name].items) if lanes and owner.name in lanes else 0

    def most(self) -> int:
        """Items that wait of the owner who has most."""
        lanes = (lane for lanes in self._groups.values() for lane in lanes.values())
        return max((len(lane.items) for lane in lanes), default=0)

    def put(self, owner: Owner, item: ItemT, nbytes: int) -> None:
        """Add an item at the end of its owner's; the caller then drops what is too much."""
        lane = self._lane(owner)
        lane.items.append((item, nbytes))
        self._grew(lane, nbytes)

    def put_first(self, owner: Owner, item: ItemT, nbytes: int) -> None:
        """As :meth:`put`, before what waits of its owner."""
        lane = self._lane(owner)
        lane.items.appendleft((item, nbytes))
        self._grew(lane, nbytes)

    def take(self, may: Callable[[ItemT], bool] = lambda _: True) -> ItemT | None:
        """The oldest item of the owner whose turn it is; it then comes last.

        Owners of whose oldest item ``may`` says no are passed over.
        """
        if not self._count:  # mostly: whoever puts something in takes it out at once
            return None
        for owner in self._in_turn():
            lane = self._groups[owner.group][owner.name]
            if may(lane.items[0][0]):
                item = self._pop(owner)
                self._comes_last(owner)
                return item
        return None

    def drop_oldest(self, owner: Owner) -> ItemT:
        """Remove the oldest item of an owner who has one."""
        return self._pop(owner)

    def excess(self, *, newest: bool) -> list[ItemT]:
        """Remove what is too much: the ``newest``, or the oldest, of whoever has most."""
        dropped = []
        while self._count > self.limit or (self.nbytes > self.limit_bytes and self._count > 1):
            dropped.append(self._pop(self._longest(), newest=newest))
        return dropped

    def clear(self) -> list[ItemT]:
        """Remove all items."""
        lanes = [lane for lanes in self._groups.values() for lane in lanes.values()]
        self._groups.clear()
        self._count = self.nbytes = 0
        return [item for lane in lanes for item, _ in lane.items]

    def _in_turn(self) -> Iterator[Owner]:
        for group, lanes in self._groups.items():
            for name in lanes:
                yield Owner(group, name)

    def _lane(self, owner: Owner) -> _Lane[ItemT]:
        lanes: _Lanes[ItemT] = self._groups.setdefault(owner.group, OrderedDict())
        return lanes.setdefault(owner.name, _Lane())

    def _grew(self, lane: _Lane[ItemT], nbytes: int) -> None:
        lane.nbytes += nbytes
        self.nbytes += nbytes
        self._count += 1

    def _pop(self, owner: Owner, *, newest: bool = False) -> ItemT:
        lanes = self._groups[owner.group]
        lane = lanes[owner.name]
        before = lane.nbytes
        item = lane.pop(newest=newest)
        self.nbytes += lane.nbytes - before
        self._count -= 1
        if not lane.items:
            del lanes[owner.name]
            if not lanes:
                del self._groups[owner.group]
        return item

    def _comes_last(self, owner: Owner) -> None:
        lanes = self._groups.get(owner.group)
        if lanes is None:
            return
        self._groups.move_to_end(owner.group)
        if owner.name in lanes:
            lanes.move_to_end(owner.name)

    def _longest(self) -> Owner:
        """Who has most: bytes where these are too many, else items; of equals, the last."""
        by_bytes = self.nbytes > self.limit_bytes

        def size(lane: _Lane[ItemT]) -> int:
            return lane.nbytes if by_bytes else len(lane.items)

        group = max(
            reversed(self._groups),
            key=lambda group: sum(map(size, self._groups[group].values())),
        )
        lanes = self._groups[group]
        return Owner(group, max(reversed(lanes), key=lambda name: size(lanes[name])))
