"""A bounded queue of items of many owners, who are served in turn."""

from collections import deque
from collections.abc import Callable, Iterator
from typing import Generic, NamedTuple, TypeVar

ItemT = TypeVar("ItemT")


class Owner(NamedTuple):
    """The owner of an item: a group, and one name in it."""

    group: str
    name: str = ""


class FairQueue(Generic[ItemT]):
    """Serves groups in turn, and the names within each, however much any of them sends.

    When it is full, an item of the group that has most is removed. Not safe for several threads.
    """

    def __init__(self, limit: int, limit_bytes: int, limit_each: int, *, newest_go: bool) -> None:
        """Let ``limit`` items wait at most, ``limit_each`` of each group, ``limit_bytes`` in all.

        A single item may be larger. If there are too many, the newest are removed, or the oldest.
        """
        self.limit = limit
        self.limit_bytes = limit_bytes
        self.limit_each = limit_each
        self.nbytes = 0
        self._newest_go = newest_go
        self._count = 0
        # Items with their bytes, oldest first; the group and the name whose turn is next are first.
        self._groups: dict[str, dict[str, deque[tuple[ItemT, int]]]] = {}

    def __len__(self) -> int:
        return self._count

    def count(self, group: str) -> int:
        """Return how many items of a group wait."""
        return sum(map(len, self._groups.get(group, {}).values()))

    def oldest(self) -> Iterator[ItemT]:
        """Yield an oldest item of each group."""
        for names in self._groups.values():
            yield next(iter(names.values()))[0][0]

    def put(self, owner: Owner, item: ItemT, nbytes: int) -> list[ItemT]:
        """Add an item; return those that are removed for it, of which it may be one."""
        names = self._groups.setdefault(owner.group, {})
        names.setdefault(owner.name, deque()).append((item, nbytes))
        self._count += 1
        self.nbytes += nbytes
        removed = []
        if self.count(owner.group) > self.limit_each:
            removed.append(self._remove_of(owner.group, by_bytes=False))
        while self._count > self.limit or (self.nbytes > self.limit_bytes and self._count > 1):
            by_bytes = self.nbytes > self.limit_bytes
            sizes = {group: self._size(group, by_bytes) for group in reversed(self._groups)}
            removed.append(self._remove_of(max(sizes, key=sizes.__getitem__), by_bytes))
        return removed

    def take(self, may: Callable[[ItemT], bool] = lambda _: True) -> ItemT | None:
        """Return the oldest item of the owner whose turn it is; the owner then comes last.

        Owners whose oldest item ``may`` rejects are passed over.
        """
        for owner in self._in_turn():
            names = self._groups[owner.group]
            if may(names[owner.name][0][0]):
                item = self._pop(owner, 0)
                if owner.name in names:
                    names[owner.name] = names.pop(owner.name)
                if names:
                    self._groups[owner.group] = self._groups.pop(owner.group)
                return item
        return None

    def clear(self) -> list[ItemT]:
        """Remove all items."""
        removed = []
        while (item := self.take()) is not None:
            removed.append(item)
        return removed

    def _in_turn(self) -> Iterator[Owner]:
        for group, names in self._groups.items():
            for name in names:
                yield Owner(group, name)

    def _size(self, group: str, by_bytes: bool) -> int:
        lanes = self._groups[group].values()
        return sum(_bytes_of(lane) if by_bytes else len(lane) for lane in lanes)

    def _remove_of(self, group: str, by_bytes: bool) -> ItemT:
        """Remove an item of the name of a group that has most; of equals, of the last."""
        names = self._groups[group]
        measure = _bytes_of if by_bytes else len
        name = max(reversed(names), key=lambda name: measure(names[name]))
        return self._pop(Owner(group, name), -1 if self._newest_go else 0)

    def _pop(self, owner: Owner, index: int) -> ItemT:
        names = self._groups[owner.group]
        lane = names[owner.name]
        item, nbytes = lane.popleft() if index == 0 else lane.pop()
        self._count -= 1
        self.nbytes -= nbytes
        if not lane:
            del names[owner.name]
        if not names:
            del self._groups[owner.group]
        return item


def _bytes_of(lane: deque[tuple[ItemT, int]]) -> int:
    return sum(nbytes for _, nbytes in lane)
