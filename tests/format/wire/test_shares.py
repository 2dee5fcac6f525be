"""The tokens of a shared map, and the rules that everybody follows by them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from triquad_format.errors import FormatError
from triquad_format.wire.shares import (
    MAX_SHARES,
    Shares,
    ShareToken,
    chosen_share,
    lease_key,
    number_of_share,
    read_token,
    share_key,
    share_name,
)

NUMBERS = st.integers(1, MAX_SHARES)
REGIONS = st.tuples(*[st.integers(-999_999, 999_999)] * 3)
TIMES = st.integers(0, 10**14)


@given(NUMBERS, REGIONS, TIMES)
def test_a_token_is_read_as_it_was_written(number, region, since_ms):
    assert read_token(share_key("a.b", number)) == ShareToken(number)
    written = lease_key("a.b", number, region, since_ms)
    assert read_token(written) == ShareToken(number, region, since_ms)


@pytest.mark.parametrize(
    "key",
    [
        "triquad/town/@share/0",
        "triquad/town/@share/65",
        "triquad/town/@share/x",
        "triquad/town/@share/1/2_3",
        "triquad/town/@share/1/2_3_4",
        "triquad/town/@share/1/2_3_4/5/6",
        "triquad/town/@share/1/99999999_0_0/5",
        "triquad/town/@alive/town.1",
        "",
    ],
)
def test_what_is_no_token_is_none(key):
    assert read_token(key) is None
    shares = Shares()
    shares.add(key)
    shares.remove(key)
    assert (shares.numbers, shares.leases) == (frozenset(), {})


@given(REGIONS, st.sets(NUMBERS, min_size=2, max_size=8))
def test_where_one_goes_its_regions_alone_change(region, numbers):
    chosen = chosen_share(region, numbers)
    assert chosen in numbers
    for gone in numbers:
        after = chosen_share(region, numbers - {gone})
        assert (after == chosen) == (gone != chosen)


def test_regions_are_spread_over_all():
    regions = [(x, y, 0) for x in range(30) for y in range(30)]
    counts = [sum(chosen_share(one, range(1, 5)) == n for one in regions) for n in range(1, 5)]
    assert min(counts) > 180
    assert chosen_share((0, 0, 0), []) is None


def test_of_several_holders_the_lowest_answers():
    shares = Shares()
    for number in (1, 2, 3):
        shares.add(share_key("town", number))
    shares.add(lease_key("town", 3, (1, 0, 0), 50))
    assert shares.answering((1, 0, 0)) == 3
    shares.add(lease_key("town", 2, (1, 0, 0), 70))
    assert (shares.answering((1, 0, 0)), shares.holders((1, 0, 0))) == (2, {2: 70, 3: 50})
    shares.remove(lease_key("town", 2, (1, 0, 0), 60))  # of an earlier time that it had it
    assert shares.leases == {(1, 0, 0): {2, 3}}
    for number, since_ms in ((2, 70), (3, 50)):
        shares.remove(lease_key("town", number, (1, 0, 0), since_ms))
    assert shares.answering((1, 0, 0)) == chosen_share((1, 0, 0), (1, 2, 3))
    shares.remove(share_key("town", 2))
    assert shares.numbers == {1, 3}


def test_the_names_of_servers_tell_whether_they_share_a_map():
    assert share_name("town", 3) == "town.3"
    assert number_of_share("town", "town.3") == 3
    for other in ("town", "town.0", "town.x", "town.100", "towns.3", "d1a0b3c4", "townx3"):
        assert number_of_share("town", other) is None
    with pytest.raises(FormatError):
        share_name("a" * 63, 3)
