import time

from triquad_server.net.long_work import LongWork


def test_one_long_question_takes_a_quarter_of_the_time():
    assert 0.02 < LongWork().rest_s(0.01) < 0.031


def test_many_long_questions_take_hardly_more_than_one():
    work = LongWork()
    rests_s = [work.rest_s(0.01) for _ in range(5)]
    assert rests_s == sorted(rests_s)
    assert rests_s[-1] > 4 * rests_s[0]


def test_time_that_nobody_used_is_not_saved_up():
    work = LongWork()
    work.rest_s(0.001)
    time.sleep(0.01)
    assert work.rest_s(0.01) > 0.02


def test_a_slice_that_took_long_holds_up_nobody_for_long():
    work = LongWork()
    assert work.rest_s(100.0) < 1.0
    assert work.rest_s(0.001) < 1.0
