"""Mutants of map files: each is read as it was, as another valid map, or refused by name.

``TRIQUAD_FUZZ`` is the number of mutants of each kind. Given, others are drawn each time, and none
may take longer than 5 s; otherwise they are always the same. Linux only: memory is limited.
"""

import os
import resource
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from fuzz.choices import Mutation
from fuzz.damage import DAMAGE, add_bombs, change_parts
from fuzz.forgery import FORGERY, forge_bombs
from fuzz.valid_maps import READERS, Reader, Results, ValidMap, valid_maps
from hypothesis import HealthCheck, Phase, event, given, settings
from hypothesis import strategies as st
from support.map_records import assert_same
from triquad_format.errors import FormatError
from triquad_format.mapfile.manifest import Entry
from triquad_format.records.record_check import check_record
from triquad_format.records.region import MapRecord

CAMPAIGN = os.environ.get("TRIQUAD_FUZZ")
COUNT = int(CAMPAIGN or 80)
LIMIT_BYTES = 64 * 2**20
"""Memory that a reader may take beside the size of the file."""

mutants = settings(
    max_examples=COUNT,
    derandomize=CAMPAIGN is None,
    deadline=5000 if CAMPAIGN else None,
    suppress_health_check=list(HealthCheck),
    report_multiple_bugs=False,
)
bombs = settings(mutants, max_examples=max(COUNT // 20, 10))


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> list[ValidMap]:
    return valid_maps(tmp_path_factory.mktemp("maps"))


@pytest.mark.parametrize("mutation", DAMAGE)
@mutants
@given(data=st.data())
def test_damage_is_found(maps: list[ValidMap], mutation: Mutation, data: st.DataObject) -> None:
    check_mutant(maps, mutation, data)


@pytest.mark.parametrize("mutation", FORGERY)
@mutants
@given(data=st.data())
def test_forged_maps_are_valid(
    maps: list[ValidMap], mutation: Mutation, data: st.DataObject
) -> None:
    check_mutant(maps, mutation, data, forged=True)


@pytest.mark.parametrize("mutation", [add_bombs, forge_bombs])
@bombs
@given(data=st.data())
def test_bombs_take_little_memory(
    maps: list[ValidMap], mutation: Mutation, data: st.DataObject
) -> None:
    check_mutant(maps, mutation, data, forged=mutation is forge_bombs)


def test_a_reader_that_checks_no_digests_is_found(
    maps: list[ValidMap], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tests above must be able to fail."""
    monkeypatch.setattr(Entry, "check", lambda *_: None)

    @settings(mutants, max_examples=500, derandomize=True, phases=[Phase.generate])
    @given(data=st.data())
    def damage_is_found(data: st.DataObject) -> None:
        check_mutant(maps, change_parts, data)

    with pytest.raises(AssertionError, match="read as another map"):
        damage_is_found()


def check_mutant(
    maps: list[ValidMap], mutation: Mutation, data: st.DataObject, *, forged: bool = False
) -> None:
    """Change one file of a map, and check what each way of reading the map makes of it."""
    valid = data.draw(st.sampled_from(maps))
    name = data.draw(st.sampled_from(sorted(valid.files)))
    mutant = mutation(data.draw, valid.files[name])
    # A map knows the digests of the other files that it needs: no forgery of them passes.
    forged = forged and name == valid.path.name
    (valid.path.parent / name).write_bytes(mutant)
    try:
        for read, wanted in zip(READERS, valid.results, strict=True):
            with little_memory(len(mutant)), np.errstate(all="ignore"):
                have = outcome(read, valid.path)
            if isinstance(have, FormatError):
                check_error(have)
            elif not is_same(have, wanted):
                assert forged, f"{read}: it is read as another map"
                check_results(have)
    finally:
        (valid.path.parent / name).write_bytes(valid.files[name])


def outcome(read: Reader, path: Path) -> Results | FormatError:
    try:
        return read(path)
    except FormatError as error:
        return error


def check_error(error: FormatError) -> None:
    event(type(error).__name__)
    assert not isinstance(error.__cause__, MemoryError), "it takes too much memory"
    assert str(error).strip(), f"{type(error).__name__} without a text"


def is_same(results: Results, wanted: Results) -> bool:
    try:
        assert_same(results, wanted)
    except AssertionError:
        return False
    return True


def check_results(results: Results) -> None:
    event("another valid map")
    for record in results:
        if isinstance(record, MapRecord):
            check_record(record)


@contextmanager
def little_memory(file_bytes: int) -> Iterator[None]:
    """Limit the address space, so that no allocation passes unseen, and measure Python's."""
    limit = LIMIT_BYTES + file_bytes
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    tracemalloc.start()
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + limit, before[1]))
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] <= limit, "it takes too much memory"
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
        tracemalloc.stop()
