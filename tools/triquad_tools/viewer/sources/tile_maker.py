"""Mesh tiles of maps in memory: made in the background, and kept for whoever wants them next."""

import logging
import threading
from collections import deque
from collections.abc import Callable, Collection, Hashable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Protocol

from triquad_client.mesh.followed_mesh import TileIndex
from triquad_format.errors import TriquadError

from triquad_tools.viewer.sources.tile_cache import MadeTile, TileCache

_log = logging.getLogger(__name__)

_THREADS = 2
_MAX_BYTES = 500_000_000


class TileRecipe(Protocol):
    """How the tiles of one level of one map are made."""

    @property
    def name(self) -> Hashable:
        """Where this is equal, the tiles are."""

    @property
    def level(self) -> int:
        """Of detail."""

    def listed(self) -> Collection[TileIndex]:
        """The tiles in which there may be faces; slow at first."""

    def make(self, index: TileIndex) -> MadeTile:
        """One of these."""


Choice = Callable[[Collection[TileIndex]], list[TileIndex]]
"""Gives the tiles that are wanted of all that there are, the most urgent first."""


class TileOrder:
    """Tiles that somebody wants. All but :attr:`complete` belongs to the :class:`TileMaker`."""

    def __init__(
        self, recipe: TileRecipe, choose: Choice, made: Mapping[TileIndex, MadeTile]
    ) -> None:
        self.recipe = recipe
        self.choose = choose
        self.listed = False
        self.waiting: deque[TileIndex] = deque()  # the most urgent first
        self.under_way = 0
        self.made = {index: made[index] for index in choose(made.keys())}
        self.problem: Exception | None = None

    @property
    def complete(self) -> bool:
        """Whether all that is wanted was made."""
        return self.listed and not self.waiting and not self.under_way

    def name_of(self, index: TileIndex) -> Hashable:
        """Of a tile, among those of all orders."""
        return self.recipe.name, index


class TileMaker:
    """Makes tiles on threads of its own: those of the coarsest level first."""

    def __init__(self, max_bytes: int = _MAX_BYTES) -> None:
        self._cache = TileCache(max_bytes)
        self._orders: list[TileOrder] = []
        self._being_made: set[Hashable] = set()
        self._changed = threading.Condition()
        self._closing = False
        self._threads = [
            threading.Thread(target=self._work, name=f"tiles-{number}", daemon=True)
            for number in range(_THREADS)
        ]
        for thread in self._threads:
            thread.start()

    def order(
        self,
        recipe: TileRecipe,
        choose: Choice,
        made: Mapping[TileIndex, MadeTile] = MappingProxyType({}),
    ) -> TileOrder:
        """Begin to make tiles; ``made`` are some that the recipe made already."""
        order = TileOrder(recipe, choose, made)
        with self._changed:
            self._orders.append(order)
            self._changed.notify_all()
        return order

    def collect(self, order: TileOrder) -> Mapping[TileIndex, MadeTile]:
        """What was made so far.

        Raises:
            TriquadError: some of it cannot be.
        """
        with self._changed:
            if order.problem is not None:
                raise order.problem
            return dict(order.made)

    def wait(self, order: TileOrder, timeout_s: float) -> bool:
        """Wait until an order is complete, or the time is over; returns whether it is complete."""
        with self._changed:
            return self._changed.wait_for(lambda: order.complete, timeout_s)

    def cancel(self, order: TileOrder) -> None:
        """Make no more of an order; returns once nothing of it is under way."""
        with self._changed:
            if order in self._orders:
                self._orders.remove(order)
            order.waiting.clear()
            self._changed.wait_for(lambda: not order.under_way)

    def close(self) -> None:
        """Make no more tiles."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _work(self) -> None:
        while (task := self._next_task()) is not None:
            order, work = task
            problem = None
            try:
                work()
            except Exception as error:
                if not isinstance(error, TriquadError):
                    _log.exception("a mesh tile cannot be made")
                problem = error
            with self._changed:
                order.under_way -= 1
                if problem is not None:
                    order.problem, order.listed = problem, True
                    order.waiting.clear()
                self._changed.notify_all()

    def _next_task(self) -> tuple[TileOrder, Callable[[], None]] | None:
        with self._changed:
            while not self._closing:
                for order in sorted(self._orders, key=lambda order: -order.recipe.level):
                    work = self._work_for(order)
                    if work is not None:
                        order.under_way += 1
                        return order, work
                self._changed.wait()
            return None

    def _work_for(self, order: TileOrder) -> Callable[[], None] | None:
        """What to do next; ``None``: nothing, or another thread is at it. Holds the lock."""
        if not order.listed:
            return None if order.under_way else partial(self._list, order)
        while order.waiting:
            index = order.waiting[0]
            cached = self._cache.get(order.name_of(index))
            if cached is None and order.name_of(index) in self._being_made:
                return None
            order.waiting.popleft()
            if cached is None:
                self._being_made.add(order.name_of(index))
                return partial(self._make, order, index)
            order.made[index] = cached
            self._changed.notify_all()
        return None

    def _list(self, order: TileOrder) -> None:
        chosen = order.choose(order.recipe.listed())
        with self._changed:
            order.waiting.extend(index for index in chosen if index not in order.made)
            order.listed = True

    def _make(self, order: TileOrder, index: TileIndex) -> None:
        try:
            tile = order.recipe.make(index)
        finally:
            with self._changed:
                self._being_made.discard(order.name_of(index))
        with self._changed:
            self._cache.put(order.name_of(index), tile)
            order.made[index] = tile
