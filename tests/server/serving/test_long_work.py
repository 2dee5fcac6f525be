"""Work that takes long: to ask again with the same ticket is to ask for the same work."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from threading import Event

import pytest
from support import servers
from triquad_format.errors import RefusedError
from triquad_server.serving import long_work
from triquad_server.serving.long_work import _MOST_PENDING, LongWork


@dataclass(frozen=True)
class Asked:
    ticket: int
    place: str = ""


@dataclass(frozen=True)
class AskedForAll:
    ticket: int


@dataclass(frozen=True)
class AskedOtherwise(Asked):
    pass


@dataclass
class Held:
    """Work that begins, and ends once it is let."""

    begun: Event = field(default_factory=Event)
    let: Event = field(default_factory=Event)
    done: list[int] = field(default_factory=list)

    def __call__(self, request: Asked | AskedForAll) -> int:
        self.begun.set()
        assert self.let.wait(servers.WAIT_S)
        self.done.append(request.ticket)
        if request.ticket == 13:
            raise RefusedError("store", "the disk is full")
        return -request.ticket


@pytest.fixture
def work() -> Iterator[LongWork]:
    with closing(LongWork(niceness=0)) as work:
        yield work


def refused(work: LongWork, held: Held, ticket: int) -> str:
    with pytest.raises(RefusedError) as caught:
        work.answer(held, Asked(ticket))
    return caught.value.code


def test_who_asks_again_gets_the_result_of_the_first_time(work: LongWork) -> None:
    held = Held()
    assert refused(work, held, 5) == refused(work, held, 6) == refused(work, held, 5) == "under_way"
    held.let.set()
    assert [work.answer(held, Asked(ticket)) for ticket in (0, 6, 5, 5)] == [0, -6, -5, -5]
    assert held.done == [5, 6, 0], "each was done once, in their order"


def test_a_ticket_of_other_work_is_another(work: LongWork) -> None:
    held = Held()
    held.let.set()
    assert work.answer(held, Asked(5)) == -5
    assert work.answer(lambda request: "reset", AskedOtherwise(5)) == "reset"
    assert work.answer(held, Asked(5)) == -5


def test_what_has_not_begun_answers_all_who_ask_for_no_place(work: LongWork) -> None:
    """As a client does that gives up, and asks with another ticket."""
    first, held = Held(), Held()
    assert refused(work, first, 5) == "under_way"
    for ticket in (6, 7, 8):
        with pytest.raises(RefusedError, match="been at it"):
            work.answer(held, AskedForAll(ticket))
    first.let.set()
    assert held.begun.wait(servers.WAIT_S)
    with pytest.raises(RefusedError, match="been at it"):
        work.answer(held, AskedForAll(9))  # too late for the one that has begun
    held.let.set()
    assert [work.answer(held, AskedForAll(ticket)) for ticket in (9, 8, 7, 6)] == [-9, -6, -6, -6]
    assert held.done == [6, 9]


def test_what_went_wrong_is_told_to_who_asks_again(work: LongWork) -> None:
    held = Held()
    assert refused(work, held, 13) == "under_way"
    held.let.set()
    work.answer(held, Asked(0))
    assert refused(work, held, 13) == "store"
    assert held.done == [13, 0]


def test_too_much_at_once_is_refused(work: LongWork, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(long_work, "_TOLD_AFTER_S", 0.001)
    held = Held()
    codes = {refused(work, held, ticket) for ticket in range(1, _MOST_PENDING + 1)}
    assert codes == {"under_way"}
    assert refused(work, held, 1_000) == "busy"
    held.let.set()


def test_at_the_end_what_has_begun_is_done_and_the_rest_refused() -> None:
    work, held = LongWork(niceness=0), Held()
    with ThreadPoolExecutor(3) as pool:
        begun = pool.submit(work.answer, held, Asked(0))
        assert held.begun.wait(servers.WAIT_S)
        assert refused(work, held, 7) == "under_way"
        closed = pool.submit(work.close)
        servers.until(lambda: refused(work, held, 7) == "busy")
        held.let.set()
        assert begun.result(servers.WAIT_S) == 0
        closed.result(servers.WAIT_S)
    assert held.done == [0]
    assert refused(work, held, 8) == "busy"
