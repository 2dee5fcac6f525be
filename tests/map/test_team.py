"""Work that is shared among threads is all done, once, whatever happens."""

import threading
from contextlib import nullcontext

import numpy as np
import pytest
from triquad_map.compiled.team import THREADS, Team


@pytest.fixture
def team():
    team = Team("test")
    yield team
    team.close()


@pytest.mark.parametrize("count", [0, 1, 2047, 100_000])
def test_each_place_is_worked_on_once(team, count):
    done = np.zeros(count, int)

    def work(first, last):
        done[first:last] += 1

    team.split(count, work)
    team.close()
    team.split(count, work)
    assert (done == 2).all()


@pytest.mark.parametrize("is_closed", [False, True])
@pytest.mark.parametrize("count", [0, 1, 10_000])
def test_work_along_is_done_once_and_the_callers_own_by_the_caller(team, count, is_closed):
    if is_closed:
        team.close()
    done = np.zeros(count, int)

    def work(first, last):
        done[first:last] += 1

    assert team.along(threading.get_ident, count, work, 300) == threading.get_ident()
    assert (done == 1).all()


def test_an_error_of_one_part_is_raised_when_all_have_ended(team):
    ended = []

    def work(part):
        ended.append(part)
        if part == THREADS - 1:
            raise ValueError("the last part")

    with pytest.raises(ValueError, match="the last part"):
        team.each(work)
    assert sorted(ended) == list(range(THREADS))


@pytest.mark.parametrize("is_closed", [False, True])
@pytest.mark.parametrize("failing", [0, THREADS - 1, THREADS])
def test_all_parts_have_ended_when_they_return(team, is_closed, failing):
    if is_closed:
        team.close()
    ended = []

    def work(part):
        ended.append(part)
        if part == failing:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError) if failing < THREADS else nullcontext():
        team.each(work)
    assert sorted(ended) == list(range(THREADS))


def test_work_is_done_once_where_no_thread_can_be_started(team, monkeypatch):
    done = np.zeros(10_000, int)

    def work(first, last):
        done[first:last] += 1

    def refuse(_):
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", refuse)
        team.split(len(done), work)
    assert (done == 1).all()
    team.split(len(done), work)
    team.close()  # what the pool still had waits no more
    assert (done == 2).all()


def test_the_caller_waits_for_no_thread_that_has_other_work(team):
    busy, go_on = threading.Barrier(THREADS), threading.Event()

    def work(part):
        if part > 0:  # on a thread of the team
            busy.wait()
        go_on.wait()

    done = np.zeros(10_000, int)

    def split():
        busy.wait()
        team.split(len(done), lambda first, last: done.__setitem__(slice(first, last), 1))
        go_on.set()

    other = threading.Thread(target=team.each, args=(work,))
    other.start()
    split()
    other.join()
    assert done.all()
