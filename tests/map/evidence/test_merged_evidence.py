"""What two maps know of a region, as one."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.maps.map_records import blocks_of, masks
from triquad_format.records.arrays import Longs
from triquad_format.records.region import (
    MARGIN_BITS,
    MAX_LEVEL,
    OUTCOME_BITS,
    Evidence,
    no_evidence,
    seen_voxels,
)
from triquad_map.evidence.evidence import outcome_codes, outcome_counts
from triquad_map.evidence.merged_evidence import merged_evidence

SIDE = 32
NONE = np.zeros((0, 3), np.int64)


def random_evidence(seed: int, count: int) -> Evidence:
    """Of some voxels, in which there is a surface, free space or both."""
    rng = np.random.default_rng(seed)
    voxels = rng.integers(0, SIDE, (count, 3))
    codes = blocks_of(voxels)
    is_surface, is_free = rng.random((2, count)) < 0.6
    surface = masks(codes, voxels[is_surface | ~is_free])
    free = masks(codes, voxels[is_free])
    ends = int(np.unpackbits(surface).sum())
    hits, *shares = (rng.integers(0, 1 << bits, ends) for bits in OUTCOME_BITS)
    return Evidence(
        codes,
        surface,
        free,
        levels=rng.integers(0, MAX_LEVEL + 1, ends).astype(np.uint8),
        seen_s=np.where(surface.any(axis=1), rng.integers(1, 10**9, len(codes)), 0),
        outcomes=np.stack([hits, *shares], axis=1).astype(np.uint8),
        margins=rng.integers(0, 4, (ends, len(MARGIN_BITS))).astype(np.uint8),
    )


def of_voxels(evidence: Evidence) -> dict[tuple[int, ...], tuple[int, ...]]:
    """All that is told of each surface voxel."""
    told = np.concatenate([evidence.levels[:, None], evidence.outcomes, evidence.margins], axis=1)
    voxels = seen_voxels(evidence, evidence.surface)
    return {tuple(at): tuple(row) for at, row in zip(voxels.tolist(), told.tolist(), strict=True)}


def places(voxels: Longs) -> set[tuple[int, ...]]:
    return {tuple(one) for one in voxels.tolist()}


@given(seed=st.integers(0, 10**6), counts=st.tuples(st.integers(0, 60), st.integers(0, 60)))
def test_all_that_either_knows_is_there(seed: int, counts: tuple[int, int]) -> None:
    first, second = (random_evidence(seed + n, count) for n, count in enumerate(counts))
    both = merged_evidence(first, second, NONE)
    assert (np.diff(both.codes) > 0).all()
    one, other, joined = of_voxels(first), of_voxels(second), of_voxels(both)
    assert set(joined) == set(one) | set(other)
    for place, told in joined.items():
        if place not in other:
            assert told == one[place]
        elif place not in one:
            assert told == other[place]
        else:
            codes = np.array([one[place][1:4], other[place][1:4]], np.uint8)
            hits = outcome_codes(outcome_counts(codes).sum(axis=0, keepdims=True))[0].tolist()
            least = np.minimum(one[place][4:], other[place][4:]).tolist()
            assert told == (max(one[place][0], other[place][0]), *hits, *least)
    free = [places(seen_voxels(each, each.free)) for each in (first, second, both)]
    assert free[2] == free[0] | free[1]
    seen = [dict(zip(each.codes.tolist(), each.seen_s.tolist(), strict=True)) for each in
            (first, second, both)]  # fmt: skip
    assert seen[2] == {code: max(seen[0].get(code, 0), seen[1].get(code, 0)) for code in seen[2]}


@given(seed=st.integers(0, 10**6))
def test_to_know_nothing_more_changes_nothing(seed: int) -> None:
    evidence = random_evidence(seed, 40)
    for pair in ((evidence, no_evidence()), (no_evidence(), evidence)):
        joined = merged_evidence(*pair, NONE)
        for name, value in vars(evidence).items():
            np.testing.assert_array_equal(getattr(joined, name), value, err_msg=name)


def test_what_the_first_lost_is_gone_where_the_second_does_not_have_it() -> None:
    first, second = random_evidence(1, 40), random_evidence(2, 40)
    lost = seen_voxels(first, first.surface)
    kept = places(seen_voxels(second, second.surface))
    left = merged_evidence(first, second, lost)
    assert places(seen_voxels(left, left.surface)) == kept
    some = merged_evidence(first, second, lost[:5])
    assert places(seen_voxels(some, some.surface)) == kept | places(lost[5:])
